//! Refusals of requests, with the challenges of RFC 9110 and RFC 6750.

use axum::http::{HeaderValue, header};

use crate::{
    domain::{ProblemType, Scope},
    http::{
        problem::{Answer as _, ProblemResponse},
        shared::Wait,
    },
    store::KeyRecord,
};

pub(super) fn no_key(reads: bool) -> ProblemResponse {
    let detail = if reads {
        "this service answers those who have a key: send 'Authorization: Bearer tcgs_...', or give a browser the key as password"
    } else {
        "this service answers those who have a key: send 'Authorization: Bearer tcgs_...'"
    };
    challenge(reads, ProblemType::NoKey.because(detail), BEARER)
}

pub(super) fn bad_key(reads: bool) -> ProblemResponse {
    let detail = "the Authorization header holds no key that this service knows: it is mistyped, revoked, expired or another service's";
    let error = ProblemType::InvalidKey.because(detail);
    challenge(reads, error, BEARER_INVALID)
}

pub(super) fn not_by_basic() -> ProblemResponse {
    bearer_needed("HTTP Basic is taken for GET and HEAD only")
}

/// 401 for what takes the key itself.
pub(in crate::http) fn bearer_needed(why: &str) -> ProblemResponse {
    let detail = format!("{why}; send the key as 'Authorization: Bearer tcgs_...'");
    challenge(false, ProblemType::BearerNeeded.because(detail), BEARER)
}

/// 401 without a challenge by which a browser would ask its user for a password.
pub(super) fn session_ended() -> ProblemResponse {
    let detail =
        "the session has ended, with its key or by its age; sign in again on the page of this service";
    challenge(false, ProblemType::NoKey.because(detail), BEARER)
}

const BEARER: &str = "Bearer realm=\"tcgs\"";
const BEARER_INVALID: &str = "Bearer realm=\"tcgs\", error=\"invalid_token\"";
const BASIC: &str = "Basic realm=\"tcgs\"";

/// Adds the accepted authentication schemes; Basic, for which a browser asks its user, only for reads.
fn challenge(reads: bool, error: ProblemResponse, bearer: &'static str) -> ProblemResponse {
    let error = error.with_header(header::WWW_AUTHENTICATE, HeaderValue::from_static(bearer));
    if reads { error.with_header(header::WWW_AUTHENTICATE, HeaderValue::from_static(BASIC)) } else { error }
}

pub(super) fn out_of_scope(key: &KeyRecord, scope: Scope) -> ProblemResponse {
    let has: Vec<&str> = key.scopes.iter().map(|scope| scope.name()).collect();
    let detail =
        format!("this needs the scope {}; the key '{}' has {}", scope.name(), key.name, has.join(", "));
    let challenge = match scope {
        Scope::Read => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"read\"",
        Scope::DatasetsWrite => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"scenes:write\"",
        Scope::JobsWrite => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"jobs:write\"",
        Scope::Admin => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"admin\"",
    };
    ProblemType::InsufficientScope
        .because(detail)
        .with_header(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge))
}

pub(super) fn too_many_requests(key: &KeyRecord, wait: Wait) -> ProblemResponse {
    let detail = format!(
        "the key '{}' has sent more requests than its rate allows; retry after {} s",
        key.name,
        wait.seconds()
    );
    ProblemType::TooManyRequests.because(detail).with_header(header::RETRY_AFTER, wait.seconds().into())
}

pub(super) fn too_many_failures(reads: bool, wait: Wait) -> ProblemResponse {
    let detail =
        "too many requests without a valid key came from this address; send one with a valid key, or wait";
    let error = ProblemType::TooManyFailures.because(detail);
    challenge(reads, error.with_header(header::RETRY_AFTER, wait.seconds().into()), BEARER)
}
