//! HTML pages: their content security policy and the headers that all of them have.
//!
//! Invariants: a page runs only its own scripts and styles, which the policy names by their hashes; it loads pictures and sends requests
//! to this service alone; no page of another site can frame it.

use axum::{
    http::{HeaderName, HeaderValue, header},
    response::{IntoResponse as _, Response},
};
use maud::Markup;

use super::problem::{ApiResult, internal};
use crate::viewer_page::source_of;

/// The policy of pages with this script and this style; `None` never occurs, since hashes are legal in headers.
pub(super) fn policy(script: &str, style: &str) -> Option<HeaderValue> {
    let policy = format!(
        "default-src 'none'; script-src {}; style-src {}; img-src 'self' data: blob:; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        source_of(script),
        source_of(style)
    );
    HeaderValue::try_from(policy).ok()
}

/// A response with the page.
///
/// # Errors
/// 500 without a policy.
pub(super) fn page(markup: Markup, policy: Option<HeaderValue>) -> ApiResult<Response> {
    let policy = policy.ok_or_else(internal)?;
    let mut response = markup.into_string().into_response();
    let answer = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_TYPE, HeaderValue::from_static("text/html; charset=utf-8")),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache")),
        (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
        (HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("same-origin")),
    ] {
        answer.insert(name, value);
    }
    Ok(response)
}
