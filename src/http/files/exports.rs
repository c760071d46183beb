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
    download::{File, serve},
    file_of, take_lambda,
};
use crate::{
    domain::{Digest, ExportFidelity, ExportedScene, JobId, NamedCamera, SceneFormat, SceneFrame},
    engine::SceneSource,
    http::{
        auth::cross_site::{FollowedLink, refuse_followed_link},
        datasets::received::withdraw_blob,
        jobs::OwnedJob,
        problem::{ApiResult, ProblemResponse},
        request::Parameters,
        state::AppState,
    },
    store::{ArtifactKind, ExportRecord, JobRecord},
};

/// The formats that scenes are exported to.
const FORMATS: [SceneFormat; 3] = [SceneFormat::Ply, SceneFormat::Spz, SceneFormat::Spz3];

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
    parameters.finish()?;
    let source = file_of(&record, lambda)?;
    let (blob, fidelity) = if source.format == format {
        (source.blob, None)
    } else {
        let export = match existing_export(&state, record.job.id, source.blob.digest, format).await? {
            Some(existing_export) => existing_export,
            None => {
                refuse_followed_link(link.as_deref())?;
                export(&state, &record, source.blob.digest, format).await?
            }
        };
        (export.blob, export.fidelity)
    };
    let file = File::new(record.job.id, ArtifactKind::Scene(format), source.lambda, blob);
    let mut response = serve(&state, &method, &request, file).await?;
    if response.status().is_success()
        && let Some(ExportFidelity { psnr, .. }) = fidelity
        && let Ok(psnr) = HeaderValue::try_from(format!("{psnr:.2}"))
    {
        response.headers_mut().insert(EXPORT_PSNR, psnr);
    }
    if response.status().is_success()
        && let Some(offset) = offset_of(&record)
    {
        response.headers_mut().insert(EXPORT_OFFSET, offset);
    }
    Ok(response)
}

/// What exported coordinates of the job's scene are relative to; none where they are the world's.
fn offset_of(record: &JobRecord) -> Option<HeaderValue> {
    let frame = record.job.metrics.as_ref()?.frame.filter(SceneFrame::is_far_out)?;
    let DVec3 { x, y, z } = frame.offset();
    HeaderValue::try_from(format!("{x} {y} {z}")).ok()
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
