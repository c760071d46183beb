//! `POST /v1/datasets`: creates a dataset from the archive in the body or in a form, or from a finished upload.

use axum::{
    body::{Body, BodyDataStream},
    extract::State,
    http::{HeaderMap, HeaderValue, StatusCode, Uri, header},
};
use serde::Deserialize;

use super::{
    find,
    form::{FORM, receive_form},
    naming::Naming,
    received::{ARCHIVES, ReceivedDataset, receive},
    representation,
};
use crate::{
    domain::{
        Caller, DatasetId, Digest, MaskMode, MaskSource, ProblemType, ProjectId, ReadOptions, UploadId,
    },
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{
            CreateOutcome, CreateRequest, JsonBody, Parameters, Resource, content_digest, expect_no_coding,
            idempotency, idempotent, media_type, parse_json, read_json,
        },
        shared::Slot,
        state::AppState,
        uploads::{self, tus::Metadata},
    },
    store::{
        DatasetCreation, DatasetRecord, IdempotentRequest, NewDataset, PriorRequest, StoreError, UploadFile,
        UploadRecord,
    },
};

/// Longest name, in characters.
const MAX_NAME: usize = 200;

/// A scene with the status of the answer: 201, or 200 if the project had it before.
#[derive(Debug)]
struct CreatedScene {
    status: StatusCode,
    record: DatasetRecord,
}

/// What a scene has besides its archive.
struct SceneFields {
    project: ProjectId,
    name: Option<String>,
    upload: Option<UploadId>,
    read: ReadOptions,
    intent: Option<IdempotentRequest>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CreateSceneRequest {
    upload_id: String,
    name: Option<String>,
    #[serde(default)]
    skip_missing: bool,
    #[serde(default)]
    masks: MaskSource,
    #[serde(default)]
    mask_mode: MaskMode,
}

impl JsonBody for CreateSceneRequest {
    const EXPECTED: &'static str = "{\"upload_id\": ID, \"name\": TEXT, \"skip_missing\": BOOLEAN, \"masks\": TEXT, \"mask_mode\": TEXT}";
}

/// `POST /v1/datasets`.
pub(crate) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    naming: Naming,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    let request = CreateRequest { state: &state, caller, uri: &uri, headers: &headers };
    let mut body = body.into_data_stream();
    expect_no_coding(&headers)?;
    let outcome = match media_type(&headers).as_deref() {
        Some(given) if ARCHIVES.contains(&given) => from_archive(request, &mut body).await?,
        Some(FORM) => from_form(request, &mut body).await?,
        Some("application/json") => from_upload(request, &mut body).await?,
        given => {
            let detail = format!(
                "the Content-Type is {}; send application/zip, application/octet-stream, video/mp4, video/quicktime or {FORM}, or \
                 application/json with the id of an upload",
                given.unwrap_or("missing")
            );
            return Err(ProblemType::UnsupportedMediaType.because(detail));
        }
    };
    let (CreatedScene { status, record }, replayed) = match outcome {
        CreateOutcome::Created(scene) => (scene, false),
        CreateOutcome::Replayed(scene) => (scene, true),
    };
    let location = HeaderValue::try_from(naming.href(record.id))?;
    let mut response = representation(record, naming);
    *response.status_mut() = status;
    response.headers_mut().insert(header::LOCATION, location);
    if replayed {
        idempotency::mark_replayed(response.headers_mut());
    }
    Ok(response)
}

