//! The credentials of a request: taken out of its headers, so that no later code can disclose them.

use axum::http::{HeaderMap, HeaderValue, header};
use base64::{Engine as _, engine::general_purpose::STANDARD};

use super::session_cookie::take_session;
use crate::{
    domain::{ApiKey, KeyHash, SessionToken},
    store::KeyRecord,
};

/// The credentials of a request.
pub(super) enum Credentials {
    Nothing,
    Malformed,
    /// As programs send it.
    Bearer(ApiKey),
    /// As browsers send it.
    Basic(ApiKey),
    /// A cookie, which has not been looked up.
    Session(SessionToken),
    /// A session and its key.
    SignedIn(KeyHash, Box<KeyRecord>),
    /// A cookie of no session.
    EndedSession,
}

/// Removes the `Authorization` and `Cookie` headers, so that no later code can disclose them.
pub(super) fn take_credentials(headers: &mut HeaderMap) -> Credentials {
    let session = take_session(headers);
    let mut values = headers.get_all(header::AUTHORIZATION).iter();
    let credentials = match (values.next(), values.next()) {
        (None, _) => session.map_or(Credentials::Nothing, Credentials::Session),
        (Some(value), None) => parse_credentials(value).unwrap_or(Credentials::Malformed),
        (Some(_), Some(_)) => Credentials::Malformed,
    };
    headers.remove(header::AUTHORIZATION);
    credentials
}

fn parse_credentials(value: &HeaderValue) -> Option<Credentials> {
    let (scheme, given) = value.to_str().ok()?.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        given.trim().parse().ok().map(Credentials::Bearer)
    } else if scheme.eq_ignore_ascii_case("basic") {
        password(given.trim()).map(Credentials::Basic)
    } else {
        None
    }
}

/// The key in the credentials of HTTP Basic (RFC 7617): the password. The user name, in whatever encoding, is ignored.
fn password(credentials: &str) -> Option<ApiKey> {
    let decoded = STANDARD.decode(credentials).ok()?;
    let colon = decoded.iter().position(|byte| *byte == b':')?;
    std::str::from_utf8(&decoded[colon + 1..]).ok()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_credentials_stay_in_the_headers_whatever_they_are() {
        let key = "tcgs_000102030405060708090a0b0c0d0e0f10111213b57d5e69";
        for (values, is_bearer) in [
            (vec![format!("Bearer {key}")], true),
            (vec![format!("Basic {}", STANDARD.encode(format!("me:{key}")))], false),
            (vec![key.to_owned()], false),
            (vec![format!("Bearer {key}"), format!("Bearer {key}")], false),
        ] {
            let mut headers = HeaderMap::new();
            for value in &values {
                headers.append(header::AUTHORIZATION, value.parse().expect("a value"));
            }
            assert_eq!(
                matches!(take_credentials(&mut headers), Credentials::Bearer(_)),
                is_bearer,
                "{values:?}"
            );
            assert!(headers.is_empty(), "{values:?}");
        }
    }
}
