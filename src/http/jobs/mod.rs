//! Jobs: creation, lists, state, history and actions; the state of one job here.

pub(super) mod actions;
pub(super) mod body;
pub(super) mod change;
pub(super) mod create;
pub(super) mod create_request;
pub(super) mod event_stream;
pub(super) mod events;
mod fields;
pub(super) mod list;
mod list_stream;
pub(super) mod series;

use axum::{
    Json,
    extract::{FromRequestParts, Path, State},
    http::{HeaderMap, HeaderValue, header, request::Parts},
    response::IntoResponse,
};

use self::fields::Fields;
use super::{
    auth::caller::caller,
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{Etag, Parameters, not_modified, prefer},
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType},
    store::JobRecord,
};

/// Seconds after which a client that polls an unfinished job should ask again.
const POLL_SECONDS: u32 = 2;

/// Extracts the job that the path names; 404 if there is none, and if it is another's.
#[derive(Debug)]
pub(super) struct OwnedJob(pub(super) JobRecord);

impl FromRequestParts<AppState> for OwnedJob {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> ApiResult<Self> {
        let caller = caller(parts)?;
        let JobPath(id) = JobPath::from_request_parts(parts, state).await?;
        find(state, caller, &id).await.map(Self)
    }
}

/// What a path names a job by, whether there is one or not.
pub(super) struct JobPath(pub(super) String);

impl FromRequestParts<AppState> for JobPath {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> ApiResult<Self> {
        let Path(id) = Path::<String>::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ProblemType::Refused.because(rejection.body_text()))?;
        Ok(Self(id))
    }
}

/// The job that a path names.
///
/// # Errors
/// 404 if there is none, and if it is another's.
pub(super) async fn find(state: &AppState, caller: Caller, id: &str) -> ApiResult<JobRecord> {
    let Ok(parsed) = id.parse() else { return Err(ProblemResponse::no_job(id)) };
    let record = state.store().job(parsed).await?.filter(|record| caller.may_see(record.project));
    record.ok_or_else(|| ProblemResponse::no_job(id))
}

/// `GET /v1/jobs/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let fields = Fields::take(&mut parameters)?;
    parameters.finish()?;
    let id = record.job.id;
    let (record, waited) = prefer::finished(&state, record, prefer::wait(&headers)).await?;
    let record = record.ok_or_else(|| ProblemResponse::no_job(id))?;
    let etag = etag(&record);
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        partial(&record, &fields).into_response()
    };
    prefer::mark_applied(response.headers_mut(), waited);
    Ok(response)
}

/// The tag of a job as it is shown: its row's version, and while it is queued, its position, which changes with other jobs.
pub(super) fn etag(record: &JobRecord) -> Etag {
    match record.queue_position {
        None => Etag::new(record.job.version),
        Some(position) => Etag::new(format!("{}-{position}", record.job.version)),
    }
}

/// A job with the headers that belong to it.
pub(super) fn representation(record: JobRecord) -> impl IntoResponse {
    partial(&record, &Fields::default())
}

/// Some fields of a job, with the headers that belong to it.
fn partial(record: &JobRecord, fields: &Fields) -> impl IntoResponse + use<> {
    let mut headers = HeaderMap::new();
    headers.insert(header::ETAG, etag(record).value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if !record.job.state.is_terminal() {
        headers.insert(header::RETRY_AFTER, POLL_SECONDS.into());
    }
    (headers, Json(fields.of(body::job(record))))
}
