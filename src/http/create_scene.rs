//! `POST /v1/scenes`: a scene of an archive in the body, or of a finished upload.

use std::sync::Arc;

use axum::{
    body::{Body, BodyDataStream},
    extract::State,
    http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header},
    response::Response,
};
use jiff::Timestamp;
use serde::Deserialize;
use tokio::task::spawn_blocking;
use uuid::{NoContext, Uuid};

use super::{
    body::{media_type, read_json},
    content_digest,
    idempotency::{self, Keyed},
    problem::Fault,
    query::Parameters,
    received::{Received, receive},
    scene_body::href,
    scenes::{find, representation},
    state::AppState,
    tus::Metadata,
    uploads,
};
use crate::{
    domain::{Caller, DatasetSummary, Digest, SceneId, UploadId},
    store::{DatasetCreation, DatasetRecord, IdempotentRequest, NewDataset, PriorRequest, StoreError},
};

/// Longest name, in characters.
const MAX_NAME: usize = 200;

/// A request as far as its headers and address tell.
struct Asked<'a> {
    state: &'a AppState,
    caller: Caller,
    uri: &'a Uri,
    headers: &'a HeaderMap,
}

/// What a request came to.
struct Made {
    status: StatusCode,
    record: DatasetRecord,
    replayed: bool,
}

/// What a scene is made of besides its archive.
struct Wish {
    name: Option<String>,
    upload: Option<UploadId>,
    intent: Option<IdempotentRequest>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OfUpload {
    upload_id: String,
    #[serde(default)]
    name: Option<String>,
}

/// `POST /v1/scenes`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let asked = Asked { state: &state, caller, uri: &uri, headers: &headers };
    let made = asked.make(&mut body.into_data_stream()).await?;
    let location = HeaderValue::try_from(href(made.record.id)).map_err(|error| Fault::internal(&error))?;
    let mut response = representation(made.record);
    *response.status_mut() = made.status;
    response.headers_mut().insert(header::LOCATION, location);
    if made.replayed {
        idempotency::mark_replayed(response.headers_mut());
    }
    Ok(response)
}

