//! Projects over HTTP: administrators create and change them; every key may read its own.

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::IntoResponse,
};
use serde::Deserialize;

use super::{
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{ApiJson, Etag, IfMatch, JsonBody, Page, Parameters, not_modified, present},
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType, ProjectId, ProjectLimits},
    store::{NewProject, ProjectChange, ProjectError, ProjectRecord, ProjectUpdate},
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CreateProjectRequest {
    name: String,
    max_bytes: Option<u64>,
    max_active_jobs: Option<u32>,
    max_running_jobs: Option<u32>,
    max_priority: Option<i32>,
}

impl JsonBody for CreateProjectRequest {
    const INVALID: ProblemType = ProblemType::InvalidProjectRequest;
    const EXPECTED: &'static str = "a project's name and limits";
}

/// `POST /v1/projects`.
pub(super) async fn create(
    State(state): State<AppState>,
    ApiJson(request): ApiJson<CreateProjectRequest>,
) -> ApiResult {
    let limits = ProjectLimits {
        quota_bytes: request.max_bytes,
        max_active_jobs: request.max_active_jobs,
        max_running_jobs: request.max_running_jobs,
        max_priority: request.max_priority,
    };
    let services = &state.services;
    let new = NewProject::generate(&*services.entropy, services.clock.now(), &request.name, limits);
    let record = state.store().create_project(new.map_err(|error| refused(&error))?).await?;
    tracing::info!(project = %record.id, "project {} is created", record.id);
    let location = HeaderValue::try_from(format!("/v1/projects/{}", record.id))?;
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], representation(record)).into_response())
}

/// `GET /v1/projects`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    mut parameters: Parameters,
) -> ApiResult {
    let page = Page::take(&mut parameters, |text| text.parse().ok())?;
    parameters.finish()?;
    let projects = match caller.visible_project() {
        None => state.store().projects(page.after, page.to_read()).await?,
        Some(own) => {
            let is_after = page.after.is_none_or(|after| own < after);
            state.store().project(own).await?.filter(|_| is_after).into_iter().collect()
        }
    };
    page.answer("projects", projects, "/v1/projects", |last| last.id, |project| project)
}

/// `GET /v1/projects/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> ApiResult {
    let record = find(&state, &caller, &id).await?;
    let etag = Etag::new(record.version);
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    Ok(representation(record).into_response())
}

/// Fields that are absent stay; `null` gives a limit back to the service's default.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct ChangeProjectRequest {
    name: Option<String>,
    #[serde(deserialize_with = "present")]
    max_bytes: Option<Option<u64>>,
    #[serde(deserialize_with = "present")]
    max_active_jobs: Option<Option<u32>>,
    #[serde(deserialize_with = "present")]
    max_running_jobs: Option<Option<u32>>,
    #[serde(deserialize_with = "present")]
    max_priority: Option<Option<i32>>,
}

impl JsonBody for ChangeProjectRequest {
    const INVALID: ProblemType = ProblemType::InvalidProjectRequest;
    const EXPECTED: &'static str = "a project's new name and limits";
}

/// `PATCH /v1/projects/{id}`.
pub(super) async fn change(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    ApiJson(request): ApiJson<ChangeProjectRequest>,
) -> ApiResult<impl IntoResponse> {
    let record = find(&state, &caller, &id).await?;
    if Etag::new(record.version).if_match(&headers) == IfMatch::Differs {
        return Err(changed(record.id));
    }
    let limits = record.limits;
    let change = ProjectChange {
        name: request.name.unwrap_or(record.name),
        limits: ProjectLimits {
            quota_bytes: request.max_bytes.unwrap_or(limits.quota_bytes),
            max_active_jobs: request.max_active_jobs.unwrap_or(limits.max_active_jobs),
            max_running_jobs: request.max_running_jobs.unwrap_or(limits.max_running_jobs),
            max_priority: request.max_priority.unwrap_or(limits.max_priority),
        },
    };
    let change = change.checked().map_err(|error| refused(&error))?;
    // The fields that were not given are those of this version.
    match state.store().update_project(record.id, Some(record.version), change).await? {
        None => Err(ProblemResponse::no_project(&id)),
        Some(ProjectUpdate::VersionMismatch) => Err(changed(record.id)),
        Some(ProjectUpdate::Updated(record)) => {
            tracing::info!(project = %record.id, "project {} is changed", record.id);
            Ok(representation(record))
        }
    }
}

/// The project that a path names, if the caller may see it.
async fn find(state: &AppState, caller: &Caller, id: &str) -> ApiResult<ProjectRecord> {
    let parsed: ProjectId = id.parse().map_err(|_| ProblemResponse::no_project(id))?;
    let record = state.store().project(parsed).await?;
    record.filter(|record| caller.may_see(record.id)).ok_or_else(|| ProblemResponse::no_project(id))
}

fn representation(record: ProjectRecord) -> impl IntoResponse {
    let etag = Etag::new(record.version).value();
    let headers = [(header::ETAG, etag), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    (headers, Json(record))
}

fn changed(id: ProjectId) -> ProblemResponse {
    ProblemType::PreconditionFailed.because(format!("project {id} has changed meanwhile; read it again"))
}

fn refused(error: &ProjectError) -> ProblemResponse {
    match error {
        ProjectError::Name | ProjectError::MaxBytes(_) | ProjectError::MaxPriority(_) => {
            ProblemType::InvalidProjectRequest.because(format!("the body describes no project: {error}"))
        }
        ProjectError::RandomSource(error) => ProblemResponse::internal(error),
    }
}
