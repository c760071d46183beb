//! `Content-Digest` (RFC 9530): the announced digest of a body.

use axum::http::HeaderMap;
use base64::{Engine as _, engine::general_purpose::STANDARD};

use crate::{
    domain::{Digest, ProblemType},
    http::problem::{Answer as _, ApiResult, ProblemResponse},
};

const HEADER: &str = "content-digest";

/// The announced SHA-256 of the body; digests by other algorithms are ignored, as the standard requires.
pub(crate) fn announced(headers: &HeaderMap) -> ApiResult<Option<Digest>> {
    let mut found = None;
    for value in headers.get_all(HEADER) {
        let text = value.to_str().map_err(|_| malformed())?;
        for member in text.split(',').map(str::trim).filter(|member| !member.is_empty()) {
            let (algorithm, value) = member.split_once('=').ok_or_else(malformed)?;
            let value = value.split(';').next().unwrap_or_default().trim();
            let value =
                value.strip_prefix(':').and_then(|value| value.strip_suffix(':')).ok_or_else(malformed)?;
            let bytes = STANDARD.decode(value).map_err(|_| malformed())?;
            if algorithm.trim().eq_ignore_ascii_case("sha-256") {
                found = Some(Digest::from_bytes(bytes.try_into().map_err(|_| malformed())?));
            }
        }
    }
    Ok(found)
}

/// 400 if the body does not have the announced digest.
pub(crate) fn check(announced: Option<Digest>, actual: Digest) -> ApiResult<()> {
    match announced {
        Some(announced) if announced != actual => Err(ProblemType::DigestMismatch.because(format!(
            "Content-Digest announced the SHA-256 {announced}, and what came has {actual}; send it again"
        ))),
        _ => Ok(()),
    }
}

/// 400 for a digest that would not be checked.
pub(crate) fn refuse(headers: &HeaderMap, why: &str) -> ApiResult<()> {
    match headers.get(HEADER) {
        Some(_) => Err(ProblemType::InvalidHeader.because(format!("{HEADER}: {why}"))),
        None => Ok(()),
    }
}

fn malformed() -> ProblemResponse {
    ProblemType::InvalidHeader.because("content-digest: is not of the form sha-256=:BASE64:")
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn of(value: &str) -> ApiResult<Option<Digest>> {
        announced(&HeaderMap::from_iter([(
            HEADER.parse().expect("a name"),
            HeaderValue::from_str(value).expect("a value"),
        )]))
    }

    #[test]
    fn the_sha_256_is_taken_and_other_digests_are_passed_over() {
        let abc = "sha-256=:ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=:";
        for value in [abc.to_owned(), format!("unixsum=:AAA=:, {abc}"), format!("{abc};x=1")] {
            assert_eq!(of(&value).expect("well-formed"), Some(Digest::of(b"abc")), "{value}");
        }
        assert_eq!(announced(&HeaderMap::new()).expect("absent"), None);
        assert_eq!(of("unixsum=:AAA=:").expect("well-formed"), None);
        for bad in ["abc", "sha-256=ungW", "sha-256=:ungW:", "sha-256=:!:", "sha-256"] {
            of(bad).expect_err(bad);
        }
        check(Some(Digest::of(b"abc")), Digest::of(b"abc")).expect("equal");
        check(None, Digest::of(b"abc")).expect("nothing was announced");
        check(Some(Digest::of(b"abd")), Digest::of(b"abc")).expect_err("they differ");
    }
}
