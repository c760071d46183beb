//! Origins whose pages may use the API, besides the service's own.

use std::{fmt, str::FromStr};

use thiserror::Error;

use axum::http::uri::Authority;

/// An origin as browsers write it into `Origin`: scheme, host, and a port that is not the scheme's.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AllowedOrigin(String);

/// A text that is no origin.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "is no origin; write scheme, host and port, as in https://app.example or http://localhost:5173, without a path"
)]
pub struct InvalidOrigin;

impl FromStr for AllowedOrigin {
    type Err = InvalidOrigin;

    fn from_str(text: &str) -> Result<Self, InvalidOrigin> {
        let (scheme, rest) = text.trim().split_once("://").ok_or(InvalidOrigin)?;
        let scheme = scheme.to_ascii_lowercase();
        let default = match scheme.as_str() {
            "http" => 80,
            "https" => 443,
            _ => return Err(InvalidOrigin),
        };
        let authority: Authority = rest.parse().map_err(|_| InvalidOrigin)?;
        let name = authority.host();
        // No user info, and a numeric port.
        let port: Option<u16> = match rest.strip_prefix(name).ok_or(InvalidOrigin)? {
            "" => None,
            rest => Some(rest.strip_prefix(':').and_then(|port| port.parse().ok()).ok_or(InvalidOrigin)?),
        };
        if name.is_empty() {
            return Err(InvalidOrigin);
        }
        let port = port.filter(|port| *port != default).map(|port| format!(":{port}"));
        Ok(Self(format!("{scheme}://{}{}", name.to_ascii_lowercase(), port.unwrap_or_default())))
    }
}

impl fmt::Display for AllowedOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The origins whose pages may use the API; none unless the operator names some.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AllowedOrigins(pub Vec<AllowedOrigin>);

impl AllowedOrigins {
    /// Whether an `Origin` is one of them.
    pub(crate) fn allow(&self, origin: &str) -> bool {
        self.0.iter().any(|allowed| allowed.0 == origin)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_is_compared_as_browsers_write_it() {
        let origins =
            ["https://app.example", "HTTP://LocalHost:5173", "https://b.example:443", "http://[::1]:80"];
        let allowed = AllowedOrigins(origins.map(|text| text.parse().expect(text)).to_vec());
        for yes in ["https://app.example", "http://localhost:5173", "https://b.example", "http://[::1]"] {
            assert!(allowed.allow(yes), "{yes}");
        }
        for no in ["http://app.example", "https://app.example:8443", "https://app.example.evil", "null", ""] {
            assert!(!allowed.allow(no), "{no}");
        }
        assert!(!AllowedOrigins::default().allow("null"));
    }

    #[test]
    fn what_is_no_origin_is_refused() {
        for text in
            ["*", "null", "app.example", "https://", "https://a/", "https://u@a", "ftp://a", "https://a:x"]
        {
            assert_eq!(text.parse::<AllowedOrigin>(), Err(InvalidOrigin), "{text}");
        }
    }
}
