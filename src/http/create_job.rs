//! `POST /v1/jobs`: a job of the archive in the body, or of a scene that was sent before.

use std::sync::Arc;

use axum::{
    body::{Body, BodyDataStream},
    extract::State,
    http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header},
    response::{IntoResponse as _, Response},
};
use jiff::Timestamp;
use tokio::task::spawn_blocking;

use super::{
    body::{expect_media_type, media_type, read_json},
    create_scene::new_uuid,
    idempotency::{self, Keyed},
    job_body::href,
    job_wish::{JobWish, deadline},
    jobs::representation,
    prefer,
    problem::Fault,
    query::Parameters,
    received::receive,
    space::expect_above_floor,
    state::AppState,
};
use crate::{
    domain::{Caller, Digest, JobId},
    store::{BlobRef, IdempotentRequest, JobRecord, NewJob, PriorRequest, StoreError},
};

const ZIP: &str = "application/zip";
const JSON: &str = "application/json";

/// A request as far as its headers and address tell.
struct Asked<'a> {
    caller: Caller,
    uri: &'a Uri,
    headers: &'a HeaderMap,
}

/// `POST /v1/jobs`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let asked = Asked { caller, uri: &uri, headers: &headers };
    let made = make(&state, &asked, &mut body.into_data_stream()).await?;
    answer(&state, made, &headers).await
}

/// What a request that makes a job came to.
#[derive(Debug)]
pub(super) enum Made {
    /// It made this one.
    Now(JobRecord),
    /// One like it made this one before.
    Before(JobRecord),
}

/// 201 with the job, once it has finished if the request is willing to wait.
pub(super) async fn answer(state: &AppState, made: Made, headers: &HeaderMap) -> Result<Response, Fault> {
    let (record, replayed) = match made {
        Made::Now(record) => (record, false),
        Made::Before(record) => (record, true),
    };
    let id = record.job.id;
    let (record, waited) = prefer::finished(state, record, prefer::wait(headers)).await?;
    let record = record.ok_or_else(|| Fault::no_job(&id.to_string()))?;
    let location = HeaderValue::try_from(href(id)).map_err(|error| Fault::internal(&error))?;
    let mut response = (StatusCode::CREATED, representation(record)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::LOCATION, location);
    prefer::mark_applied(headers, waited);
    if replayed {
        idempotency::mark_replayed(headers);
    }
    Ok(response)
}

async fn make(state: &AppState, asked: &Asked<'_>, body: &mut BodyDataStream) -> Result<Made, Fault> {
    expect_media_type(asked.headers, &[ZIP, "application/x-zip-compressed", JSON])?;
    if media_type(asked.headers).as_deref() == Some(JSON) {
        of_scene(state, asked, body).await
    } else {
        of_archive(state, asked, body).await
    }
}

async fn of_scene(state: &AppState, asked: &Asked<'_>, body: &mut BodyDataStream) -> Result<Made, Fault> {
    Parameters::parse(asked.uri.query())?.finish()?;
    let keyed = idempotency::begin(state, &asked.caller, asked.headers)?;
    let content = read_json(body, asked.headers, state.limits()).await?;
    let intent = asked.intent(keyed.as_ref(), Digest::of(&content));
    if let Some(before) = made_before(state, intent.as_ref()).await? {
        return Ok(before);
    }
    let (id, wish) = JobWish::from_json(&content)?;
    let scene = state.store().dataset(id).await?.filter(|scene| asked.caller.may_see(scene.owner));
    let scene = scene.ok_or_else(|| Fault::no_scene(id))?;
    expect_above_floor(state, 0)?;
    let new =
        NewJob { dataset_id: Some(id), intent: intent.clone(), ..asked.job(state, wish, scene.dataset) };
    queued(state, state.store().create_job(new).await, intent.as_ref()).await
}

async fn of_archive(state: &AppState, asked: &Asked<'_>, body: &mut BodyDataStream) -> Result<Made, Fault> {
    let wish = JobWish::from_query(Parameters::parse(asked.uri.query())?)?;
    let keyed = idempotency::begin(state, &asked.caller, asked.headers)?;
    let place = state.uploads().try_acquire();
    let _place = place.map_err(|_| Fault::busy("too many datasets are being received"))?;
    let received = receive(state, asked.caller.key, asked.headers, body).await?;
    let intent = asked.intent(keyed.as_ref(), received.blob().digest);
    if let Some(before) = made_before(state, intent.as_ref()).await? {
        return Ok(before);
    }
    let check = state.services().check.clone();
    let (received, checked) = spawn_blocking(move || {
        let checked = check(received.path());
        (received, checked)
    })
    .await
    .map_err(|error| Fault::internal(&error))?;
    checked?;
    let new = NewJob { intent: intent.clone(), ..asked.job(state, wish, received.blob()) };
    let store = Arc::clone(&state.services().store);
    let created = received.keep(state, async move { store.create_job(new).await }).await?;
    queued(state, created, intent.as_ref()).await
}

impl Asked<'_> {
    fn intent(&self, keyed: Option<&Keyed>, body: Digest) -> Option<IdempotentRequest> {
        keyed.map(|keyed| keyed.intent(&Method::POST, self.uri, body))
    }

    fn job(&self, state: &AppState, wish: JobWish, dataset: BlobRef) -> NewJob {
        let now = state.services().clock.now();
        NewJob {
            owner: self.caller.key,
            priority: wish.priority,
            deadline_at: deadline(now, wish.deadline_s),
            ..NewJob::new(new_id(now), wish.options, dataset)
        }
    }
}

/// The job that was put into the queue, or the one that its request's key made already.
async fn queued(
    state: &AppState,
    created: Result<JobRecord, StoreError>,
    intent: Option<&IdempotentRequest>,
) -> Result<Made, Fault> {
    match created {
        Ok(record) => {
            let id = record.job.id;
            tracing::info!(job = %id, bytes = record.dataset.bytes, "job {id} is queued");
            Ok(Made::Now(record))
        }
        Err(error) => made_meanwhile(state, intent, error).await,
    }
}

/// The job that a request like this one made before.
pub(super) async fn made_before(
    state: &AppState,
    intent: Option<&IdempotentRequest>,
) -> Result<Option<Made>, Fault> {
    let Some(intent) = intent else { return Ok(None) };
    let Some(found) = idempotency::earlier(state, intent).await? else { return Ok(None) };
    remembered(state, &found).await.map(Some)
}

/// The job that a request like this one has just made in another process, if that is what is wrong.
pub(super) async fn made_meanwhile(
    state: &AppState,
    intent: Option<&IdempotentRequest>,
    error: StoreError,
) -> Result<Made, Fault> {
    match (error, intent) {
        (StoreError::IdempotencyKeyUsed(found), Some(intent)) => {
            remembered(state, &idempotency::same(intent, *found)?).await
        }
        (error, _) => Err(error.into()),
    }
}

async fn remembered(state: &AppState, found: &PriorRequest) -> Result<Made, Fault> {
    let record = match found.resource.parse::<JobId>() {
        Ok(id) => state.store().job(id).await?,
        Err(_) => None,
    };
    record.map(Made::Before).ok_or_else(|| {
        Fault::new(
            StatusCode::NOT_FOUND,
            "job-not-found",
            "No such job",
            format!(
                "an earlier request with this Idempotency-Key made job {}, which has been deleted; use a fresh key for \
                 another",
                found.resource
            ),
        )
    })
}

/// An id whose time part is the service's clock, so that ids sort as jobs were made.
pub(super) fn new_id(now: Timestamp) -> JobId {
    JobId(new_uuid(now))
}
