//! `GET /v1/jobs/{id}/export`: a finished scene in a format that other programs read, created on first request.
//!
//! Invariant: a started export is finished and kept even if its client disconnects.

use axum::{
    Extension,
    extract::State,
    http::{HeaderMap, HeaderName, HeaderValue, Method},
};
use bytes::Bytes;
use glam::DVec3;
use tokio::{runtime::Handle, task::spawn_blocking};

use super::{
    download::{File, MadeFile, serve, serve_made},
    file_of, take_lambda,
};
use crate::{
    domain::{
        Camera, Digest, ExportFidelity, ExportedScene, JobId, NamedCamera, Placement, PlacementError,
        SceneFormat, SceneFrame, Similarity, Split, UpAxis,
    },
    engine::{PlacedExport, SceneSource},
    http::{
        auth::cross_site::{FollowedLink, refuse_followed_link},
        datasets::received::withdraw_blob,
        jobs::OwnedJob,
        problem::{ApiResult, ProblemResponse},
        request::Parameters,
        shared::ExportTurn,
        state::AppState,
    },
    store::{ArtifactKind, BlobRef, ExportRecord, JobRecord, SceneArtifact},
};

/// The formats that scenes are exported to.
const FORMATS: [SceneFormat; 6] = SceneFormat::EXPORTS;

/// Header: mean PSNR in dB of renders of the export against renders of the scene.
const EXPORT_PSNR: HeaderName = HeaderName::from_static("x-export-psnr");

/// Header: world coordinates of the origin of the export's coordinates, of a scene that is far out.
const EXPORT_OFFSET: HeaderName = HeaderName::from_static("x-export-offset");

/// `GET` and `HEAD /v1/jobs/{id}/export`.
pub(crate) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    mut parameters: Parameters,
    link: Option<Extension<FollowedLink>>,
    method: Method,
    request: HeaderMap,
) -> ApiResult {
    let format = take_format(&mut parameters)?;
    let lambda = take_lambda(&mut parameters)?;
    let placement = take_placement(&mut parameters)?;
    let limit = take_limit(&mut parameters)?;
    parameters.finish()?;
    let source = file_of(&record, lambda)?;
    if !placement.is_none() || limit.is_some() {
        refuse_followed_link(link.as_deref())?;
        let (placed, similarity) = place(&state, &record, source, format, (placement, limit)).await?;
        let mut response = serve_made(&method, &request, placed)?;
        if response.status().is_success()
            && let Some(offset) = offset_of(&record, &similarity)
        {
            response.headers_mut().insert(EXPORT_OFFSET, offset);
        }
        return Ok(response);
    }
    let (blob, fidelity) = kept(&state, &record, source, format, link.as_deref()).await?;
    let file = File::new(record.job.id, ArtifactKind::Scene(format), source.lambda, blob);
    let mut response = serve(&state, &method, &request, file).await?;
    if response.status().is_success()
        && let Some(ExportFidelity { psnr, .. }) = fidelity
        && let Ok(psnr) = HeaderValue::try_from(format!("{psnr:.2}"))
    {
        response.headers_mut().insert(EXPORT_PSNR, psnr);
    }
    if response.status().is_success()
        && let Some(offset) = offset_of(&record, &Similarity::NONE)
    {
        response.headers_mut().insert(EXPORT_OFFSET, offset);
    }
    Ok(response)
}

/// The scene in a format, kept or made now, and its fidelity where it was measured.
async fn kept(
    state: &AppState,
    record: &JobRecord,
    source: SceneArtifact,
    format: SceneFormat,
    link: Option<&FollowedLink>,
) -> ApiResult<(BlobRef, Option<ExportFidelity>)> {
    if source.format == format {
        return Ok((source.blob, None));
    }
    let digest = source.blob.digest;
    let export = match existing_export(state, record.job.id, digest, format).await? {
        Some(existing_export) => existing_export,
        None => {
            refuse_followed_link(link)?;
            export(state, record, digest, format).await?
        }
    };
    Ok((export.blob, export.fidelity))
}

/// The scene turned, scaled and limited in number: made of its `.ply`, which is kept, for this answer alone.
async fn place(
    state: &AppState,
    record: &JobRecord,
    source: SceneArtifact,
    format: SceneFormat,
    (placement, limit): (Placement, Option<usize>),
) -> ApiResult<(MadeFile<ExportTurn>, Similarity)> {
    let cameras: Vec<Camera> = match placement.up.is_none() && limit.is_none() {
        true => Vec::new(),
        false => {
            let all = cameras_of(state, record).await?.into_iter();
            all.filter(|camera| camera.split == Split::Train).map(|camera| camera.camera).collect()
        }
    };
    let similarity = placement.similarity(&cameras).map_err(|error| refused(&error))?;
    let (ply, _) = kept(state, record, source, SceneFormat::Ply, None).await?;
    // Kept by the thread, also if the client disconnects, and then until the last byte is sent: it bounds the files in memory.
    let turn = state.exports.turn(record.project).await?;
    let (services, runtime) = (state.services.clone(), Handle::current());
    let placed = spawn_blocking(move || {
        let ply = services.read(&runtime, ply.digest)?;
        let made = PlacedExport { format, up: placement.up, similarity, limit };
        services.engine.place(&ply, &made, &cameras).map(|bytes| (Digest::of(&bytes), bytes, turn))
    });
    let (digest, bytes, turn) = placed.await??;
    let bytes = bytes.into();
    let File { media_type, name, .. } =
        File::new(record.job.id, ArtifactKind::Scene(format), source.lambda, source.blob);
    Ok((MadeFile { bytes, digest, media_type, name, kept: turn }, similarity))
}

