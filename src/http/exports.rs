//! `GET /v1/jobs/{id}/export`: a finished scene in a format that other programs read, made when it is first asked for.
//!
//! What always holds: a scene is exported to a format once, however many ask for it at a time; few exports are made at a time
//! and few more wait. One that was begun is finished and kept though its client goes away.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{Mutex, PoisonError},
};

use axum::{
    Extension,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderName, HeaderValue},
    response::Response,
};
use bytes::Bytes;
use futures_util::{
    FutureExt as _,
    future::{BoxFuture, Shared},
};
use tokio::{sync::Semaphore, task::spawn_blocking};

use super::{
    artifact::{file_of, take_lambda},
    cross_site::{FollowedLink, expect_own_doing},
    file::{File, serve},
    jobs::find,
    problem::Fault,
    query::Parameters,
    received::take_back,
    space::{Space, expect_above_floor},
    state::{AppState, ExportedScene},
};
use crate::{
    domain::{Caller, Digest, JobId, NamedCamera, SceneFormat},
    store::{ArtifactKind, ExportFidelity, ExportRecord, JobRecord},
};

/// The formats that scenes are exported to.
const FORMATS: [SceneFormat; 3] = [SceneFormat::Ply, SceneFormat::Spz, SceneFormat::Spz3];

/// Mean PSNR in dB of the export's pictures against the scene's.
const LIKENESS: HeaderName = HeaderName::from_static("x-likeness-psnr");

/// Which export; the format by its name, which has an order.
type Wanted = (JobId, Digest, &'static str);

type Making = Shared<BoxFuture<'static, Result<ExportRecord, Fault>>>;

/// The exports that are being made.
pub(super) struct ExportQueue {
    /// Room for those that are made and those that wait.
    places: Semaphore,
    /// Room for those that are made.
    turns: Semaphore,
    making: Mutex<BTreeMap<Wanted, Making>>,
}

impl fmt::Debug for ExportQueue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExportQueue").field("places", &self.places).finish_non_exhaustive()
    }
}

impl ExportQueue {
    /// A queue in which `at_once` exports are made and `waiting` more wait.
    pub(super) fn new(at_once: usize, waiting: usize) -> Self {
        let at_once = at_once.max(1);
        let (places, turns) = (Semaphore::new(at_once + waiting), Semaphore::new(at_once));
        Self { places, turns, making: Mutex::default() }
    }
}

/// `GET` and `HEAD /v1/jobs/{id}/export`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    link: Option<Extension<FollowedLink>>,
    request: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let format = take_format(&mut parameters)?;
    let lambda = take_lambda(&mut parameters)?;
    parameters.finish()?;
    let source = file_of(&record, lambda)?;
    let (blob, fidelity) = if source.format == format {
        (source.blob, None)
    } else {
        let export = match kept(&state, record.job.id, source.blob.digest, format).await? {
            Some(kept) => kept,
            None => {
                expect_own_doing(link.as_deref())?;
                export(&state, &record, source.blob.digest, format).await?
            }
        };
        (export.blob, export.fidelity)
    };
    let file = File::new(record.job.id, ArtifactKind::Scene(format), source.lambda, blob);
    let mut response = serve(&state, &request, file).await?;
    if response.status().is_success()
        && let Some(ExportFidelity { psnr, .. }) = fidelity
        && let Ok(psnr) = HeaderValue::try_from(format!("{psnr:.2}"))
    {
        response.headers_mut().insert(LIKENESS, psnr);
    }
    Ok(response)
}

fn take_format(parameters: &mut Parameters) -> Result<SceneFormat, Fault> {
    let names = FORMATS.map(SceneFormat::name).join(", ");
    let text = parameters
        .take("format")
        .ok_or_else(|| Fault::parameter("format", format!("is missing; choose one of {names}")))?;
    let format = FORMATS.into_iter().find(|format| format.name() == text);
    format.ok_or_else(|| Fault::parameter("format", format!("'{text}' is not one of {names}")))
}

async fn export(
    state: &AppState,
    record: &JobRecord,
    source: Digest,
    format: SceneFormat,
) -> Result<ExportRecord, Fault> {
    let wanted = (record.job.id, source, format.name());
    let making = {
        let mut making = state.exports().making.lock().unwrap_or_else(PoisonError::into_inner);
        let begin = || {
            // A task of its own: others may wait for it, and it is of use to whoever asks next.
            let task = tokio::spawn(make(state.clone(), record.clone(), source, format));
            let ended = async { task.await.unwrap_or_else(|error| Err(Fault::internal(&error))) };
            ended.boxed().shared()
        };
        making.entry(wanted).or_insert_with(begin).clone()
    };
    making.await
}

async fn kept(
    state: &AppState,
    job: JobId,
    source: Digest,
    format: SceneFormat,
) -> Result<Option<ExportRecord>, Fault> {
    let exports = state.store().exports(job).await?;
    Ok(exports.into_iter().find(|export| (export.source, export.format) == (source, format)))
}

/// Takes an export from the list of those that are being made, however its making ends.
struct Ended {
    state: AppState,
    wanted: Wanted,
}

impl Drop for Ended {
    fn drop(&mut self) {
        let mut making = self.state.exports().making.lock().unwrap_or_else(PoisonError::into_inner);
        making.remove(&self.wanted);
    }
}

async fn make(
    state: AppState,
    record: JobRecord,
    source: Digest,
    format: SceneFormat,
) -> Result<ExportRecord, Fault> {
    let job = record.job.id;
    let _ended = Ended { state: state.clone(), wanted: (job, source, format.name()) };
    // Another may have been finished between the look and this.
    if let Some(kept) = kept(&state, job, source, format).await? {
        return Ok(kept);
    }
    // How long the file will be is known once it is made; then its bytes are counted as well.
    state.store().admit_export(job).await?;
    expect_above_floor(&state, 0)?;
    let place = state.exports().places.try_acquire();
    let _place = place.map_err(|_| Fault::busy("too many scenes are being exported"))?;
    let _turn = state.exports().turns.acquire().await.map_err(|error| Fault::internal(&error))?;
    let file = state.blobs().read(source).await?;
    let cameras = cameras_of(&state, &record).await?;
    let write = state.services().export.clone();
    let exported = spawn_blocking(move || write(&file, format, &cameras)).await;
    let exported = exported.map_err(|error| Fault::internal(&error))??;
    let ExportedScene { bytes, gaussians, sh_degree, fidelity } = exported;
    let _reservation = Space::reserve(&state, record.owner, bytes.len() as u64).await?;
    let published = state.blobs().put_new(Bytes::from(bytes)).await?;
    let blob = published.blob;
    let export = ExportRecord { job, source, format, blob, gaussians, sh_degree, fidelity };
    let kept = state.store().add_export(export).await;
    if !matches!(&kept, Ok(Some(kept)) if kept.blob == blob) {
        take_back(&state, published).await;
    }
    let kept = kept?;
    tracing::info!(%job, bytes = blob.bytes, "job {job} is exported as .{}", format.name());
    kept.ok_or_else(|| Fault::no_job(&job.to_string()))
}

/// The dataset's cameras, from which the export is to look like the scene.
async fn cameras_of(state: &AppState, record: &JobRecord) -> Result<Vec<NamedCamera>, Fault> {
    let Some(blob) = record.artifact(ArtifactKind::Cameras) else { return Ok(Vec::new()) };
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map_err(|error| Fault::internal(&error))
}
