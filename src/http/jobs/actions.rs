//! Actions on an existing job: cancel, retry, delete.

use std::{collections::BTreeMap, sync::Arc};

use axum::{
    body::Body,
    extract::State,
    http::{HeaderMap, StatusCode, Uri},
    response::IntoResponse as _,
};
use serde::Deserialize;
use serde_json::{Map, Value};
use tokio::task::spawn_blocking;

use super::{
    JobPath, OwnedJob,
    create::respond,
    create_request::{changed_options, check_deadline, deadline, given_name, job_labels},
    etag, find, representation,
};
use crate::{
    domain::{Caller, Digest, JobId, JobState, ProblemType, TrainOptions},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{
            CreateOutcome, CreateRequest, IfMatch, JsonBody, idempotent, parse_json, present,
            read_optional_json,
        },
        state::AppState,
    },
    store::{Cancellation, Deletion, IdempotentRequest, JobChange, RetryOutcome, RetryRequest},
};

/// `POST /v1/jobs/{id}/cancel`.
pub(crate) async fn cancel(State(state): State<AppState>, OwnedJob(record): OwnedJob) -> ApiResult {
    let id = record.job.id;
    match state.store().cancel(id).await?.ok_or_else(|| ProblemResponse::no_job(id))? {
        Cancellation::Done(record) => Ok(representation(record).into_response()),
        Cancellation::Requested(record) => Ok((StatusCode::ACCEPTED, representation(record)).into_response()),
        Cancellation::TooLate(record) => Err(ProblemType::JobFinished
            .because(format!("job {id} has already {}; it cannot be cancelled", record.job.state.name()))),
    }
}

/// What the new job has of its own; all else is as of the retried one.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct RetryJobRequest {
    /// Whether to continue from the job's checkpoint, if it has one. True if absent, unless options change.
    from_checkpoint: Option<bool>,
    /// As when a job is created.
    deadline_s: Option<u32>,
    /// `null` takes the name away.
    #[serde(deserialize_with = "present")]
    name: Option<Option<String>>,
    /// `null` takes all labels away.
    #[serde(deserialize_with = "present")]
    metadata: Option<Option<BTreeMap<String, String>>>,
    /// Training options.
    #[serde(flatten)]
    options: Map<String, Value>,
}

impl JsonBody for RetryJobRequest {
    const EXPECTED: &'static str = "{\"from_checkpoint\": BOOLEAN, \"deadline_s\": SECONDS, \"name\": TEXT, \"metadata\": OBJECT, OPTION: VALUE, ...}";
}

impl RetryJobRequest {
    /// The request for a retry of a job with the options `before`.
    async fn into_store(
        self,
        state: &AppState,
        caller: Caller,
        before: &TrainOptions,
        intent: Option<IdempotentRequest>,
    ) -> ApiResult<RetryRequest> {
        let Self { from_checkpoint, deadline_s, name, metadata, options } = self;
        deadline_s.map(check_deadline).transpose()?;
        let options = changed_options(before, options)?;
        // The crop alone may be another: it comes after training.
        let is_same_training = options.of_training() == before.of_training()
            && options.camera_search() == before.camera_search();
        let options = (options != *before).then_some(options);
        if !is_same_training && from_checkpoint == Some(true) {
            let error = "is not possible with other options: a checkpoint belongs to the options that it was written with";
            return Err(ProblemResponse::parameter("from_checkpoint", error));
        }
        Ok(RetryRequest {
            id: JobId(state.services.new_uuid()),
            key: caller.key,
            from_checkpoint: from_checkpoint.unwrap_or(is_same_training),
            options,
            change: JobChange {
                name: name.map(given_name).transpose()?,
                metadata: metadata.map(|labels| job_labels(labels.unwrap_or_default())).transpose()?,
            },
            deadline_at: deadline(state, deadline_s).await?,
            intent,
        })
    }
}

/// `POST /v1/jobs/{id}/retry`.
pub(crate) async fn retry(
    State(state): State<AppState>,
    JobPath(id): JobPath,
    caller: Caller,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    let request = CreateRequest { state: &state, caller, uri: &uri, headers: &headers };
    let guard = request.begin()?;
    let job = match find(&state, caller, &id).await {
        // What an earlier request with the same key made is answered also if the job has been deleted since.
        Err(error) if guard.is_none() => return Err(error),
        found => found,
    };
    let content = read_optional_json(&mut body.into_data_stream(), &headers, &state.limits).await?;
    let intent = request.intent(guard.as_ref(), Digest::of(content.as_deref().unwrap_or_default()));
    let create = async {
        let job = job?.job;
        let id = job.id;
        let request: RetryJobRequest = content.as_deref().map(parse_json).transpose()?.unwrap_or_default();
        let repeat = request.into_store(&state, caller, &job.options, intent.clone()).await?;
        state.reservations.require_free_space(0)?;
        match state.store().retry_job(id, repeat).await {
            Ok(None) => Err(ProblemResponse::no_job(id)),
            Ok(Some(RetryOutcome::NotRetryable(job))) => Err(not_retryable(id, job)),
            Ok(Some(RetryOutcome::NoPhotographs)) => Err(ProblemType::JobNotRetryable.because(format!(
                "the photographs of job {id} were deleted, so their cameras cannot be found by another search; send them again"
            ))),
            Ok(Some(RetryOutcome::Created(record))) => Ok(Ok(*record)),
            Err(error) => Ok(Err(error)),
        }
    };
    let outcome = idempotent(request, intent.clone(), create).await?;
    drop(guard);
    if let CreateOutcome::Created(record) = &outcome {
        let new = record.job.id;
        tracing::info!(job = %new, retry_of = %id, "job {new} is queued; it repeats job {id}");
    }
    respond(&state, outcome, &headers).await
}

fn not_retryable(id: JobId, state: JobState) -> ProblemResponse {
    let retried = match state {
        JobState::Succeeded => "it is repeated only with other options",
        _ => "only a job that has ended is retried",
    };
    let detail = format!("job {id} is {}; {retried}", state.name());
    ProblemType::JobNotRetryable.because(detail)
}

/// `DELETE /v1/jobs/{id}`.
pub(crate) async fn delete(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    headers: HeaderMap,
) -> ApiResult<StatusCode> {
    let id = record.job.id;
    let version = match etag(&record).if_match(&headers) {
        IfMatch::Absent => None,
        IfMatch::Matches => Some(record.job.version),
        IfMatch::Differs => return Err(changed(id)),
    };
    match state.store().delete_job(id, version).await?.ok_or_else(|| ProblemResponse::no_job(id))? {
        Deletion::Deleted => state.blobs().request_collection(),
        Deletion::VersionMismatch => return Err(changed(id)),
        Deletion::Active(now) => {
            let detail = format!("job {id} is {}; cancel it first and wait until it has ended", now.name());
            return Err(ProblemType::JobActive.because(detail));
        }
    }
    tracing::info!(job = %id, "job {id} is deleted");
    // A retry that waits may resume from its checkpoint, which is removed with that of the retry.
    if state.store().resumable(&[id]).await?.is_empty() {
        let workers = Arc::clone(&state.services.workers);
        spawn_blocking(move || workers.forget(id)).await?;
    }
    Ok(StatusCode::NO_CONTENT)
}

pub(super) fn changed(id: JobId) -> ProblemResponse {
    ProblemType::PreconditionFailed
        .because(format!("job {id} has changed since the version in If-Match; read it again"))
}
