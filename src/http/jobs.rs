//! Jobs: create from a zip, list, get, cancel.

use axum::{
    Json,
    body::{Body, BodyDataStream},
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use jiff::Timestamp;
use serde::Serialize;
use tokio::task::spawn_blocking;
use uuid::{NoContext, Uuid};

use super::{
    body::{discard, expect_media_type, stage},
    etag::{Etag, not_modified},
    job_body::{JobBody, href},
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, JobId, OptionError, TrainOptions},
    store::{Cancellation, JobFilter, JobRecord, NewJob, PageKey},
};

const DEFAULT_PAGE: u32 = 20;
const MAX_PAGE: u32 = 100;
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

/// `POST /v1/jobs`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let mut body = body.into_data_stream();
    let created = receive(&state, &caller, query.as_deref(), &headers, &mut body).await;
    if created.as_ref().is_err_and(|fault| !fault.is_about_transfer()) {
        discard(&mut body, &headers).await;
    }
    created
}

async fn receive(
    state: &AppState,
    caller: &Caller,
    query: Option<&str>,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
) -> Result<Response, Fault> {
    expect_media_type(headers, &["application/zip", "application/x-zip-compressed"])?;
    let options = options(Parameters::parse(query)?)?;
    let place = state.uploads().try_acquire();
    let _place = place.map_err(|_| Fault::busy("too many datasets are being received"))?;
    let staged = stage(body, headers, state.blobs(), state.limits()).await?;
    let check = state.services().check.clone();
    let (staged, checked) = spawn_blocking(move || {
        let checked = check(staged.path());
        (staged, checked)
    })
    .await
    .map_err(|error| Fault::internal(&error))?;
    checked?;
    let dataset = state.blobs().publish(&staged).await?;
    let id = new_id(state.services().clock.now());
    let record =
        state.store().create_job(NewJob { owner: caller.key, ..NewJob::new(id, options, dataset) }).await?;
    tracing::info!(job = %id, bytes = dataset.bytes, "job {id} is queued");
    let location = HeaderValue::try_from(href(id)).map_err(|error| Fault::internal(&error))?;
    let mut response = (StatusCode::CREATED, representation(record)).into_response();
    response.headers_mut().insert(header::LOCATION, location);
    Ok(response)
}

fn options(parameters: Parameters) -> Result<TrainOptions, Fault> {
    let fault = |error: OptionError| {
        Fault::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "invalid-option",
            "Invalid training option",
            error.to_string(),
        )
    };
    let mut options = TrainOptions::default();
    for (name, text) in parameters.rest() {
        options.set(&name, &text).map_err(fault)?;
    }
    options.validated().map_err(fault)
}

/// An id whose time part is the service's clock, so that ids sort as jobs were made.
fn new_id(now: Timestamp) -> JobId {
    let seconds = u64::try_from(now.as_second()).unwrap_or(0);
    let nanoseconds = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
    JobId(Uuid::new_v7(uuid::Timestamp::from_unix(NoContext, seconds, nanoseconds)))
}

#[derive(Debug, Serialize)]
struct JobList {
    jobs: Vec<JobBody>,
    next: Option<String>,
}

/// `GET /v1/jobs`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    RawQuery(query): RawQuery,
) -> Result<impl IntoResponse, Fault> {
    let mut parameters = Parameters::parse(query.as_deref())?;
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let before = parameters.take("cursor").map(|text| parse_cursor(&text)).transpose()?;
    parameters.finish()?;
    // One more than asked for tells whether there is a next page.
    let mut records = state.store().jobs(&JobFilter { owner: caller.sees_only() }, before, limit + 1).await?;
    let more = records.len() > limit as usize;
    records.truncate(limit as usize);
    let next =
        records.last().filter(|_| more).map(|last| format!("/v1/jobs?limit={limit}&cursor={}", cursor(last)));
    let jobs = records.into_iter().map(JobBody::from).collect();
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(JobList { jobs, next })))
}

fn cursor(last: &JobRecord) -> String {
    format!("{}.{}", last.job.created_at.as_microsecond(), last.job.id)
}

fn parse_cursor(text: &str) -> Result<PageKey, Fault> {
    let key = text.split_once('.').and_then(|(at, id)| {
        let created_at = Timestamp::from_microsecond(at.parse().ok()?).ok()?;
        Some(PageKey { created_at, id: id.parse().ok()? })
    });
    key.ok_or_else(|| Fault::parameter("cursor", "is not one that this service gave out"))
}

/// `GET /v1/jobs/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let etag = etag(&record);
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    Ok(representation(record).into_response())
}

fn etag(record: &JobRecord) -> Etag {
    Etag::new(record.job.version)
}

fn representation(record: JobRecord) -> impl IntoResponse {
    let mut headers = HeaderMap::new();
    headers.insert(header::ETAG, etag(&record).value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if !record.job.state.is_terminal() {
        headers.insert(header::RETRY_AFTER, POLL_SECONDS.into());
    }
    (headers, Json(JobBody::from(record)))
}

/// `POST /v1/jobs/{id}/cancel`.
pub(super) async fn cancel(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Response, Fault> {
    let parsed = find(&state, &caller, &id).await?.job.id;
    match state.store().cancel(parsed).await?.ok_or_else(|| Fault::no_job(&id))? {
        Cancellation::Done(record) => Ok(representation(record).into_response()),
        Cancellation::Requested(record) => Ok((StatusCode::ACCEPTED, representation(record)).into_response()),
        Cancellation::TooLate(record) => Err(Fault::new(
            StatusCode::CONFLICT,
            "job-finished",
            "The job has finished",
            format!("job {parsed} has already {}; it cannot be cancelled", record.job.state.name()),
        )),
    }
}
