//! The address that a request comes from: the peer of the connection or, if that is a trusted proxy, the client that it names.
//!
//! Invariant: nothing that a client writes into its request changes its address. Of the addresses in `X-Forwarded-For` (or `Forwarded`,
//! RFC 7239) only those count that trusted proxies added, from the right.

use std::{
    fmt,
    net::{IpAddr, Ipv6Addr, SocketAddr},
    str::FromStr,
};

use axum::http::HeaderMap;
use ipnet::IpNet;

/// The address of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ClientAddress(pub(crate) IpAddr);

impl ClientAddress {
    /// The part of the address that one client cannot change: an IPv6 host can use its whole /64.
    pub(crate) fn network(self) -> IpAddr {
        match self.0.to_canonical() {
            IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & (u128::MAX << 64)).into(),
            address => address,
        }
    }

    /// The client's address, given the peer of its connection.
    pub(crate) fn behind(self, proxies: &TrustedProxies, headers: &HeaderMap) -> Self {
        if !proxies.contains(self.0) {
            return self;
        }
        let of = |header, entries: fn(&str) -> Vec<String>| {
            let mut values = headers.get_all(header).iter().peekable();
            values.peek()?;
            let values = values.map(|value| value.to_str().unwrap_or("unreadable"));
            Some(proxies.client(self.0, values.flat_map(entries).collect()))
        };
        match (of("x-forwarded-for", comma_separated), of("forwarded", forwarded)) {
            (None, None) => self,
            (Some(address), None) | (None, Some(address)) => Self(address),
            // A proxy writes one of the two headers and forwards the other unchanged, and it is unknown which.
            (Some(one), Some(other)) if one == other => Self(one),
            (Some(_), Some(_)) => self,
        }
    }
}

/// A network of proxies, as `10.0.0.0/8` or a single address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProxyNetwork(IpNet);

impl FromStr for ProxyNetwork {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let net = text
            .parse()
            .or_else(|_| text.parse::<IpAddr>().map(|address| IpNet::from(address.to_canonical())));
        net.map(Self)
            .map_err(|_| format!("'{text}' is not a network such as 10.0.0.0/8, fd00::/8 or 192.0.2.7"))
    }
}

impl fmt::Display for ProxyNetwork {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The proxies whose forwarding headers are trusted.
#[derive(Debug, Clone, Default)]
pub struct TrustedProxies(pub Vec<ProxyNetwork>);

impl TrustedProxies {
    /// Whether the address is a trusted proxy's.
    pub(crate) fn contains(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        self.0.iter().any(|network| network.0.contains(&address))
    }

