//! Addresses to which the service may send requests for clients: the public network only, which prevents server-side request forgery.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use thiserror::Error;
use url::{Host, Url};

/// Longest URL.
pub const MAX_URL: usize = 2048;

/// IPv4 networks that are not public: address, prefix length, purpose.
const V4: &[(Ipv4Addr, u32, &str)] = &[
    (Ipv4Addr::new(0, 0, 0, 0), 8, "unspecified"),
    (Ipv4Addr::new(10, 0, 0, 0), 8, "private"),
    (Ipv4Addr::new(100, 64, 0, 0), 10, "shared by a carrier's customers"),
    (Ipv4Addr::new(127, 0, 0, 0), 8, "loopback"),
    // Azure's metadata and control service has a public address.
    (Ipv4Addr::new(168, 63, 129, 16), 32, "a cloud's metadata service"),
    (Ipv4Addr::new(169, 254, 0, 0), 16, "link-local"),
    (Ipv4Addr::new(172, 16, 0, 0), 12, "private"),
    (Ipv4Addr::new(192, 0, 0, 0), 24, "reserved"),
    (Ipv4Addr::new(192, 0, 2, 0), 24, "for documentation"),
    (Ipv4Addr::new(192, 88, 99, 0), 24, "reserved"),
    (Ipv4Addr::new(192, 168, 0, 0), 16, "private"),
    (Ipv4Addr::new(198, 18, 0, 0), 15, "for benchmarks"),
    (Ipv4Addr::new(198, 51, 100, 0), 24, "for documentation"),
    (Ipv4Addr::new(203, 0, 113, 0), 24, "for documentation"),
    (Ipv4Addr::new(224, 0, 0, 0), 4, "multicast"),
    (Ipv4Addr::new(240, 0, 0, 0), 4, "reserved"),
];

/// IPv6 networks within 2000::/3 that are not public. Nothing outside of 2000::/3 is.
const V6: &[(Ipv6Addr, u32, &str)] = &[
    // Teredo, ORCHID, benchmarks and other assignments of the IETF.
    (Ipv6Addr::new(0x2001, 0, 0, 0, 0, 0, 0, 0), 23, "reserved"),
    (Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 0), 32, "for documentation"),
    (Ipv6Addr::new(0x3fff, 0, 0, 0, 0, 0, 0, 0), 20, "for documentation"),
];

/// Why a request is not sent.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum OutboundError {
    /// Not a URL.
    #[error("is not an absolute URL: {0}")]
    Malformed(String),
    /// Longer than [`MAX_URL`].
    #[error("is {0} bytes long; at most {MAX_URL} are taken")]
    TooLong(usize),
    /// Another scheme than https.
    #[error("has the scheme '{0}'; only https is taken")]
    Scheme(String),
    /// A name and password, or a fragment.
    #[error("has a {0}, which is not taken")]
    Part(&'static str),
    /// An address outside the public network.
    #[error("leads to an address that is {0}; only public addresses are taken")]
    Address(&'static str),
}

/// Which addresses are allowed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OutboundPolicy {
    /// Allows this machine itself, also without TLS.
    pub allow_loopback: bool,
}

impl OutboundPolicy {
    /// Checks the text of a URL. The addresses of its host are checked when the name is resolved, by [`Self::check_address`].
    ///
    /// # Errors
    /// [`OutboundError`].
    pub fn check_url(self, text: &str) -> Result<Url, OutboundError> {
        if text.len() > MAX_URL {
            return Err(OutboundError::TooLong(text.len()));
        }
        let url = Url::parse(text).map_err(|error| OutboundError::Malformed(error.to_string()))?;
        let local = match url.host() {
            Some(Host::Domain(name)) => is_localhost(name),
            Some(Host::Ipv4(address)) => address.is_loopback(),
            Some(Host::Ipv6(address)) => address.to_canonical().is_loopback(),
            None => false,
        };
        match url.scheme() {
            "https" => {}
            "http" if self.allow_loopback && local => {}
            other => return Err(OutboundError::Scheme(other.to_owned())),
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(OutboundError::Part("name or password"));
        }
        if url.fragment().is_some() {
            return Err(OutboundError::Part("fragment"));
        }
        match url.host() {
            Some(Host::Ipv4(address)) => self.check_address(address.into())?,
            Some(Host::Ipv6(address)) => self.check_address(address.into())?,
            Some(Host::Domain(_)) if local && !self.allow_loopback => {
                return Err(OutboundError::Address("loopback"));
            }
            Some(Host::Domain(_)) => {}
            None => return Err(OutboundError::Malformed("there is no host".into())),
        }
        Ok(url)
    }

