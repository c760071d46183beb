//! Strong entity tags and the conditions that clients put on them (RFC 9110 §8.8.3, §13.1).

use std::fmt::Display;

use axum::{
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};

/// A strong entity tag, with its quotes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Etag(String);

/// What a request's `If-Match` says about an entity tag.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum IfMatch {
    /// There is no such header.
    Absent,
    /// It lists the tag, or `*`.
    Matches,
    /// It lists others only.
    Differs,
}

impl Etag {
    /// The tag of a version or digest, whose text must be plain ASCII without quotes.
    pub(crate) fn new(version: impl Display) -> Self {
        Self(format!("\"{version}\""))
    }

    pub(crate) fn value(&self) -> HeaderValue {
        // Digits and hexadecimal digits in quotes are always a legal value.
        HeaderValue::from_str(&self.0).unwrap_or(HeaderValue::from_static("\"\""))
    }

    /// Whether `If-None-Match` says that the client has this already (weak comparison, as the header wants).
    pub(crate) fn is_in_if_none_match(&self, headers: &HeaderMap) -> bool {
        headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok()).any(|list| {
            list.split(',').map(str::trim).any(|tag| tag == "*" || tag.trim_start_matches("W/") == self.0)
        })
    }

    /// Compares the tag with `If-Match` (strong comparison).
    pub(crate) fn if_match(&self, headers: &HeaderMap) -> IfMatch {
        let mut lists = headers.get_all(header::IF_MATCH).iter().peekable();
        if lists.peek().is_none() {
            return IfMatch::Absent;
        }
        let mut tags =
            lists.filter_map(|value| value.to_str().ok()).flat_map(|list| list.split(',')).map(str::trim);
        if tags.any(|tag| tag == "*" || tag == self.0) { IfMatch::Matches } else { IfMatch::Differs }
    }

    /// Whether `If-Range` lets a `Range` stand: absent, or exactly this tag.
    pub(crate) fn allows_range(&self, headers: &HeaderMap) -> bool {
        headers.get(header::IF_RANGE).is_none_or(|value| value.as_bytes() == self.0.as_bytes())
    }
}

/// 304.
pub(crate) fn not_modified(etag: &Etag) -> Response {
    (StatusCode::NOT_MODIFIED, [(header::ETAG, etag.value())]).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditions_compare_as_the_standard_says() {
        let etag = Etag::new("abc");
        let with = |name, value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(name, HeaderValue::from_static(value));
            headers
        };
        for held in ["\"abc\"", "*", "\"x\", \"abc\"", "W/\"abc\""] {
            assert!(etag.is_in_if_none_match(&with(header::IF_NONE_MATCH, held)), "{held}");
        }
        for other in ["abc", "\"x\"", "\"ABC\""] {
            assert!(!etag.is_in_if_none_match(&with(header::IF_NONE_MATCH, other)), "{other}");
        }
        assert_eq!(etag.if_match(&HeaderMap::new()), IfMatch::Absent);
        for held in ["\"abc\"", "*", "\"x\" , \"abc\""] {
            assert_eq!(etag.if_match(&with(header::IF_MATCH, held)), IfMatch::Matches, "{held}");
        }
        for other in ["abc", "\"x\"", "W/\"abc\"", ""] {
            assert_eq!(etag.if_match(&with(header::IF_MATCH, other)), IfMatch::Differs, "{other}");
        }
        assert!(etag.allows_range(&HeaderMap::new()));
        assert!(etag.allows_range(&with(header::IF_RANGE, "\"abc\"")));
        assert!(!etag.allows_range(&with(header::IF_RANGE, "W/\"abc\"")), "If-Range compares strongly");
        assert!(!etag.allows_range(&with(header::IF_RANGE, "Sat, 21 Nov 2026 00:00:00 GMT")));
    }
}
