//! The host name in a request (RFC 9112 §3.2).
//!
//! A page whose host name resolves to a loopback address (DNS rebinding) can make a browser treat a local service as the page's own
//! origin. Such requests carry the page's host name, so a service without keys accepts loopback names only.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use axum::{
    extract::Request,
    http::{HeaderMap, Version, header, uri::Authority},
};

use crate::{
    domain::ProblemType,
    http::problem::{Answer as _, ApiResult, ProblemResponse},
};

/// A name or address, and a port if one is given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Host {
    name: String,
    port: Option<u16>,
}

impl Host {
    fn parse(text: &str) -> Option<Self> {
        let authority: Authority = text.parse().ok()?;
        let name = authority.host();
        // No user info, and a numeric port.
        let port = match text.strip_prefix(name)? {
            "" | ":" => None,
            rest => Some(rest.strip_prefix(':')?.parse().ok()?),
        };
        (!name.is_empty()).then(|| Self { name: name.to_ascii_lowercase(), port })
    }

    /// Whether every resolver maps it to this machine: `localhost` and names under it (RFC 6761 §6.3), 127.0.0.0/8, ::1.
    fn is_loopback(&self) -> bool {
        let name = self.name.strip_suffix('.').unwrap_or(&self.name);
        if name == "localhost" || name.ends_with(".localhost") {
            return true;
        }
        let address = match name.strip_prefix('[').and_then(|name| name.strip_suffix(']')) {
            Some(inner) => inner.parse::<Ipv6Addr>().map(IpAddr::from),
            None => name.parse::<Ipv4Addr>().map(IpAddr::from),
        };
        address.is_ok_and(|address| address.to_canonical().is_loopback())
    }

    /// Whether an `Origin` of this scheme and host is the same origin.
    fn serves(&self, scheme: &str, origin: &Self) -> bool {
        let default = match scheme {
            "http" => Some(80),
            "https" => Some(443),
            _ => None,
        };
        self.name == origin.name && self.port.or(default) == origin.port.or(default)
    }
}

/// The hosts in a request: that of a target in absolute form, which takes precedence, and that of `Host`.
#[derive(Debug, Clone, Default)]
pub(crate) struct Hosts {
    target: Option<Host>,
    header: Option<Host>,
}

impl Hosts {
    /// Reads them. Only HTTP/1.0, which no browser speaks, may omit both.
    ///
    /// # Errors
    /// 400.
    pub(crate) fn of(request: &Request) -> ApiResult<Self> {
        let target = request.uri().authority().map(|target| parse(target.as_str())).transpose()?;
        let mut given = request.headers().get_all(header::HOST).iter();
        let header = match (given.next(), given.next()) {
            (None, _) if target.is_some() || request.version() < Version::HTTP_11 => None,
            (None, _) => return Err(invalid("is missing")),
            (Some(_), Some(_)) => return Err(invalid("is there more than once")),
            (Some(value), None) => Some(parse(value.to_str().unwrap_or_default())?),
        };
        Ok(Self { target, header })
    }

    /// 421 unless all are loopback names.
    pub(super) fn expect_loopback(&self) -> ApiResult<()> {
        match self.target.iter().chain(&self.header).find(|host| !host.is_loopback()) {
            None => Ok(()),
            Some(host) => Err(ProblemType::ForeignHost.because(format!(
                "without keys the service accepts only loopback names such as localhost and 127.0.0.1 as Host, not '{}': use \
                 one of those, have a proxy send one, or create a key with 'tcgs keys create'",
                host.name
            ))),
        }
    }

    /// Whether an `Origin` is the service itself.
    pub(super) fn serve_origin(&self, origin: &str) -> bool {
        let Some((scheme, rest)) = origin.split_once("://") else { return false };
        let (Some(origin), Some(own)) = (Host::parse(rest), self.target.as_ref().or(self.header.as_ref()))
        else {
            return false;
        };
        own.serves(scheme, &origin)
    }
}

fn parse(text: &str) -> ApiResult<Host> {
    Host::parse(text).ok_or_else(|| invalid("is not a name or address with or without a port"))
}

fn invalid(error: &str) -> ProblemResponse {
    ProblemType::InvalidHeader.because(format!("Host: {error}"))
}

/// The value of a header; if there are several, or it is not ASCII, a text that matches nothing.
pub(crate) fn only<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let mut values = headers.get_all(name).iter();
    match (values.next(), values.next()) {
        (None, _) => None,
        (Some(value), None) => Some(value.to_str().unwrap_or("not ASCII")),
        (Some(_), Some(_)) => Some("more than one"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_stand_for_this_machine_everywhere_are_loopback() {
        for own in [
            "localhost",
            "LOCALHOST:8080",
            "localhost.",
            "a.localhost:1",
            "127.0.0.1",
            "127.8.9.10:65535",
            "[::1]",
            "[::1]:8080",
            "[::ffff:127.0.0.1]:8080",
            "localhost:",
        ] {
            assert!(Host::parse(own).is_some_and(|host| host.is_loopback()), "{own}");
        }
        for foreign in [
            "evil.example",
            "evil.example:8080",
            "localhost.evil.example",
            "evillocalhost",
            "127.0.0.1.evil.example",
            "127.1",
            "2130706433",
            "0x7f000001",
            "0.0.0.0",
            "[::]",
            "10.0.0.1",
            "[fe80::1]",
            ".",
            "127.0.0.1.nip.io",
        ] {
            assert!(Host::parse(foreign).is_none_or(|host| !host.is_loopback()), "{foreign}");
        }
        for none in
            ["", ":8080", "localhost:evil", "me@localhost", "localhost:99999", "localhost/", "a b", "[::1"]
        {
            assert_eq!(Host::parse(none), None, "{none}");
        }
    }

    #[test]
    fn an_origin_is_the_services_own_only_with_its_scheme_s_port() {
        let hosts = |text: &str| Hosts { target: None, header: Host::parse(text) };
        for (host, origin, own) in [
            ("localhost:8080", "http://localhost:8080", true),
            ("LocalHost:8080", "http://localhost:8080", true),
            ("tcgs.example", "https://tcgs.example", true),
            ("tcgs.example:443", "https://tcgs.example", true),
            ("tcgs.example", "http://tcgs.example:443", false),
            ("localhost:8080", "http://localhost:3000", false),
            ("localhost:8080", "http://127.0.0.1:8080", false),
            ("localhost:8080", "http://localhost", false),
            ("localhost:8080", "null", false),
            ("localhost:8080", "", false),
            ("localhost:8080", "http://localhost:8080.evil.example", false),
        ] {
            assert_eq!(hosts(host).serve_origin(origin), own, "{origin} at {host}");
        }
        assert!(!Hosts::default().serve_origin("http://localhost"));
        let both = Hosts { target: Host::parse("tcgs.example"), header: Host::parse("localhost") };
        assert!(both.serve_origin("http://tcgs.example"), "the target takes precedence");
        assert!(!both.serve_origin("http://localhost"));
    }
}
