//! The cookie of a session.

use axum::{
    extract::FromRequestParts,
    http::{HeaderMap, header, request::Parts},
};

use crate::{
    domain::{KeyHash, SessionToken},
    http::problem::{ApiResult, ProblemResponse},
};

/// The name of the cookie.
pub(crate) const SESSION_COOKIE: &str = "tcgs_session";

/// The session that a request came with, if it has one; an extractor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ActiveSession(pub(crate) Option<KeyHash>);

impl<S: Sync> FromRequestParts<S> for ActiveSession {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> ApiResult<Self> {
        Ok(parts.extensions.get().copied().unwrap_or(Self(None)))
    }
}

/// The token in the cookies. Removes them all: this service has no other. Of several the first counts, which a browser sends for the longest
/// path.
pub(super) fn take_session(headers: &mut HeaderMap) -> Option<SessionToken> {
    let token = headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .find_map(|(name, value)| (name == SESSION_COOKIE).then(|| value.parse()));
    headers.remove(header::COOKIE);
    token?.ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_cookie_of_the_name_counts_and_none_stays() {
        let (first, second) = ("0a".repeat(32), "1b".repeat(32));
        let taken = |cookies: &str| {
            let mut headers = HeaderMap::new();
            headers.append(header::COOKIE, cookies.parse().expect("a value"));
            let token = take_session(&mut headers).map(|token| token.expose().to_owned());
            assert!(headers.is_empty(), "{cookies}");
            token
        };
        for cookies in [
            format!("tcgs_session={first}"),
            format!("a=b; tcgs_session={first}; c=d"),
            format!("tcgs_session={first};tcgs_session={second}"),
            format!("x_tcgs_session={second}; tcgs_session={first}"),
        ] {
            assert_eq!(taken(&cookies).as_ref(), Some(&first), "{cookies}");
        }
        for cookies in ["tcgs_session=", "tcgs_session", "tcgs_session=0a", "a=b", &format!("tcgs={first}")] {
            assert_eq!(taken(cookies), None, "{cookies}");
        }
    }
}
