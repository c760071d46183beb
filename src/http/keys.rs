//! API keys over HTTP, for administrators. The first key is created on the command line: only who has access to the data folder,
//! not anybody on the network, may close the service to others.

use std::num::NonZeroU32;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderValue, StatusCode, header},
    response::IntoResponse,
};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{ApiJson, JsonBody, Page, Parameters, present},
    state::AppState,
};
use crate::{
    domain::{Caller, KeyId, ProblemType, ProjectId, ProjectLimits, Scope},
    store::{KeyChange, KeyProject, KeyRecord, KeyRequest, NewKey, NewKeyError, ProjectError},
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CreateKeyRequest {
    name: String,
    scopes: Vec<Scope>,
    project_id: Option<ProjectId>,
    expires_at: Option<Timestamp>,
    requests_per_minute: Option<NonZeroU32>,
    max_bytes: Option<u64>,
    max_active_jobs: Option<u32>,
    max_running_jobs: Option<u32>,
    max_priority: Option<i32>,
}

impl JsonBody for CreateKeyRequest {
    const INVALID: ProblemType = ProblemType::InvalidKeyRequest;
    const EXPECTED: &'static str = "a key's name, scopes, project and limits";
}

#[derive(Serialize)]
struct CreateKeyResponse<'a> {
    key: &'a str,
    #[serde(flatten)]
    record: KeyRecord,
}

/// `POST /v1/keys`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    ApiJson(request): ApiJson<CreateKeyRequest>,
) -> ApiResult {
    if caller.key.is_none() {
        let detail =
            "a key is needed to create one; 'tcgs keys create' on the service's machine creates the first";
        return Err(ProblemType::NoKeysYet.because(detail));
    }
    let limits = ProjectLimits {
        quota_bytes: request.max_bytes,
        max_active_jobs: request.max_active_jobs,
        max_running_jobs: request.max_running_jobs,
        max_priority: request.max_priority,
    };
    let project = match request.project_id {
        None => KeyProject::New(limits),
        Some(id) if limits == ProjectLimits::default() => KeyProject::Existing(id),
        Some(id) => {
            let detail =
                "max_bytes, max_active_jobs, max_running_jobs and max_priority are limits of projects";
            return Err(invalid(&format!("{detail}; set them by PATCH /v1/projects/{id}")));
        }
    };
    let wanted = KeyRequest {
        name: &request.name,
        scopes: &request.scopes,
        project,
        expires_at: request.expires_at,
        requests_per_minute: request.requests_per_minute,
    };
    // The database's time, by which keys expire.
    let drawn = NewKey::generate(&*state.services.entropy, state.store().time().await?, wanted);
    let (new, key) = drawn.map_err(|error| refused(&error))?;
    let record = state.store().create_key(new).await?;
    tracing::info!(key = %record.id, "key {} is created", record.id);
    let location = HeaderValue::try_from(href(record.id))?;
    let headers =
        [(header::LOCATION, location), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((StatusCode::CREATED, headers, Json(CreateKeyResponse { key: key.expose(), record })).into_response())
}

/// `GET /v1/keys`.
pub(super) async fn list(State(state): State<AppState>, _: Caller, mut parameters: Parameters) -> ApiResult {
    let page = Page::take(&mut parameters, |text| text.parse().ok())?;
    let revoked = parameters.take_as("revoked", "true or false")?.unwrap_or(false);
    let project: Option<ProjectId> = parameters.take_as("project_id", "a project's id")?;
    parameters.finish()?;
    let keys = state.store().keys(project, revoked, page.after, page.to_read()).await?;
    let of_project = project.map(|project| format!("&project_id={project}")).unwrap_or_default();
    let list = format!("/v1/keys?revoked={revoked}{of_project}");
    page.answer("keys", keys, &list, |last| last.id, |key| key)
}

/// `GET /v1/keys/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    _: Caller,
    Path(id): Path<String>,
) -> ApiResult<impl IntoResponse> {
    let record = find(&state, &id).await?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(record)))
}

/// Fields that are absent stay; `null` takes expiry or rate away.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct ChangeKeyRequest {
    name: Option<String>,
    #[serde(deserialize_with = "present")]
    requests_per_minute: Option<Option<NonZeroU32>>,
    #[serde(deserialize_with = "present")]
    expires_at: Option<Option<Timestamp>>,
}

impl JsonBody for ChangeKeyRequest {
    const INVALID: ProblemType = ProblemType::InvalidKeyRequest;
    const EXPECTED: &'static str = "a key's new name, rate and expiry";
}

/// `PATCH /v1/keys/{id}`.
pub(super) async fn change(
    State(state): State<AppState>,
    _: Caller,
    Path(id): Path<String>,
    ApiJson(request): ApiJson<ChangeKeyRequest>,
) -> ApiResult<impl IntoResponse> {
    let record = find(&state, &id).await?;
    let ChangeKeyRequest { name, requests_per_minute, expires_at } = request;
    let change = KeyChange { name, requests_per_minute, expires_at };
    let now = state.store().time().await?;
    let change = change.checked(&record, now).map_err(|error| refused(&error))?;
    let record = state.store().update_key(record.id, change).await?.ok_or_else(|| no_key(&id))?;
    tracing::info!(key = %record.id, "key {} is changed", record.id);
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(record)))
}

/// `DELETE /v1/keys/{id}`.
pub(super) async fn revoke(
    State(state): State<AppState>,
    _: Caller,
    Path(id): Path<String>,
) -> ApiResult<StatusCode> {
    let record = find(&state, &id).await?;
    state.store().revoke_key(record.id).await?;
    tracing::info!(key = %record.id, "key {} is revoked", record.id);
    Ok(StatusCode::NO_CONTENT)
}

/// The key that a path names, unless it is revoked.
async fn find(state: &AppState, id: &str) -> ApiResult<KeyRecord> {
    let parsed: KeyId = id.parse().map_err(|_| no_key(id))?;
    let record = state.store().key(parsed).await?;
    record.filter(|record| record.revoked_at.is_none()).ok_or_else(|| no_key(id))
}

fn href(id: KeyId) -> String {
    format!("/v1/keys/{id}")
}

fn no_key(id: &str) -> ProblemResponse {
    ProblemResponse::not_found(ProblemType::KeyNotFound, "key", id)
}

fn refused(error: &NewKeyError) -> ProblemResponse {
    match error {
        NewKeyError::RandomSource(error) | NewKeyError::Project(ProjectError::RandomSource(error)) => {
            ProblemResponse::internal(error)
        }
        NewKeyError::Name | NewKeyError::NoScopes | NewKeyError::Expired(_) | NewKeyError::Project(_) => {
            invalid(error)
        }
    }
}

fn invalid(error: &dyn std::fmt::Display) -> ProblemResponse {
    ProblemType::InvalidKeyRequest.because(format!("the body describes no key: {error}"))
}
