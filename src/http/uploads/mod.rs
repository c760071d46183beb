//! Resumable uploads over tus 1.0.0: create, ask for the offset, send a part, abort.
//!
//! The space of an upload is reserved when it is created. Its file has one writer at a time; a second is answered 423.

mod part;
pub(super) mod tus;

use axum::{
    body::{Body, BodyDataStream},
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use jiff::{SignedDuration, Timestamp};
use tracing::Instrument as _;

use self::{
    part::Part,
    tus::{AppendPartRequest, CreateUploadRequest, Metadata},
};
use super::{
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType, UploadId},
    store::{NewUpload, UploadFile, UploadRecord},
};

/// The upload that a path or a body names.
///
/// # Errors
/// 404 if there is none, and if it is another's.
pub(super) async fn find(state: &AppState, caller: &Caller, id: &str) -> ApiResult<UploadRecord> {
    let parsed: UploadId = id.parse().map_err(|_| ProblemResponse::no_upload(id))?;
    let record = state.store().upload(parsed).await?;
    record.filter(|record| caller.may_see(record.project)).ok_or_else(|| ProblemResponse::no_upload(id))
}

/// 410 unless the upload still takes bytes.
async fn expect_open(state: &AppState, record: UploadRecord) -> ApiResult<UploadRecord> {
    if record.is_open(state.store().time().await?) { Ok(record) } else { Err(gone(record.id)) }
}

/// 410.
pub(super) fn gone(id: UploadId) -> ProblemResponse {
    ProblemType::UploadGone.because(format!("upload {id} has expired or was made a scene; begin another"))
}

/// Locks an upload's file, and reads the upload's row once no other request can change it.
///
/// # Errors
/// `held` if another request has locked it, 410 if it is over.
pub(super) async fn lock(
    state: &AppState,
    id: UploadId,
    held: StatusCode,
) -> ApiResult<(UploadRecord, UploadFile)> {
    let file = state.blobs().open_upload(id).await?.ok_or_else(|| {
        ProblemType::UploadLocked
            .because(format!(
                "another request writes to upload {id}; wait for its end and ask how far it came"
            ))
            .with_status(held)
    })?;
    let now = state.store().time().await?;
    match state.store().upload(id).await? {
        Some(record) if record.is_open(now) => Ok((record, file)),
        _ => {
            // Locking has made the file again, and no request asks for its removal any more.
            drop(file);
            state.blobs().remove_upload(id).await?;
            Err(gone(id))
        }
    }
}

/// When an upload that is written to now expires.
pub(super) async fn expiry(state: &AppState) -> ApiResult<Timestamp> {
    let life = SignedDuration::try_from(state.limits.upload_ttl).unwrap_or(SignedDuration::MAX);
    Ok(state.store().time().await?.checked_add(life).unwrap_or(Timestamp::MAX))
}

/// `OPTIONS /v1/uploads`.
pub(super) async fn options(State(state): State<AppState>) -> Response {
    let headers = [
        (tus::TUS_VERSION, tus::VERSION),
        (tus::EXTENSION, tus::EXTENSIONS),
        (tus::MAX_SIZE, HeaderValue::from(state.limits.resumable_bytes)),
        (tus::CHECKSUM_ALGORITHM, tus::ALGORITHMS),
    ];
    (StatusCode::NO_CONTENT, headers).into_response()
}

/// `POST /v1/uploads`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let record = begin(&state, &caller, parameters, &headers).await?;
    tracing::info!(upload = %record.id, bytes = record.length, "upload {} begins", record.id);
    let location = HeaderValue::try_from(format!("/v1/uploads/{}", record.id));
    let location = location?;
    let headers = [
        (header::LOCATION, location),
        (tus::OFFSET, HeaderValue::from(record.received)),
        (tus::EXPIRES, tus::date(record.expires_at)?),
    ];
    Ok((StatusCode::CREATED, headers).into_response())
}

async fn begin(
    state: &AppState,
    caller: &Caller,
    parameters: Parameters,
    headers: &HeaderMap,
) -> ApiResult<UploadRecord> {
    tus::expect_version(headers)?;
    parameters.finish()?;
    let CreateUploadRequest { length, metadata } = CreateUploadRequest::of(headers)?;
    let metadata = metadata.map(Metadata::into_text);
    let limit = state.limits.resumable_bytes;
    if length > limit {
        return Err(ProblemResponse::too_large(limit).with_header(tus::MAX_SIZE, HeaderValue::from(limit)));
    }
    // Until the upload's own row reserves the space.
    let _reservation = state.reservations.reserve(caller.project, length).await?;
    let id = UploadId(state.services.new_uuid());
    let expires_at = expiry(state).await?;
    let new = NewUpload { id, project: caller.project, length, metadata, expires_at };
    Ok(state.store().create_upload(new).await?)
}