impl Asked<'_> {
    async fn make(&self, body: &mut BodyDataStream) -> Result<Made, Fault> {
        match media_type(self.headers).as_deref() {
            Some("application/zip" | "application/x-zip-compressed") => self.of_archive(body).await,
            Some("application/json") => self.of_upload(body).await,
            given => Err(Fault::new(
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "unsupported-media-type",
                "Unsupported media type",
                format!(
                    "the Content-Type is {}; send application/zip, or application/json with the id of an upload",
                    given.unwrap_or("missing")
                ),
            )),
        }
    }

    async fn of_archive(&self, body: &mut BodyDataStream) -> Result<Made, Fault> {
        let mut parameters = Parameters::parse(self.uri.query())?;
        let name = parameters.take("name").map(|name| checked_name("name", name)).transpose()?;
        parameters.finish()?;
        let announced = content_digest::announced(self.headers)?;
        let keyed = idempotency::begin(self.state, &self.caller, self.headers)?;
        let place = self.state.uploads().try_acquire();
        let _place = place.map_err(|_| Fault::busy("too many datasets are being received"))?;
        let received = receive(self.state, self.caller.key, self.headers, body).await?;
        content_digest::check(announced, received.blob().digest)?;
        let intent = self.intent(keyed.as_ref(), received.blob().digest);
        if let Some(before) = self.made_before(intent.as_ref()).await? {
            return Ok(before);
        }
        self.keep(received, Wish { name, upload: None, intent }).await
    }

    async fn of_upload(&self, body: &mut BodyDataStream) -> Result<Made, Fault> {
        Parameters::parse(self.uri.query())?.finish()?;
        let content = read_json(body, self.headers, self.state.limits()).await?;
        let wish: OfUpload = serde_json::from_slice(&content).map_err(|error| bad_json(&error))?;
        let name = wish.name.map(|name| checked_name("name", name)).transpose()?;
        let keyed = idempotency::begin(self.state, &self.caller, self.headers)?;
        let intent = self.intent(keyed.as_ref(), Digest::of(&content));
        if let Some(before) = self.made_before(intent.as_ref()).await? {
            return Ok(before);
        }
        let found = uploads::find(self.state, &self.caller, &wish.upload_id).await?;
        if let Some(scene) = found.dataset_id {
            let record = find(self.state, &self.caller, &scene.to_string()).await?;
            return Ok(Made { status: StatusCode::OK, record, replayed: false });
        }
        let (record, file) = uploads::take_hold(self.state, found.id, StatusCode::CONFLICT).await?;
        if !record.is_complete() {
            return Err(Fault::new(
                StatusCode::CONFLICT,
                "upload-incomplete",
                "Upload incomplete",
                format!(
                    "{} of the {} bytes of upload {} have come; send the rest first",
                    record.received, record.length, record.id
                ),
            ));
        }
        let received = Received::of_upload(file.finish(record.length).await?);
        let told = || {
            let metadata = Metadata::parse(record.metadata.as_deref()?).ok()?;
            let name = metadata.get("name").or_else(|| metadata.get("filename"))?;
            checked_name("name", name.to_owned()).ok()
        };
        let name = name.or_else(told);
        let made = self.keep(received, Wish { name, upload: Some(record.id), intent }).await?;
        if let Err(error) = self.state.blobs().remove_upload(record.id).await {
            tracing::warn!(upload = %record.id, error = &error as &dyn std::error::Error, "the file of upload {} stays for a while: {error}", record.id);
        }
        Ok(made)
    }

    fn intent(&self, keyed: Option<&Keyed>, body: Digest) -> Option<IdempotentRequest> {
        keyed.map(|keyed| keyed.intent(&Method::POST, self.uri, body))
    }

    /// Checks and publishes the archive and makes a scene of it, unless its owner has one.
    async fn keep(&self, received: Received, wish: Wish) -> Result<Made, Fault> {
        let (owner, dataset) = (self.caller.key, received.blob());
        let known = self.state.store().dataset_by_archive(owner, dataset.digest).await?;
        let (received, summary) = match known {
            Some(known) => (received, known.summary),
            None => self.check(received).await?,
        };
        let id = new_id(self.state.services().clock.now());
        let intent = wish.intent.clone();
        let Wish { name, upload, .. } = wish;
        let new = NewDataset { id, owner, name, dataset, summary, upload, intent: wish.intent };
        let store = Arc::clone(&self.state.services().store);
        match received.keep(self.state, async move { store.create_dataset(new).await }).await? {
            Ok(DatasetCreation::Created(record)) => {
                tracing::info!(scene = %record.id, bytes = dataset.bytes, "scene {} is kept", record.id);
                Ok(Made { status: StatusCode::CREATED, record, replayed: false })
            }
            Ok(DatasetCreation::Existing(record)) => {
                Ok(Made { status: StatusCode::OK, record, replayed: false })
            }
            Err(StoreError::IdempotencyKeyUsed(found)) if intent.is_some() => {
                let found = match &intent {
                    Some(intent) => idempotency::same(intent, *found)?,
                    None => *found,
                };
                self.remembered(&found).await
            }
            Err(error) => Err(error.into()),
        }
    }

    async fn check(&self, received: Received) -> Result<(Received, DatasetSummary), Fault> {
        let check = self.state.services().check.clone();
        let checked = spawn_blocking(move || {
            let checked = check(received.path());
            (received, checked)
        });
        let (received, checked) = checked.await.map_err(|error| Fault::internal(&error))?;
        Ok((received, checked?))
    }

    async fn made_before(&self, intent: Option<&IdempotentRequest>) -> Result<Option<Made>, Fault> {
        let Some(intent) = intent else { return Ok(None) };
        let Some(found) = idempotency::earlier(self.state, intent).await? else { return Ok(None) };
        self.remembered(&found).await.map(Some)
    }

    async fn remembered(&self, found: &PriorRequest) -> Result<Made, Fault> {
        let record = match found.resource.parse::<SceneId>() {
            Ok(id) => self.state.store().dataset(id).await?,
            Err(_) => None,
        };
        let record = record.ok_or_else(|| {
            Fault::new(
                StatusCode::NOT_FOUND,
                "scene-not-found",
                "No such scene",
                format!(
                    "an earlier request with this Idempotency-Key made scene {}, which has been deleted; use a fresh \
                     key for another",
                    found.resource
                ),
            )
        })?;
        let status = StatusCode::from_u16(found.status).unwrap_or(StatusCode::CREATED);
        Ok(Made { status, record, replayed: true })
    }
}

fn checked_name(parameter: &str, name: String) -> Result<String, Fault> {
    let length = name.chars().count();
    if !(1..=MAX_NAME).contains(&length) || name.chars().any(char::is_control) {
        let fault = format!("is not 1 to {MAX_NAME} characters without control characters");
        return Err(Fault::parameter(parameter, fault));
    }
    Ok(name)
}

fn bad_json(error: &serde_json::Error) -> Fault {
    if error.is_data() {
        return Fault::parameter("body", format!("is not {{\"upload_id\": ID, \"name\": TEXT}}: {error}"));
    }
    let detail = format!("the body is not JSON: {error}");
    Fault::new(StatusCode::BAD_REQUEST, "malformed-json", "Malformed JSON", detail)
}

/// An id whose time part is the service's clock, so that ids sort as scenes were made.
fn new_id(now: Timestamp) -> SceneId {
    SceneId(new_uuid(now))
}

/// A UUID of version 7 of an instant.
pub(super) fn new_uuid(now: Timestamp) -> Uuid {
    let seconds = u64::try_from(now.as_second()).unwrap_or(0);
    let nanoseconds = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
    Uuid::new_v7(uuid::Timestamp::from_unix(NoContext, seconds, nanoseconds))
}
