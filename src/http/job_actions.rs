//! What is done to a job that is there: cancel, retry, delete.

use axum::{
    body::Body,
    extract::{Path, State},
    http::{HeaderMap, Method, StatusCode, Uri},
    response::{IntoResponse as _, Response},
};
use serde::Deserialize;
use tokio::task::spawn_blocking;

use super::{
    body::read_optional_json,
    create_job::{Made, answer, made_before, made_meanwhile, new_id},
    idempotency::{self, Keyed},
    job_wish::{bad_json, check_deadline, deadline},
    jobs::{etag, find, representation},
    problem::Fault,
    space::expect_above_floor,
    state::AppState,
};
use crate::{
    domain::{Caller, Digest, JobState},
    store::{Cancellation, Deletion, RetryOutcome, RetryRequest},
};

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

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct RetryBody {
    /// Whether to go on from the job's checkpoint, if it has one; yes if absent.
    from_checkpoint: Option<bool>,
    /// As when a job is made.
    deadline_s: Option<u32>,
}

/// `POST /v1/jobs/{id}/retry`.
pub(super) async fn retry(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let parsed = find(&state, &caller, &id).await?.job.id;
    let keyed = idempotency::begin(&state, &caller, &headers)?;
    let content = read_optional_json(&mut body.into_data_stream(), &headers, state.limits()).await?;
    let intent = keyed.as_ref().map(|keyed: &Keyed| {
        keyed.intent(&Method::POST, &uri, Digest::of(content.as_deref().unwrap_or_default()))
    });
    if let Some(before) = made_before(&state, intent.as_ref()).await? {
        drop(keyed);
        return answer(&state, before, &headers).await;
    }
    let wish: RetryBody = match &content {
        Some(content) => serde_json::from_slice(content).map_err(|error| bad_json(&error))?,
        None => RetryBody::default(),
    };
    if let Some(seconds) = wish.deadline_s {
        check_deadline(seconds)?;
    }
    expect_above_floor(&state, 0)?;
    let now = state.services().clock.now();
    let repeat = RetryRequest {
        id: new_id(now),
        from_checkpoint: wish.from_checkpoint.unwrap_or(true),
        deadline_at: deadline(now, wish.deadline_s),
        intent: intent.clone(),
    };
    let made = match state.store().retry_job(parsed, repeat).await {
        Ok(None) => return Err(Fault::no_job(&id)),
        Ok(Some(RetryOutcome::NotRetryable(job))) => return Err(not_to_repeat(&id, job)),
        Ok(Some(RetryOutcome::Created(record))) => {
            let new = record.job.id;
            tracing::info!(job = %new, retry_of = %parsed, "job {new} is queued; it repeats job {parsed}");
            Made::Now(*record)
        }
        Err(error) => made_meanwhile(&state, intent.as_ref(), error).await?,
    };
    drop(keyed);
    answer(&state, made, &headers).await
}

fn not_to_repeat(id: &str, state: JobState) -> Fault {
    let detail = format!("job {id} is {}; only a job that failed or was cancelled is retried", state.name());
    Fault::new(StatusCode::CONFLICT, "job-not-retryable", "The job cannot be retried", detail)
}

/// `DELETE /v1/jobs/{id}`.
pub(super) async fn delete(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<StatusCode, Fault> {
    let record = find(&state, &caller, &id).await?;
    let job = record.job.id;
    let wanted = etag(&record).wanted_by_if_match(&headers).ok_or_else(|| changed(&id))?;
    let version = wanted.then_some(record.job.version);
    match state.store().delete_job(job, version).await?.ok_or_else(|| Fault::no_job(&id))? {
        Deletion::Deleted => {}
        Deletion::VersionMismatch => return Err(changed(&id)),
        Deletion::Active(now) => {
            let detail = format!("job {id} is {}; cancel it first and wait until it has ended", now.name());
            return Err(Fault::new(StatusCode::CONFLICT, "job-active", "The job is active", detail));
        }
    }
    tracing::info!(%job, "job {job} is deleted");
    let forget = state.services().forget.clone();
    spawn_blocking(move || forget(job)).await.map_err(|error| Fault::internal(&error))?;
    Ok(StatusCode::NO_CONTENT)
}

fn changed(id: &str) -> Fault {
    Fault::new(
        StatusCode::PRECONDITION_FAILED,
        "precondition-failed",
        "Precondition failed",
        format!("job {id} is no longer as If-Match says; look at it again"),
    )
}
