//! API keys over HTTP, for administrators. The first one is made on the command line: closing the service to all others is up to
//! whoever has its data, not to whoever can reach it.

use std::num::NonZeroU32;

use axum::{
    Json,
    body::Body,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::{Deserialize, Serialize};

use super::{
    body::read_json,
    listing::{self, Page},
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, KeyId, KeyLimits, Scope},
    store::{KeyRecord, NewKey, NewKeyError},
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wish {
    name: String,
    scopes: Vec<Scope>,
    max_bytes: Option<u64>,
    max_active_jobs: Option<u32>,
    requests_per_minute: Option<NonZeroU32>,
    max_priority: Option<i32>,
}

#[derive(Serialize)]
struct Created<'a> {
    key: &'a str,
    #[serde(flatten)]
    record: KeyRecord,
}

/// `POST /v1/keys`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let content = read_json(&mut body.into_data_stream(), &headers, state.limits()).await?;
    let wish: Wish = serde_json::from_slice(&content).map_err(|error| malformed(&error))?;
    if caller.key.is_none() {
        let detail =
            "who has no key cannot make one; 'tcgs keys create' on the service's machine makes the first";
        return Err(Fault::new(StatusCode::CONFLICT, "no-keys-yet", "No key makes keys here", detail));
    }
    let limits = KeyLimits {
        max_bytes: wish.max_bytes,
        max_active_jobs: wish.max_active_jobs,
        requests_per_minute: wish.requests_per_minute,
        max_priority: wish.max_priority,
    };
    let services = state.services();
    let drawn = NewKey::generate(&*services.entropy, services.clock.now(), &wish.name, &wish.scopes, limits);
    let (new, key) = drawn.map_err(|error| match error {
        NewKeyError::Name
        | NewKeyError::NoScopes
        | NewKeyError::MaxBytes(_)
        | NewKeyError::MaxPriority(_) => invalid(&error),
        NewKeyError::Entropy(error) => Fault::internal(&error),
    })?;
    let record = state.store().create_key(new).await?;
    tracing::info!(key = %record.id, "key {} is made", record.id);
    let location = HeaderValue::try_from(href(record.id)).map_err(|error| Fault::internal(&error))?;
    let headers =
        [(header::LOCATION, location), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((StatusCode::CREATED, headers, Json(Created { key: key.expose(), record })).into_response())
}

#[derive(Serialize)]
struct KeyList {
    keys: Vec<KeyRecord>,
    next: Option<String>,
}

/// `GET /v1/keys`.
pub(super) async fn list(
    State(state): State<AppState>,
    _: Caller,
    RawQuery(query): RawQuery,
) -> Result<impl IntoResponse, Fault> {
    let mut parameters = Parameters::parse(query.as_deref())?;
    let page = Page::take(&mut parameters, |text| text.parse().ok())?;
    let revoked = parameters.take_as("revoked", "true or false")?.unwrap_or(false);
    parameters.finish()?;
    let mut keys = state.store().keys(revoked, page.after, page.to_read()).await?;
    let next = page.cut(&mut keys, &format!("/v1/keys?revoked={revoked}"), |last| last.id);
    Ok((listing::headers(next.as_deref())?, Json(KeyList { keys, next })))
}

/// `GET /v1/keys/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    _: Caller,
    Path(id): Path<String>,
) -> Result<impl IntoResponse, Fault> {
    let record = find(&state, &id).await?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(record)))
}

/// `DELETE /v1/keys/{id}`.
pub(super) async fn revoke(
    State(state): State<AppState>,
    _: Caller,
    Path(id): Path<String>,
) -> Result<StatusCode, Fault> {
    let record = find(&state, &id).await?;
    state.store().revoke_key(record.id).await?;
    tracing::info!(key = %record.id, "key {} is revoked", record.id);
    Ok(StatusCode::NO_CONTENT)
}

/// The key that a path names; one that is revoked is gone.
async fn find(state: &AppState, id: &str) -> Result<KeyRecord, Fault> {
    let parsed: KeyId = id.parse().map_err(|_| no_key(id))?;
    let record = state.store().key(parsed).await?;
    record.filter(|record| record.revoked_at.is_none()).ok_or_else(|| no_key(id))
}

fn href(id: KeyId) -> String {
    format!("/v1/keys/{id}")
}

fn no_key(id: &str) -> Fault {
    Fault::nothing_called("key-not-found", "No such key", "key", id)
}

fn malformed(error: &serde_json::Error) -> Fault {
    if error.is_data() {
        return invalid(error);
    }
    let detail = format!("the body is not JSON: {error}");
    Fault::new(StatusCode::BAD_REQUEST, "malformed-json", "Malformed JSON", detail)
}

fn invalid(error: &dyn std::fmt::Display) -> Fault {
    let detail = format!("the body describes no key: {error}");
    Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "invalid-key-request", "No such key can be made", detail)
}
