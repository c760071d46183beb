//! The work before training: cameras of photographs, or of frames of a video, are found, and the dataset with them takes the place of the
//! job's.
//!
//! That dataset is published and recorded before training begins, so no later attempt, retry or other job of the same photographs repeats
//! the work.

use std::{
    fs, io,
    path::{Path, PathBuf},
    time::Instant as StdInstant,
};

use tokio::{
    io::AsyncReadExt as _,
    time::{Instant, sleep},
};
use tokio_util::sync::CancellationToken;

use super::{
    WorkerConfig, WorkerError, checkpoints,
    deps::WorkerDeps,
    lease_keeper::{LeaseKeeper, RunEnd, while_renewing},
    outcomes::{completed, no_thread, stalled},
    storage,
};
use crate::{
    domain::{CancelFlag, Phase, Problem, ProblemType, Progress},
    ingest,
    pipeline::JobError,
    poses::{PoseEstimator, PoseOptions, PosesError},
    store::{BlobCopy, BlobError, BlobRef, Lease, Outcome, StoreError},
};

/// Bytes that are copied at a time.
const PIECE_BYTES: usize = 1 << 20;

/// Pause between tries to record the dataset.
const RECORD_PAUSE: std::time::Duration = std::time::Duration::from_secs(1);

/// How a worker finds cameras.
#[derive(Debug, Clone)]
pub struct CameraSearch {
    /// The programs that find them, with their limits.
    pub estimator: PoseEstimator,
    /// The options of every search.
    pub options: PoseOptions,
}

/// What became of the work.
pub(super) enum Prepared {
    /// The dataset to train on.
    Dataset(BlobCopy),
    /// The attempt has ended; an error ends the worker.
    Ended(Outcome, Result<(), WorkerError>),
}

/// Finds the cameras, and records the dataset.
pub(super) async fn prepare(
    keeper: &mut LeaseKeeper<'_>,
    given: BlobCopy,
    shutdown: &CancellationToken,
) -> Prepared {
    let (deps, lease) = (keeper.deps, keeper.lease);
    let ended = |outcome| Prepared::Ended(outcome, Ok(()));
    let Some(search) = deps.config.cameras.clone() else {
        return ended(Outcome::Released);
    };
    let work = match WorkFolder::new(&deps.config, lease) {
        Ok(work) => work,
        Err(error) => return ended(storage::outcome(&BlobError::Io(error))),
    };
    let folder = work.0.clone();
    let run = move |report: &mut dyn FnMut(Phase, &Progress), cancel: &CancelFlag| {
        let found = archive(&search, given.path(), &folder, report, cancel);
        found.map_err(job_error)
    };
    let archive = match keeper.run(shutdown, run).await {
        RunEnd::Ended(result) => {
            keeper.report_progress().await;
            match completed(lease, *result, keeper.stop) {
                Ok(archive) => archive,
                Err(outcome) => return ended(outcome),
            }
        }
        RunEnd::NotStarted(error) => return ended(Outcome::Retry(no_thread(&error))),
        RunEnd::DrainOver => return ended(Outcome::Released),
        RunEnd::Stalled => {
            let (outcome, error) = stalled(lease, deps.config.stall_limit);
            return Prepared::Ended(outcome, Err(error));
        }
    };
    let publishing = publish(deps, lease, &archive);
    match while_renewing(deps, lease, &mut keeper.last_renewed, publishing).await {
        Ok(copy) => Prepared::Dataset(copy),
        Err(outcome) => ended(outcome),
    }
}

/// Writes the dataset as an archive into `work`.
fn archive(
    search: &CameraSearch,
    given: &Path,
    work: &Path,
    report: &mut dyn FnMut(Phase, &Progress),
    cancel: &CancelFlag,
) -> Result<PathBuf, PosesError> {
    let started = StdInstant::now();
    let report = &mut |poses| {
        let elapsed_seconds = started.elapsed().as_secs_f64();
        report(Phase::Poses, &Progress { elapsed_seconds, poses: Some(poses), ..Progress::default() });
    };
    let found = search.estimator.dataset(given, work, search.options, report, cancel)?;
    let path = work.join("dataset.zip");
    let io = |error| PosesError::Io { what: "cannot write the archive of the dataset", error };
    let mut file = fs::File::create(&path).map_err(io)?;
    ingest::pack(&found.folder, &mut file).map_err(|problem| io(io::Error::other(problem.to_string())))?;
    file.sync_all().map_err(io)?;
    Ok(path)
}

/// Publishes the archive and makes it the job's dataset.
async fn publish(deps: &WorkerDeps, lease: &Lease, archive: &Path) -> Result<BlobCopy, Outcome> {
    let failed = |error: BlobError| storage::outcome(&error);
    let blob = publish_blob(deps, archive).await.map_err(failed)?;
    let since = Instant::now();
    while let Err(error) = deps.store.use_posed_dataset(lease, blob).await {
        tracing::warn!(error = &error as &dyn std::error::Error, "the dataset is not recorded yet: {error}");
        if matches!(error, StoreError::LeaseLost { .. }) || since.elapsed() > deps.config.lease {
            return Err(Outcome::Released);
        }
        sleep(RECORD_PAUSE).await;
    }
    deps.blobs.local_copy(blob.digest).await.map_err(failed)
}

async fn publish_blob(deps: &WorkerDeps, archive: &Path) -> Result<BlobRef, BlobError> {
    let mut file = tokio::fs::File::open(archive).await?;
    let mut writer = deps.blobs.stage(u64::MAX).await?;
    let mut piece = vec![0; PIECE_BYTES];
    loop {
        let length = file.read(&mut piece).await?;
        if length == 0 {
            break;
        }
        writer.write(&piece[..length]).await?;
    }
    Ok(deps.blobs.publish(&writer.finish().await?).await?.blob)
}

/// A folder that only this attempt writes to, removed in the end; one that a crash left is removed with the job's checkpoints.
struct WorkFolder(PathBuf);

impl WorkFolder {
    fn new(config: &WorkerConfig, lease: &Lease) -> io::Result<Self> {
        let root = match &config.checkpoints {
            Some(root) => checkpoints::folder(root, lease.job),
            None => std::env::temp_dir().join(lease.job.to_string()),
        };
        let folder = root.join(format!("poses-{}", lease.attempt));
        fs::create_dir_all(&folder)?;
        Ok(Self(folder))
    }
}

impl Drop for WorkFolder {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!("{} cannot be removed: {error}", self.0.display());
        }
    }
}

/// Whether another attempt may help: a program that ended early may have met a lack of memory.
fn job_error(error: PosesError) -> JobError {
    match error {
        PosesError::Cancelled => JobError::Cancelled,
        PosesError::Ingest(error) => error.into(),
        PosesError::Io { error, .. } if crate::store::is_disk_full(&error) => {
            JobError::Hold(Problem::new(ProblemType::StorageFull, error.to_string()))
        }
        PosesError::Io { .. } | PosesError::Died { .. } => JobError::Retry(error.into()),
        PosesError::Unavailable { .. } | PosesError::VideoUnavailable { .. } => JobError::Hold(error.into()),
        other => JobError::Fail(other.into()),
    }
}