async fn from_archive(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<CreatedScene>> {
    let CreateRequest { state, caller, uri, headers } = request;
    let (name, read) = fields_of(Parameters::parse(uri.query())?)?;
    let announced = content_digest::announced(headers)?;
    let guard = request.begin()?;
    let project = caller.project;
    let _slot = state.upload_slot(project)?;
    let received = receive(state, project, headers, body).await?;
    content_digest::check(announced, received.blob().digest)?;
    let intent = request.intent(guard.as_ref(), received.blob().digest);
    let fields = SceneFields { project, name, upload: None, read, intent: intent.clone() };
    idempotent(request, intent, keep(state, received, fields)).await
}

async fn from_form(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<CreatedScene>> {
    let CreateRequest { state, caller, uri, headers } = request;
    let parameters = Parameters::parse(uri.query())?;
    content_digest::refuse(headers, "the digest of a form is not checked; send the archive as the body")?;
    let guard = request.begin()?;
    let project = caller.project;
    let _slot = state.upload_slot(project)?;
    let form = receive_form(state, project, headers, body).await?;
    let intent = request.intent(guard.as_ref(), form.digest()?);
    let (name, read) = fields_of(parameters.with(form.fields)?)?;
    let fields = SceneFields { project, name, upload: None, read, intent: intent.clone() };
    idempotent(request, intent, keep(state, form.dataset, fields)).await
}

/// The name, and how the files are read, by the query or a form.
fn fields_of(mut parameters: Parameters) -> ApiResult<(Option<String>, ReadOptions)> {
    let name = parameters.take("name").map(checked_name).transpose()?;
    let skip_missing = parameters.take_as("skip_missing", "true or false")?.unwrap_or(false);
    let mask_mode = parameters.take_as("mask_mode", "auto, ignore or cut_out")?.unwrap_or_default();
    let masks = parameters.take("masks").map(|text| {
        // Not trimmed, since the name of a folder may begin with a space.
        text.parse::<MaskSource>()
            .map_err(|error| ProblemResponse::parameter("masks", format!("'{text}' is {error}")))
    });
    let masks = masks.transpose()?.unwrap_or_default();
    parameters.finish()?;
    Ok((name, ReadOptions { skip_missing, masks, mask_mode, ..ReadOptions::default() }))
}

async fn from_upload(
    request: CreateRequest<'_>,
    body: &mut BodyDataStream,
) -> ApiResult<CreateOutcome<CreatedScene>> {
    let CreateRequest { state, caller, uri, headers } = request;
    Parameters::parse(uri.query())?.finish()?;
    let content = read_json(body, headers, &state.limits).await?;
    let CreateSceneRequest { upload_id, name, skip_missing, masks, mask_mode } = parse_json(&content)?;
    let read = ReadOptions { skip_missing, masks, mask_mode, ..ReadOptions::default() };
    let name = name.map(checked_name).transpose()?;
    let guard = request.begin()?;
    let intent = request.intent(guard.as_ref(), Digest::of(&content));
    let create = async {
        let found = uploads::find(state, &caller, &upload_id).await?;
        if let Some(scene) = found.dataset_id {
            let record = find(state, &caller, &scene.to_string()).await?;
            return Ok(Ok(CreatedScene { status: StatusCode::OK, record }));
        }
        let (record, file) = uploads::lock(state, found.id, StatusCode::CONFLICT).await?;
        if !record.is_complete() {
            return Err(ProblemType::UploadIncomplete.because(format!(
                "upload {} is incomplete: {} of {} bytes received",
                record.id, record.received, record.length
            )));
        }
        let (received, _slot) = assemble(state, &record, file).await?;
        let from_metadata = || {
            let metadata = Metadata::parse(record.metadata.as_deref()?).ok()?;
            let name = metadata.get("name").or_else(|| metadata.get("filename"))?;
            checked_name(name.to_owned()).ok()
        };
        let name = name.or_else(from_metadata);
        // An administrator's request may name another project's upload.
        let project = record.project;
        let fields = SceneFields { project, name, upload: Some(record.id), read, intent: intent.clone() };
        let created = keep(state, received, fields).await?;
        if created.is_ok()
            && let Err(error) = state.blobs().remove_upload(record.id).await
        {
            tracing::warn!(upload = %record.id, error = &error as &dyn std::error::Error, "the file of upload {} is not removed yet: {error}", record.id);
        }
        Ok(created)
    };
    idempotent(request, intent.clone(), create).await
}

/// The archive of a complete upload, which takes a place as the body of a request does. In a folder it is the upload's file; from a bucket it
/// is read into a new one, which takes space too.
async fn assemble(
    state: &AppState,
    upload: &UploadRecord,
    file: UploadFile,
) -> ApiResult<(ReceivedDataset, Slot<ProjectId>)> {
    let slot = state.upload_slot(upload.project)?;
    let _reservation = match state.blobs().shared_files() {
        Some(_) => Some(state.reservations.reserve_disk(upload.length).await?),
        None => None,
    };
    Ok((ReceivedDataset::of_upload(file.finish(upload.length).await?), slot))
}

/// Checks and publishes the archive and creates its scene, unless its project has one of it.
async fn keep(
    state: &AppState,
    received: ReceivedDataset,
    fields: SceneFields,
) -> ApiResult<Result<CreatedScene, StoreError>> {
    let SceneFields { project, name, upload, read, intent } = fields;
    let dataset = received.blob();
    let known = state.store().dataset_by_archive(project, dataset.digest).await?;
    let (received, summary) = match known {
        Some(known) if known.kept => (received, known.summary),
        // One that came with a job may have been checked by its options.
        _ => received.check(state, read).await?,
    };
    let new = NewDataset {
        id: DatasetId(state.services.new_uuid()),
        project,
        name,
        dataset,
        summary,
        upload,
        intent,
    };
    let store = state.services.store.clone();
    let created = received.keep(state, async move { store.create_dataset(new).await }).await?;
    Ok(created.map(|creation| match creation {
        DatasetCreation::Created(record) => {
            tracing::info!(scene = %record.id, bytes = dataset.bytes, "scene {} is created", record.id);
            CreatedScene { status: StatusCode::CREATED, record }
        }
        DatasetCreation::Existing(record) => CreatedScene { status: StatusCode::OK, record },
    }))
}

impl Resource for CreatedScene {
    async fn load(state: &AppState, caller: Caller, remembered: &PriorRequest) -> ApiResult<Self> {
        let record = match remembered.resource.parse::<DatasetId>() {
            Ok(id) => state.store().dataset(id).await?,
            Err(_) => None,
        };
        let record = record
            .filter(|record| caller.may_see(record.project))
            .ok_or_else(|| idempotency::not_replayable(ProblemType::SceneNotFound, "scene", remembered))?;
        Ok(Self { status: StatusCode::from_u16(remembered.status).unwrap_or(StatusCode::CREATED), record })
    }
}

fn checked_name(name: String) -> ApiResult<String> {
    let length = name.chars().count();
    if !(1..=MAX_NAME).contains(&length) || name.chars().any(char::is_control) {
        let error = format!("is not 1 to {MAX_NAME} characters without control characters");
        return Err(ProblemResponse::parameter("name", error));
    }
    Ok(name)
}