    /// Checks one address of a host.
    ///
    /// # Errors
    /// [`OutboundError::Address`].
    pub fn check_address(self, address: IpAddr) -> Result<(), OutboundError> {
        let kind = match address.to_canonical() {
            address if self.allow_loopback && address.is_loopback() => None,
            IpAddr::V4(address) => v4(address),
            IpAddr::V6(address) => v6(address),
        };
        kind.map_or(Ok(()), |kind| Err(OutboundError::Address(kind)))
    }
}

fn is_localhost(name: &str) -> bool {
    let name = name.trim_end_matches('.').to_ascii_lowercase();
    name == "localhost" || name.ends_with(".localhost")
}

/// Why an address is not public, if it is not.
fn v4(address: Ipv4Addr) -> Option<&'static str> {
    let bits = address.to_bits();
    let inside =
        |(network, prefix, _): &&(Ipv4Addr, u32, _)| (bits ^ network.to_bits()) >> (32 - prefix) == 0;
    V4.iter().find(inside).map(|(_, _, kind)| *kind)
}

fn v6(address: Ipv6Addr) -> Option<&'static str> {
    let [first, second, third, ..] = address.segments();
    let bytes = address.octets();
    match (first, second) {
        // Both embed an IPv4 address: 6to4 in bytes 2 to 5, NAT64 in the last four.
        (0x2002, _) => return v4(Ipv4Addr::new(bytes[2], bytes[3], bytes[4], bytes[5])),
        (0x64, 0xff9b) if third == 0 && bytes[6..12] == [0; 6] => {
            return v4(Ipv4Addr::new(bytes[12], bytes[13], bytes[14], bytes[15]));
        }
        (0, 0) if address.is_loopback() => return Some("loopback"),
        (0, 0) if address.is_unspecified() => return Some("unspecified"),
        (0xfe80..=0xfebf, _) => return Some("link-local"),
        (0xfc00..=0xfdff, _) => return Some("private"),
        (0xff00..=0xffff, _) => return Some("multicast"),
        (0x2000..=0x3fff, _) => {}
        _ => return Some("reserved"),
    }
    let bits = address.to_bits();
    let inside =
        |(network, prefix, _): &&(Ipv6Addr, u32, _)| (bits ^ network.to_bits()) >> (128 - prefix) == 0;
    V6.iter().find(inside).map(|(_, _, kind)| *kind)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PUBLIC: OutboundPolicy = OutboundPolicy { allow_loopback: false };
    const LOCAL: OutboundPolicy = OutboundPolicy { allow_loopback: true };

    #[test]
    fn only_public_addresses_are_asked() {
        for (address, kind) in [
            ("0.0.0.0", "unspecified"),
            ("0.1.2.3", "unspecified"),
            ("10.0.0.1", "private"),
            ("10.255.255.255", "private"),
            ("100.64.0.1", "shared by a carrier's customers"),
            ("100.100.100.200", "shared by a carrier's customers"),
            ("100.127.255.255", "shared by a carrier's customers"),
            ("127.0.0.1", "loopback"),
            ("127.255.255.254", "loopback"),
            ("168.63.129.16", "a cloud's metadata service"),
            ("169.254.169.254", "link-local"),
            ("172.16.0.1", "private"),
            ("172.31.255.255", "private"),
            ("192.0.0.192", "reserved"),
            ("192.0.2.1", "for documentation"),
            ("192.88.99.1", "reserved"),
            ("192.168.1.1", "private"),
            ("198.18.0.1", "for benchmarks"),
            ("198.19.255.255", "for benchmarks"),
            ("198.51.100.7", "for documentation"),
            ("203.0.113.7", "for documentation"),
            ("224.0.0.1", "multicast"),
            ("239.255.255.255", "multicast"),
            ("240.0.0.1", "reserved"),
            ("255.255.255.255", "reserved"),
            ("::", "unspecified"),
            ("::1", "loopback"),
            ("::7f00:1", "reserved"),
            ("::ffff:127.0.0.1", "loopback"),
            ("::ffff:10.1.2.3", "private"),
            ("::ffff:169.254.169.254", "link-local"),
            ("64:ff9b::a00:1", "private"),
            ("64:ff9b::a9fe:a9fe", "link-local"),
            ("64:ff9b:1::1", "reserved"),
            ("100::1", "reserved"),
            ("2001::1", "reserved"),
            ("2001:1ff::1", "reserved"),
            ("2001:db8::1", "for documentation"),
            ("2002:7f00:1::", "loopback"),
            ("2002:c0a8:101::1", "private"),
            ("3fff:0:1::", "for documentation"),
            ("4000::1", "reserved"),
            ("5f00::1", "reserved"),
            ("fc00::1", "private"),
            ("fd00:ec2::254", "private"),
            ("fe80::1", "link-local"),
            ("febf::1", "link-local"),
            ("fec0::1", "reserved"),
            ("ff02::1", "multicast"),
        ] {
            let parsed: IpAddr = address.parse().expect("an address");
            assert_eq!(PUBLIC.check_address(parsed), Err(OutboundError::Address(kind)), "{address}");
            let local = parsed.to_canonical().is_loopback();
            assert_eq!(LOCAL.check_address(parsed).is_ok(), local, "{address} where loopback is allowed");
        }
        for address in [
            "1.1.1.1",
            "8.8.8.8",
            "9.255.255.255",
            "11.0.0.0",
            "100.63.255.255",
            "100.128.0.0",
            "126.255.255.255",
            "128.0.0.1",
            "168.63.129.17",
            "172.15.255.255",
            "172.32.0.0",
            "192.0.1.1",
            "198.17.255.255",
            "198.20.0.0",
            "223.255.255.255",
            "2001:200::1",
            "2001:4860:4860::8888",
            "2606:4700:4700::1111",
            "::ffff:8.8.8.8",
            "64:ff9b::808:808",
            "2002:808:808::1",
        ] {
            assert_eq!(PUBLIC.check_address(address.parse().expect("an address")), Ok(()), "{address}");
        }
    }

    #[test]
    fn a_url_is_refused_for_all_that_its_text_tells() {
        for good in [
            "https://example.com/hook?x=1",
            "https://example.com:8443/",
            "https://8.8.8.8/hook",
            "https://[2606:4700:4700::1111]/",
        ] {
            assert!(PUBLIC.check_url(good).is_ok(), "{good}");
        }
        let long = format!("https://example.com/{}", "a".repeat(MAX_URL));
        for (bad, named) in [
            ("http://example.com/", "http"),
            ("ftp://example.com/", "ftp"),
            ("file:///etc/passwd", "file"),
            ("example.com/hook", "absolute"),
            ("/hook", "absolute"),
            ("https://", "host"),
            ("https://user:secret@example.com/", "password"),
            ("https://example.com/#part", "fragment"),
            ("https://localhost/", "loopback"),
            ("https://LOCALHOST./", "loopback"),
            ("https://a.localhost/", "loopback"),
            ("https://127.0.0.1/", "loopback"),
            // Other ways to write 127.0.0.1 and 10.0.0.1.
            ("https://2130706433/", "loopback"),
            ("https://0x7f.1/", "loopback"),
            ("https://017700000001/", "loopback"),
            ("https://012.0.0.1/", "private"),
            ("https://[::1]/", "loopback"),
            ("https://[::ffff:10.0.0.1]/", "private"),
            ("https://169.254.169.254/latest/meta-data", "link-local"),
            (&long, "2068 bytes"),
        ] {
            let error = PUBLIC.check_url(bad).expect_err(bad).to_string();
            assert!(error.contains(named), "{bad}: {error}");
        }
        for local in
            ["http://127.0.0.1:9/hook", "http://localhost:9/", "http://[::1]:9/", "https://localhost/"]
        {
            assert!(LOCAL.check_url(local).is_ok(), "{local}");
        }
        for bad in ["http://example.com/", "http://10.0.0.1/", "https://10.0.0.1/"] {
            assert!(LOCAL.check_url(bad).is_err(), "{bad}");
        }
    }
}