    /// The first from the right of the chain's addresses that is no trusted proxy's; one that cannot be read ends it.
    fn client(&self, peer: IpAddr, chain: Vec<String>) -> IpAddr {
        let mut client = peer;
        for entry in chain.iter().rev() {
            if !self.contains(client) {
                break;
            }
            let Some(address) = address(entry) else { break };
            client = address;
        }
        client
    }
}

/// An address, with or without a port.
fn address(text: &str) -> Option<IpAddr> {
    let text = text.trim();
    let bracketed = || text.strip_prefix('[')?.strip_suffix(']')?.parse::<Ipv6Addr>().ok().map(IpAddr::from);
    let address = text.parse().ok().or_else(bracketed);
    address
        .or_else(|| Some(text.parse::<SocketAddr>().ok()?.ip()))
        .map(|address: IpAddr| address.to_canonical())
}

fn comma_separated(value: &str) -> Vec<String> {
    value.split(',').map(str::to_owned).collect()
}

/// The `for` of each element of a `Forwarded`; one without it is unreadable as an address, as it should be.
fn forwarded(value: &str) -> Vec<String> {
    let element = |element: String| {
        let pair = outside_quotes(&element, ';').into_iter().find_map(|pair| {
            let (name, value) = pair.split_once('=')?;
            name.trim().eq_ignore_ascii_case("for").then(|| value.trim().trim_matches('"').to_owned())
        });
        pair.unwrap_or_default()
    };
    outside_quotes(value, ',').into_iter().map(element).collect()
}

/// The parts between separators that are not within double quotes.
fn outside_quotes(text: &str, separator: char) -> Vec<String> {
    let (mut parts, mut quoted, mut escaped) = (vec![String::new()], false, false);
    for c in text.chars() {
        match c {
            c if c == separator && !quoted => {
                parts.push(String::new());
                continue;
            }
            '"' if !escaped => quoted = !quoted,
            _ => {}
        }
        escaped = c == '\\' && quoted && !escaped;
        if let Some(part) = parts.last_mut() {
            part.push(c);
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_one_network_are_one_client() {
        let network = |text: &str| ClientAddress(text.parse().expect("an address")).network().to_string();
        assert_eq!(network("192.0.2.7"), "192.0.2.7");
        assert_eq!(network("::ffff:192.0.2.7"), "192.0.2.7");
        assert_eq!(network("2001:db8:1:2:3:4:5:6"), "2001:db8:1:2::");
    }

    fn client(peer: &str, headers: &[(&'static str, &str)]) -> String {
        let networks = ["10.0.0.0/8", "fd00::/8", "192.0.2.1"].map(|text| text.parse().expect("a network"));
        let proxies = TrustedProxies(networks.to_vec());
        let headers: HeaderMap = headers
            .iter()
            .map(|(name, value)| (axum::http::HeaderName::from_static(name), value.parse().expect("a value")))
            .fold(HeaderMap::new(), |mut all, (name, value)| {
                all.append(name, value);
                all
            });
        let peer = ClientAddress(peer.parse().expect("an address"));
        peer.behind(&proxies, &headers).0.to_string()
    }

    #[test]
    fn only_what_trusted_proxies_have_added_counts() {
        let xff = |value| ("x-forwarded-for", value);
        for (peer, headers, expected) in [
            ("198.51.100.1", &[xff("203.0.113.9")][..], "198.51.100.1"),
            ("10.0.0.1", &[], "10.0.0.1"),
            ("10.0.0.1", &[xff("203.0.113.9")], "203.0.113.9"),
            ("::ffff:10.0.0.1", &[xff("203.0.113.9")], "203.0.113.9"),
            ("192.0.2.1", &[xff("203.0.113.9:4711")], "203.0.113.9"),
            ("192.0.2.2", &[xff("203.0.113.9")], "192.0.2.2"),
            // What stands left of the first that is not trusted is the client's own invention.
            ("10.0.0.1", &[xff("127.0.0.1, 203.0.113.9, 10.2.3.4")], "203.0.113.9"),
            ("10.0.0.1", &[xff("127.0.0.1"), xff("203.0.113.9"), xff("10.2.3.4, fd00::1")], "203.0.113.9"),
            ("10.0.0.1", &[xff("10.9.9.9, 10.2.3.4")], "10.9.9.9"),
            ("10.0.0.1", &[xff("203.0.113.9, nonsense")], "10.0.0.1"),
            ("10.0.0.1", &[xff("203.0.113.9, nonsense, 10.0.0.2")], "10.0.0.2"),
            ("10.0.0.1", &[xff("")], "10.0.0.1"),
            ("10.0.0.1", &[xff("[2001:db8::7]:443")], "2001:db8::7"),
            (
                "10.0.0.1",
                &[("forwarded", "for=1.2.3.4, for=\"[2001:db8::7]:443\";proto=https")],
                "2001:db8::7",
            ),
            (
                "10.0.0.1",
                &[("forwarded", "by=1.2.3.4;For=203.0.113.9;host=\"a,b;for=9.9.9.9\"")],
                "203.0.113.9",
            ),
            // A quote that is escaped ends no text, one behind an escaped backslash does, and outside of texts nothing is escaped.
            ("10.0.0.1", &[("forwarded", r#"for=203.0.113.9;host="a\",for=9.9.9.9;""#)], "203.0.113.9"),
            ("10.0.0.1", &[("forwarded", r#"host="a\\",for=203.0.113.9"#)], "203.0.113.9"),
            ("10.0.0.1", &[("forwarded", r#"host=a\"b,for=203.0.113.9""#)], "10.0.0.1"),
            ("10.0.0.1", &[("forwarded", "for=203.0.113.9, for=_hidden")], "10.0.0.1"),
            ("10.0.0.1", &[("forwarded", "for=203.0.113.9, proto=https")], "10.0.0.1"),
            ("10.0.0.1", &[("forwarded", "for=203.0.113.9"), xff("203.0.113.9")], "203.0.113.9"),
            ("10.0.0.1", &[("forwarded", "for=203.0.113.9"), xff("198.51.100.8")], "10.0.0.1"),
        ] {
            assert_eq!(client(peer, headers), expected, "{peer} {headers:?}");
        }
    }

    #[test]
    fn all_addresses_of_an_ipv6_host_are_one_client() {
        let network = |text: &str| ClientAddress(text.parse().expect("an address")).network();
        assert_eq!(
            network("2001:db8:1:2::1"),
            network("2001:db8:1:2:ffff::2"),
            "a host chooses within its /64"
        );
        assert_ne!(network("2001:db8:1:2::1"), network("2001:db8:1:3::1"));
        assert_eq!(network("10.0.0.1"), network("::ffff:10.0.0.1"), "however it is written");
        assert_ne!(network("10.0.0.1"), network("10.0.0.2"));
    }

    #[test]
    fn networks_are_read_or_refused() {
        for (text, shown) in
            [("10.0.0.0/8", "10.0.0.0/8"), (" 192.0.2.7", "192.0.2.7/32"), ("fd00::/8", "fd00::/8")]
        {
            assert_eq!(text.parse::<ProxyNetwork>().map(|network| network.to_string()), Ok(shown.to_owned()));
        }
        for bad in ["", "10.0.0.0/33", "example.com", "*"] {
            assert!(bad.parse::<ProxyNetwork>().is_err(), "{bad}");
        }
    }
}
