//! A job's files: the trained scene, a list of all files, and each by its hash.

mod download;
pub(super) mod exports;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, Method, header},
    response::IntoResponse,
};
use serde::{Serialize, de::DeserializeOwned};
use serde_json::json;

pub(super) use self::download::in_pieces;
use self::download::{File, media_type, serve};
use super::{
    jobs::OwnedJob,
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{Etag, Parameters, not_modified},
    state::AppState,
};
use crate::{
    domain::{Caller, Digest, ExportFidelity, ProblemType},
    store::{ArtifactKind, BlobRef, JobRecord, SceneArtifact},
};

/// Takes the parameter that selects a file of a rate-distortion curve.
pub(super) fn take_lambda(parameters: &mut Parameters) -> ApiResult<Option<f64>> {
    parameters.take_as("lambda", "a number")
}

/// The job's file of weight `lambda`, or its first; 409 where there is none yet, 404 where none has that weight.
pub(super) fn file_of(record: &JobRecord, lambda: Option<f64>) -> ApiResult<SceneArtifact> {
    let first = record.scenes().next();
    let first = first.ok_or_else(|| ProblemResponse::no_file_yet(record.job.id, record.job.state.name()))?;
    match lambda {
        None => Ok(first),
        Some(_) => record.scenes().find(|scene| scene.lambda == lambda).ok_or_else(|| no_such_lambda(record)),
    }
}

fn no_such_lambda(record: &JobRecord) -> ProblemResponse {
    let known: Vec<String> =
        record.scenes().filter_map(|scene| scene.lambda).map(|lambda| lambda.to_string()).collect();
    let detail = if known.is_empty() {
        format!("job {} has one file, not the files of an rd_curve; leave out lambda", record.job.id)
    } else {
        format!("job {} has files of lambda {}", record.job.id, known.join(", "))
    };
    ProblemType::NoSuchLambda.because(detail)
}

/// The content of a JSON artifact, if the job has one of this kind.
pub(super) async fn document<T: DeserializeOwned>(
    state: &AppState,
    record: &JobRecord,
    kind: ArtifactKind,
) -> ApiResult<Option<T>> {
    let Some(blob) = record.artifact(kind) else { return Ok(None) };
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map(Some).map_err(|error| ProblemResponse::internal(&error))
}

/// `GET` and `HEAD /v1/jobs/{id}/artifact`.
pub(super) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    mut parameters: Parameters,
    method: Method,
    request: HeaderMap,
) -> ApiResult {
    let lambda = take_lambda(&mut parameters)?;
    parameters.finish()?;
    let SceneArtifact { format, lambda, blob } = file_of(&record, lambda)?;
    let file = File::new(record.job.id, ArtifactKind::Scene(format), lambda, blob);
    serve(&state, &method, &request, file).await
}

/// `GET` and `HEAD /v1/jobs/{id}/thumbnail`.
pub(super) async fn thumbnail(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    parameters: Parameters,
    method: Method,
    request: HeaderMap,
) -> ApiResult {
    parameters.finish()?;
    let id = record.job.id;
    let blob = record.artifact(ArtifactKind::Thumbnail).ok_or_else(|| {
        if record.scenes().next().is_none() {
            return ProblemResponse::no_file_yet(id, record.job.state.name());
        }
        let detail = format!("job {id} has no thumbnail; an earlier version finished it");
        ProblemType::ArtifactNotFound.because(detail)
    })?;
    serve(&state, &method, &request, File::new(id, ArtifactKind::Thumbnail, None, blob)).await
}

/// `GET /v1/jobs/{id}/preview`: what there is to see of the job.
pub(super) async fn preview(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let kinds: &[ArtifactKind] = match parameters.take("of").as_deref() {
        None | Some("render") => &[ArtifactKind::Preview, ArtifactKind::Thumbnail],
        Some("photograph") => &[ArtifactKind::PreviewPhotograph],
        Some(other) => {
            let error = format!("'{other}' is not one of render, photograph");
            return Err(ProblemResponse::parameter("of", error));
        }
    };
    parameters.finish()?;
    let found = kinds.iter().find_map(|kind| record.artifact(*kind)).ok_or_else(|| {
        let detail = format!("job {} has no such picture, or none yet", record.job.id);
        ProblemType::ArtifactNotFound.because(detail)
    })?;
    let etag = Etag::new(found.digest);
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let content = state.blobs().read(found.digest).await?;
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static("image/jpeg")),
        (header::ETAG, etag.value()),
        (header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache")),
    ];
    Ok((headers, content).into_response())
}

/// `GET` and `HEAD /v1/artifacts/{sha256}`.
pub(super) async fn by_hash(
    State(state): State<AppState>,
    caller: Caller,
    Path(hash): Path<String>,
    method: Method,
    request: HeaderMap,
) -> ApiResult {
    let found = match hash.parse::<Digest>() {
        Ok(digest) => state.store().file(digest, caller.visible_project()).await?,
        Err(_) => None,
    };
    let found = found.ok_or_else(|| {
        let detail = "no file of yours has this SHA-256; the artifacts of a job list what it has";
        ProblemType::ArtifactNotFound.because(detail)
    })?;
    serve(&state, &method, &request, found.into()).await
}

#[derive(Debug, Serialize)]
struct ListedFile {
    kind: &'static str,
    origin: &'static str,
    lambda: Option<f64>,
    bytes: u64,
    sha256: Digest,
    media_type: &'static str,
    gaussians: Option<u64>,
    sh_degree: Option<u8>,
    fidelity: Option<ExportFidelity>,
    href: String,
}

impl ListedFile {
    fn new(origin: &'static str, kind: ArtifactKind, lambda: Option<f64>, blob: BlobRef) -> Self {
        Self {
            kind: kind.name(),
            origin,
            lambda,
            bytes: blob.bytes,
            sha256: blob.digest,
            media_type: media_type(kind),
            gaussians: None,
            sh_degree: None,
            fidelity: None,
            href: format!("/v1/artifacts/{}", blob.digest),
        }
    }
}

/// `GET /v1/jobs/{id}/artifacts`.
pub(super) async fn list(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
) -> ApiResult<impl IntoResponse> {
    let exports = state.store().exports(record.job.id).await?;
    let made = record.artifacts.iter().map(|file| ListedFile::new("job", file.kind, file.lambda, file.blob));
    let exported = exports.iter().map(|export| {
        let source = record.artifacts.iter().find(|file| file.blob.digest == export.source);
        let lambda = source.and_then(|file| file.lambda);
        ListedFile {
            gaussians: Some(export.gaussians),
            sh_degree: Some(export.sh_degree),
            fidelity: export.fidelity,
            ..ListedFile::new("export", ArtifactKind::Scene(export.format), lambda, export.blob)
        }
    });
    let artifacts: Vec<ListedFile> = made.chain(exported).collect();
    Ok(([(header::CACHE_CONTROL, "no-cache")], Json(json!({ "artifacts": artifacts }))))
}
