//! A job as it stands.

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse, Response},
};

use super::{
    etag::{Etag, not_modified},
    job_body::JobBody,
    prefer,
    problem::Fault,
    state::AppState,
};
use crate::{
    domain::{Caller, JobId},
    store::JobRecord,
};

/// Seconds after which a client that polls an unfinished job should ask again.
const POLL_SECONDS: u32 = 2;

/// The job that a path names.
///
/// # Errors
/// 404 if there is none, and if it is another's.
pub(super) async fn find(state: &AppState, caller: &Caller, id: &str) -> Result<JobRecord, Fault> {
    let parsed: JobId = id.parse().map_err(|_| Fault::no_job(id))?;
    let record = state.store().job(parsed).await?;
    record.filter(|record| caller.may_see(record.owner)).ok_or_else(|| Fault::no_job(id))
}

/// `GET /v1/jobs/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let (record, waited) = prefer::finished(&state, record, prefer::wait(&headers)).await?;
    let record = record.ok_or_else(|| Fault::no_job(&id))?;
    let etag = etag(&record);
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        representation(record).into_response()
    };
    prefer::mark_applied(response.headers_mut(), waited);
    Ok(response)
}

/// The tag of a job's row.
pub(super) fn etag(record: &JobRecord) -> Etag {
    Etag::new(record.job.version)
}

/// A job with the headers that belong to it.
pub(super) fn representation(record: JobRecord) -> impl IntoResponse {
    let mut headers = HeaderMap::new();
    headers.insert(header::ETAG, etag(&record).value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if !record.job.state.is_terminal() {
        headers.insert(header::RETRY_AFTER, POLL_SECONDS.into());
    }
    (headers, Json(JobBody::from(record)))
}
