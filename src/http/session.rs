//! `POST` and `DELETE /session`: exchange a key for a browser's session, and end it.
//!
//! The cookie has no `Path`, so a browser sends it to the folder that `/session` is in, below whatever path a proxy serves the service.

use axum::{
    extract::State,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::IntoResponse as _,
};
use jiff::SignedDuration;

use super::{
    auth::{ActiveSession, SESSION_COOKIE, bearer_needed},
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType, SessionToken},
    store::NewSession,
};

/// `POST /session`.
pub(super) async fn begin(
    State(state): State<AppState>,
    caller: Caller,
    session: ActiveSession,
    parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    parameters.finish()?;
    let Some(key) = caller.key else {
        let detail = "without keys there is nothing to sign in with, and no need to";
        return Err(ProblemType::NoKeysYet.because(detail));
    };
    if session.0.is_some() {
        return Err(bearer_needed("a session cannot begin another"));
    }
    let drawn = SessionToken::generate(&*state.services.entropy);
    let token = drawn.map_err(|error| ProblemResponse::internal(&error))?;
    let life = state.limits.session_ttl;
    let now = state.store().time().await?;
    let life_span = SignedDuration::try_from(life).unwrap_or(SignedDuration::MAX);
    let expires_at = now.checked_add(life_span).unwrap_or(jiff::Timestamp::MAX);
    state.store().create_session(NewSession { hash: token.hash(), key, expires_at }).await?;
    // A browser says by which scheme it came; programs have no use for a session.
    let is_secure =
        headers.get(header::ORIGIN).is_some_and(|origin| origin.as_bytes().starts_with(b"https://"));
    let cookie = cookie(token.expose(), life.as_secs(), is_secure)?;
    let headers =
        [(header::SET_COOKIE, cookie), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((StatusCode::NO_CONTENT, headers).into_response())
}

/// `DELETE /session`.
pub(super) async fn end(
    State(state): State<AppState>,
    _: Caller,
    session: ActiveSession,
    parameters: Parameters,
) -> ApiResult {
    parameters.finish()?;
    if let Some(hash) = session.0 {
        state.store().delete_session(hash).await?;
    }
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie("", 0, false)?)]).into_response())
}

fn cookie(value: &str, seconds: u64, is_secure: bool) -> ApiResult<HeaderValue> {
    let secure = if is_secure { "; Secure" } else { "" };
    let text = format!("{SESSION_COOKIE}={value}; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}");
    let mut value = HeaderValue::try_from(text)?;
    value.set_sensitive(true);
    Ok(value)
}