/// `HEAD /v1/uploads/{id}`.
pub(super) async fn head(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> ApiResult {
    tus::expect_version(&headers)?;
    let record = expect_open(&state, find(&state, &caller, &id).await?).await?;
    let mut response = StatusCode::OK.into_response();
    let headers = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    headers.insert(tus::OFFSET, HeaderValue::from(record.received));
    headers.insert(tus::LENGTH, HeaderValue::from(record.length));
    headers.insert(tus::EXPIRES, tus::date(record.expires_at)?);
    if let Some(metadata) = record.metadata {
        let metadata = HeaderValue::try_from(metadata)?;
        headers.insert(tus::METADATA, metadata);
    }
    Ok(response)
}

/// `PATCH /v1/uploads/{id}`.
pub(super) async fn append(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    let part = admit(&state, &caller, &id, &headers).await?;
    let record = receive(state, part, body.into_data_stream()).await?;
    let headers =
        [(tus::OFFSET, HeaderValue::from(record.received)), (tus::EXPIRES, tus::date(record.expires_at)?)];
    Ok((StatusCode::NO_CONTENT, headers).into_response())
}

/// `POST /v1/uploads/{id}` with `X-HTTP-Method-Override`: another method of the upload, from behind a proxy that lets only POST through.
pub(super) async fn overridden(
    state: State<AppState>,
    caller: Caller,
    path: Path<String>,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    match headers.get(tus::METHOD_OVERRIDE).map(HeaderValue::as_bytes) {
        Some(b"PATCH") => append(state, caller, path, headers, body).await,
        Some(b"DELETE") => Ok(delete(state, caller, path, headers).await?.into_response()),
        Some(b"HEAD") => head(state, caller, path, headers).await,
        _ => {
            let detail =
                "POST stands for another method here: send X-HTTP-Method-Override: PATCH, DELETE or HEAD";
            let allowed = HeaderValue::from_static("HEAD, PATCH, DELETE, POST");
            Err(ProblemType::MethodNotAllowed.because(detail).with_header(header::ALLOW, allowed))
        }
    }
}

/// Checks that the request sends the next part, and locks the upload.
async fn admit(state: &AppState, caller: &Caller, id: &str, headers: &HeaderMap) -> ApiResult<Part> {
    tus::expect_version(headers)?;
    let AppendPartRequest { offset, checksum } = AppendPartRequest::of(headers)?;
    let found = expect_open(state, find(state, caller, id).await?).await?;
    let (record, file) = lock(state, found.id, StatusCode::LOCKED).await?;
    if offset != record.received {
        let detail = format!(
            "the part begins at byte {offset}, and upload {} has {} bytes; go on from there",
            record.id, record.received
        );
        return Err(ProblemType::OffsetMismatch
            .because(detail)
            .with_header(tus::OFFSET, HeaderValue::from(record.received)));
    }
    let left = record.length - record.received;
    let announced = headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse().ok());
    if announced.is_some_and(|announced: u64| announced > left) {
        return Err(ProblemResponse::too_large(left));
    }
    let room = match state.blobs().shared_files() {
        // Its bytes are promised to it since it was created.
        None => {
            state.reservations.require_free_space(announced.unwrap_or(0))?;
            None
        }
        Some(_) => Some(part::reserve(state, announced.unwrap_or(left), checksum.is_some()).await?),
    };
    Part::new(record, file, checksum, room).await
}

/// Writes a part, to its end even if the client disconnects: received bytes are kept.
async fn receive(state: AppState, part: Part, mut body: BodyDataStream) -> ApiResult<UploadRecord> {
    let writing = async move {
        let _slot = state.upload_slot(part.project())?;
        part.receive(&state, &mut body).await
    };
    tokio::spawn(writing.in_current_span()).await?
}

/// `DELETE /v1/uploads/{id}`.
pub(super) async fn delete(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> ApiResult<StatusCode> {
    tus::expect_version(&headers)?;
    let found = expect_open(&state, find(&state, &caller, &id).await?).await?;
    let (record, file) = lock(&state, found.id, StatusCode::LOCKED).await?;
    if !state.store().delete_upload(record.id).await? {
        return Err(gone(record.id));
    }
    drop(file);
    state.blobs().remove_upload(record.id).await?;
    Ok(StatusCode::NO_CONTENT)
}
