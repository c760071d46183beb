//! `POST /v1/jobs`: creates a job from the archive in the body or in a form, or from a dataset that was sent before.

use axum::{
    body::{Body, BodyDataStream},
    extract::State,
    http::{HeaderMap, HeaderValue, StatusCode, Uri, header},
    response::IntoResponse as _,
};

use super::{
    body::href,
    create_request::{CreateJobRequest, deadline},
    representation,
};
use crate::{
    domain::{
        Caller, DatasetId, Digest, FailurePoint, JobId, Layout, Preparation, ProblemType,
        failure_point::reach,
    },
    http::{
        datasets::{
            form::{FORM, receive_form},
            received::{ARCHIVES, ReceivedDataset, receive},
        },
        problem::{ApiResult, ProblemResponse},
        request::{
            CreateOutcome, CreateRequest, Parameters, Resource, expect_media_type, idempotency, idempotent,
            media_type, prefer, read_json,
        },
        state::AppState,
    },
    store::{BlobRef, IdempotentRequest, JobDataset, JobRecord, NewJob, PriorRequest},
};

const JSON: &str = "application/json";

/// `POST /v1/jobs`.
pub(crate) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    expect_media_type(&headers, &[&ARCHIVES[..], &[FORM, JSON]].concat())?;
    let request = CreateRequest { state: &state, caller, uri: &uri, headers: &headers };
    let mut body = body.into_data_stream();
    let outcome = match media_type(&headers).as_deref() {
        Some(JSON) => from_scene(request, &mut body).await?,
        Some(FORM) => from_form(request, &mut body).await?,
        _ => from_archive(request, &mut body).await?,
    };
    if let CreateOutcome::Created(record) = &outcome {
        let id = record.job.id;
        tracing::info!(job = %id, bytes = record.dataset.bytes, "job {id} is queued");
        reach(FailurePoint::AfterCreate);
    }
    respond(&state, outcome, &headers).await
}

/// 201 with the job; with `Prefer: wait`, once the job has finished or the time is up.
pub(crate) async fn respond(
    state: &AppState,
    outcome: CreateOutcome<JobRecord>,
    headers: &HeaderMap,
) -> ApiResult {
    let (record, replayed) = match outcome {
        CreateOutcome::Created(record) => (record, false),
        CreateOutcome::Replayed(record) => (record, true),
    };
    let id = record.job.id;
    let (record, waited) = prefer::finished(state, record, prefer::wait(headers)).await?;
    let record = record.ok_or_else(|| ProblemResponse::no_job(id))?;
    let location = HeaderValue::try_from(href(id))?;
    let mut response = (StatusCode::CREATED, representation(record)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::LOCATION, location);
    prefer::mark_applied(headers, waited);
    if replayed {
        idempotency::mark_replayed(headers);
    }
    Ok(response)
}

async fn from_scene(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<JobRecord>> {
    let CreateRequest { state, caller, uri, headers } = request;
    Parameters::parse(uri.query())?.finish()?;
    let guard = request.begin()?;
    let content = read_json(body, headers, &state.limits).await?;
    let intent = request.intent(guard.as_ref(), Digest::of(&content));
    let create = async {
        let (id, wanted) = CreateJobRequest::from_json(&content)?;
        let scene = state.store().dataset(id).await?.filter(|scene| caller.may_see(scene.project));
        let scene = scene.ok_or_else(|| ProblemResponse::no_scene(id))?;
        state.reservations.require_free_space(0)?;
        // An administrator's request may name another project's scene.
        let dataset = (scene.dataset, scene.summary.layout);
        let job = NewJob { project: scene.project, ..new_job(request, wanted, dataset).await? };
        Ok(state.store().create_job(NewJob { dataset_id: Some(id), intent: intent.clone(), ..job }).await)
    };
    idempotent(request, intent.clone(), create).await
}

async fn from_archive(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<JobRecord>> {
    let CreateRequest { state, caller, uri, headers } = request;
    let wanted = CreateJobRequest::from_query(Parameters::parse(uri.query())?)?;
    let guard = request.begin()?;
    let _slot = state.upload_slot(caller.project)?;
    let received = receive(state, caller.project, headers, body).await?;
    let intent = request.intent(guard.as_ref(), received.blob().digest);
    from_received(request, wanted, received, intent).await
}

async fn from_form(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<JobRecord>> {
    let CreateRequest { state, caller, uri, headers } = request;
    let parameters = Parameters::parse(uri.query())?;
    let guard = request.begin()?;
    let _slot = state.upload_slot(caller.project)?;
    let form = receive_form(state, caller.project, headers, body).await?;
    let intent = request.intent(guard.as_ref(), form.digest()?);
    let wanted = CreateJobRequest::from_query(parameters.with(form.fields)?)?;
    from_received(request, wanted, form.dataset, intent).await
}

async fn from_received(
    request: CreateRequest<'_>,
    wanted: CreateJobRequest,
    received: ReceivedDataset,
    intent: Option<IdempotentRequest>,
) -> ApiResult<CreateOutcome<JobRecord>> {
    let state = request.state;
    let create = async {
        let (received, summary) = received.check(state, wanted.options.reading()).await?;
        let job = new_job(request, wanted, (received.blob(), summary.layout)).await?;
        let own_dataset = Some(JobDataset { id: DatasetId(state.services.new_uuid()), summary });
        let job = NewJob { own_dataset, intent: intent.clone(), ..job };
        let store = state.services.store.clone();
        received.keep(state, async move { store.create_job(job).await }).await
    };
    idempotent(request, intent.clone(), create).await
}

async fn new_job(
    request: CreateRequest<'_>,
    wanted: CreateJobRequest,
    (dataset, layout): (BlobRef, Layout),
) -> ApiResult<NewJob> {
    let CreateRequest { state, caller, .. } = request;
    Ok(NewJob {
        needs: Preparation::of(layout),
        project: caller.project,
        key: caller.key,
        name: wanted.name,
        metadata: wanted.metadata,
        priority: wanted.priority,
        deadline_at: deadline(state, wanted.deadline_s).await?,
        ..NewJob::new(JobId(state.services.new_uuid()), wanted.options, dataset)
    })
}

impl Resource for JobRecord {
    async fn load(state: &AppState, caller: Caller, remembered: &PriorRequest) -> ApiResult<Self> {
        let record = match remembered.resource.parse::<JobId>() {
            Ok(id) => state.store().job(id).await?,
            Err(_) => None,
        };
        let record = record.filter(|record| caller.may_see(record.project));
        record.ok_or_else(|| idempotency::not_replayable(ProblemType::JobNotFound, "job", remembered))
    }
}
