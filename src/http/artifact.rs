//! A job's files: the finished one, a list of all, and any of them by its hash.

use axum::{
    Json,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;

use super::{
    file::{File, media_type, serve},
    jobs::find,
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, Digest},
    store::{ArtifactKind, BlobRef, ExportFidelity, JobRecord, SceneArtifact},
};

/// Takes the parameter that chooses among the files of a rate-distortion curve.
pub(super) fn take_lambda(parameters: &mut Parameters) -> Result<Option<f64>, Fault> {
    parameters.take_as("lambda", "a number")
}

/// The job's file of weight `lambda`, or its first; 409 where there is none yet, 404 where none has that weight.
pub(super) fn file_of(record: &JobRecord, lambda: Option<f64>) -> Result<SceneArtifact, Fault> {
    let first = record.scenes().next();
    let first = first.ok_or_else(|| Fault::no_file_yet(record.job.id, record.job.state.name()))?;
    match lambda {
        None => Ok(first),
        Some(_) => record.scenes().find(|scene| scene.lambda == lambda).ok_or_else(|| no_such_lambda(record)),
    }
}

fn no_such_lambda(record: &JobRecord) -> Fault {
    let known: Vec<String> =
        record.scenes().filter_map(|scene| scene.lambda).map(|lambda| lambda.to_string()).collect();
    let detail = if known.is_empty() {
        format!("job {} has one file, not the files of an rd_curve; leave out lambda", record.job.id)
    } else {
        format!("job {} has files of lambda {}", record.job.id, known.join(", "))
    };
    Fault::new(StatusCode::NOT_FOUND, "no-such-lambda", "No such file", detail)
}

/// `GET` and `HEAD /v1/jobs/{id}/artifact`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    request: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let lambda = take_lambda(&mut parameters)?;
    parameters.finish()?;
    let SceneArtifact { format, lambda, blob } = file_of(&record, lambda)?;
    serve(&state, &request, File::new(record.job.id, ArtifactKind::Scene(format), lambda, blob)).await
}

/// `GET` and `HEAD /v1/artifacts/{sha256}`.
pub(super) async fn by_hash(
    State(state): State<AppState>,
    caller: Caller,
    Path(hash): Path<String>,
    request: HeaderMap,
) -> Result<Response, Fault> {
    let found = match hash.parse::<Digest>() {
        Ok(digest) => state.store().file(digest, caller.sees_only()).await?,
        Err(_) => None,
    };
    let found = found.ok_or_else(|| {
        let detail = "no file of yours has this SHA-256; the artifacts of a job list what it has";
        Fault::new(StatusCode::NOT_FOUND, "artifact-not-found", "No such file", detail)
    })?;
    serve(&state, &request, found.into()).await
}

#[derive(Debug, Serialize)]
struct ArtifactList {
    artifacts: Vec<ListedFile>,
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
    likeness: Option<ExportFidelityBody>,
    href: String,
}

#[derive(Debug, Serialize)]
struct ExportFidelityBody {
    psnr: f64,
    views: u32,
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
            likeness: None,
            href: format!("/v1/artifacts/{}", blob.digest),
        }
    }
}

/// `GET /v1/jobs/{id}/artifacts`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<impl IntoResponse, Fault> {
    let record = find(&state, &caller, &id).await?;
    let exports = state.store().exports(record.job.id).await?;
    let made = record.artifacts.iter().map(|file| ListedFile::new("job", file.kind, file.lambda, file.blob));
    let exported = exports.iter().map(|export| {
        let source = record.artifacts.iter().find(|file| file.blob.digest == export.source);
        let lambda = source.and_then(|file| file.lambda);
        ListedFile {
            gaussians: Some(export.gaussians),
            sh_degree: Some(export.sh_degree),
            likeness: export
                .fidelity
                .map(|ExportFidelity { psnr, views }| ExportFidelityBody { psnr, views }),
            ..ListedFile::new("export", ArtifactKind::Scene(export.format), lambda, export.blob)
        }
    });
    let artifacts = made.chain(exported).collect();
    Ok(([(header::CACHE_CONTROL, "no-cache")], Json(ArtifactList { artifacts })))
}