/// 422 for what cannot be.
fn refused(error: &PlacementError) -> ProblemResponse {
    let text = error.to_string();
    let (parameter, detail) = text.split_once(": ").unwrap_or(("up", &text));
    ProblemResponse::parameter(parameter, detail)
}

fn take_placement(parameters: &mut Parameters) -> ApiResult<Placement> {
    let up = parameters
        .take("up")
        .map(|text| text.parse::<UpAxis>().map_err(|error| ProblemResponse::parameter("up", error)));
    let scale = parameters.take_as("scale", "a number")?.unwrap_or(1.0);
    let placement = Placement { up: up.transpose()?, scale };
    placement.validated().map_err(|error| refused(&error))
}

/// What exported coordinates of the job's scene are relative to; none where they are the world's.
fn offset_of(record: &JobRecord, similarity: &Similarity) -> Option<HeaderValue> {
    let frame = record.job.metrics.as_ref()?.frame.filter(SceneFrame::is_far_out)?;
    let DVec3 { x, y, z } = similarity.point(frame.offset());
    HeaderValue::try_from(format!("{x} {y} {z}")).ok()
}

/// How many Gaussians the file may have at most.
fn take_limit(parameters: &mut Parameters) -> ApiResult<Option<usize>> {
    let limit = parameters.take_as("limit_gaussians", "a number of Gaussians")?;
    match limit {
        Some(0) => Err(ProblemResponse::parameter("limit_gaussians", "must be 1 or more")),
        limit => Ok(limit),
    }
}

fn take_format(parameters: &mut Parameters) -> ApiResult<SceneFormat> {
    let names = FORMATS.map(SceneFormat::name).join(", ");
    let text = parameters
        .take("format")
        .ok_or_else(|| ProblemResponse::parameter("format", format!("is missing; choose one of {names}")))?;
    let format = FORMATS.into_iter().find(|format| format.name() == text);
    format.ok_or_else(|| ProblemResponse::parameter("format", format!("'{text}' is not one of {names}")))
}

async fn export(
    state: &AppState,
    record: &JobRecord,
    source: Digest,
    format: SceneFormat,
) -> ApiResult<ExportRecord> {
    let key = (record.job.id, source, format.name());
    state.exports.join(key, || make(state.clone(), record.clone(), source, format)).await
}

async fn existing_export(
    state: &AppState,
    job: JobId,
    source: Digest,
    format: SceneFormat,
) -> ApiResult<Option<ExportRecord>> {
    let exports = state.store().exports(job).await?;
    Ok(exports.into_iter().find(|export| (export.source, export.format) == (source, format)))
}

async fn make(
    state: AppState,
    record: JobRecord,
    source: Digest,
    format: SceneFormat,
) -> ApiResult<ExportRecord> {
    let job = record.job.id;
    // Another may have finished since the first lookup.
    if let Some(existing_export) = existing_export(&state, job, source, format).await? {
        return Ok(existing_export);
    }
    // The size is known, and reserved, once the file is written.
    state.store().admit_export(job).await?;
    state.reservations.require_free_space(0)?;
    let _turn = state.exports.turn(record.project).await?;
    let cameras = cameras_of(&state, &record).await?;
    let (services, runtime) = (state.services.clone(), Handle::current());
    let exported = spawn_blocking(move || {
        let read = || services.read(&runtime, source);
        services.engine.export(SceneSource { digest: source, read: &read }, format, &cameras)
    });
    let exported = exported.await;
    let exported = exported??;
    let ExportedScene { bytes, gaussians, sh_degree, fidelity } = exported;
    let _reservation = state.reservations.reserve(record.project, bytes.len() as u64).await?;
    let published = state.blobs().put_new(Bytes::from(bytes)).await?;
    let blob = published.blob;
    let export = ExportRecord { job, source, format, blob, gaussians, sh_degree, fidelity };
    let existing_export = state.store().add_export(export).await;
    let is_unused = match &existing_export {
        Ok(existing_export) => existing_export.as_ref().is_none_or(|export| export.blob != blob),
        // If it is unknown whether the export is recorded, its bytes are left to garbage collection.
        Err(error) => error.has_written_nothing(),
    };
    if is_unused {
        withdraw_blob(&state, published).await;
    }
    let existing_export = existing_export?;
    tracing::info!(%job, bytes = blob.bytes, "job {job} is exported as .{}", format.name());
    existing_export.ok_or_else(|| ProblemResponse::no_job(job))
}

/// The dataset's cameras, from which the fidelity of the export is measured.
async fn cameras_of(state: &AppState, record: &JobRecord) -> ApiResult<Vec<NamedCamera>> {
    let Some(blob) = record.artifact(ArtifactKind::Cameras) else { return Ok(Vec::new()) };
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map_err(|error| ProblemResponse::internal(&error))
}
