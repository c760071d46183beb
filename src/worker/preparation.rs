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
    domain::{
        CameraSearchOptions, CancelFlag, JobId, MaskSource, Phase, Problem, ProblemType, Progress,
        TrainOptions,
    },
    ingest,
    pipeline::JobError,
    poses::{Given, PoseEstimator, PoseOptions, PosesError, SEARCH_FOLDER, while_reporting},
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
    /// Where masks are that hide what cameras must not be placed by.
    pub masks: MaskSource,
}

impl CameraSearch {
    /// The search as the options of a run ask for it.
    #[must_use]
    pub fn of_job(mut self, options: &TrainOptions) -> Self {
        let CameraSearchOptions { camera_model, matching, masks } = options.camera_search();
        (self.options.camera_model, self.options.matching, self.masks) = (camera_model, matching, masks);
        self
    }
}

/// What became of the work.
pub(super) enum Prepared {
    /// The dataset to train on.
    Dataset(BlobCopy),
    /// The attempt has ended; an error ends the worker.
    Ended(Outcome, Result<(), WorkerError>),
}

/// Finds the cameras as the options of the job ask, and records the dataset. Goes on with the search of an attempt that was interrupted, or
/// with that of the job that this one retries.
pub(super) async fn prepare(
    keeper: &mut LeaseKeeper<'_>,
    given: BlobCopy,
    (options, resume_from): (&TrainOptions, Option<JobId>),
    shutdown: &CancellationToken,
) -> Prepared {
    let (deps, lease) = (keeper.deps, keeper.lease);
    let ended = |outcome| Prepared::Ended(outcome, Ok(()));
    let Some(search) = deps.config.cameras.clone().map(|search| search.of_job(options)) else {
        return ended(Outcome::Released);
    };
    let work = match WorkFolder::new(&deps.config, lease, resume_from) {
        Ok(work) => work,
        Err(error) => return ended(storage::outcome(&BlobError::Io(error))),
    };
    let folder = work.path.clone();
    let run = move |report: &mut dyn FnMut(Phase, &Progress), cancel: &CancelFlag| {
        let found = archive(&search, given.path(), &folder, report, cancel);
        found.map_err(job_error)
    };
    let archive = match keeper.run(shutdown, run).await {
        RunEnd::Ended(result) => {
            keeper.report_progress().await;
            match completed(lease, *result, keeper.stop) {
                Ok(archive) => archive,
                Err(outcome @ Outcome::Failed(_)) => {
                    work.remove();
                    return ended(outcome);
                }
                Err(outcome) => {
                    work.leave();
                    return ended(outcome);
                }
            }
        }
        RunEnd::NotStarted(error) => {
            work.leave();
            return ended(Outcome::Retry(no_thread(&error)));
        }
        // Its thread still writes there.
        RunEnd::DrainOver => return ended(Outcome::Released),
        RunEnd::Stalled => {
            let (outcome, error) = stalled(lease, deps.config.stall_limit);
            return Prepared::Ended(outcome, Err(error));
        }
    };
    let publishing = publish(deps, lease, &archive);
    match while_renewing(deps, lease, &mut keeper.last_renewed, publishing).await {
        Ok(copy) => {
            work.remove();
            Prepared::Dataset(copy)
        }
        Err(outcome) => {
            work.leave();
            ended(outcome)
        }
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
    let found = search.estimator.dataset(
        Given { path: given, masks: &search.masks },
        work,
        search.options,
        report,
        cancel,
    )?;
    let path = work.join("dataset.zip");
    let io = |error| PosesError::Io { what: "cannot write the archive of the dataset", error };
    let mut file = fs::File::create(&path).map_err(io)?;
    // A copy of all photographs, which may take long on a slow disk.
    while_reporting(found.report.progress(), report, || {
        ingest::pack(&found.folder, &mut file).map_err(io::Error::other)?;
        file.sync_all()
    })
    .map_err(io)?;
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

/// A folder that only this attempt writes to; one that a crash left is taken over by the next attempt, or removed with the job's checkpoints.
struct WorkFolder {
    path: PathBuf,
    /// Whether another attempt would find it.
    is_kept: bool,
}

impl WorkFolder {
    fn new(config: &WorkerConfig, lease: &Lease, resume_from: Option<JobId>) -> io::Result<Self> {
        let path = match &config.checkpoints {
            Some(root) => checkpoints::search_of_attempt(root, lease, resume_from),
            None => {
                ingest::large_file_dir().join(lease.job.to_string()).join(format!("poses-{}", lease.attempt))
            }
        };
        fs::create_dir_all(&path)?;
        Ok(Self { path, is_kept: config.checkpoints.is_some() })
    }

    /// Leaves what another attempt goes on with, if one can find it.
    fn leave(self) {
        if !self.is_kept {
            return self.remove();
        }
        if let Err(error) = keep_search(&self.path) {
            tracing::warn!("{} cannot be cleared: {error}", self.path.display());
        }
    }

    fn remove(self) {
        if let Err(error) = fs::remove_dir_all(&self.path) {
            tracing::warn!("{} cannot be removed: {error}", self.path.display());
        }
    }
}

/// Removes all from a folder but features and matches: the rest is made again in a moment.
fn keep_search(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name() == SEARCH_FOLDER {
            continue;
        }
        if entry.file_type()?.is_dir() {
            fs::remove_dir_all(entry.path())?;
        } else {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Whether another attempt may help: a program that ended early may have met a lack of memory.
fn job_error(error: PosesError) -> JobError {
    match error {
        PosesError::Cancelled => JobError::Cancelled,
        PosesError::Ingest(error) => error.into(),
        PosesError::Io { error, .. } if crate::store::is_disk_full(&error) => {
            JobError::Hold(Problem::new(ProblemType::StorageFull, error.to_string()))
        }
        PosesError::Io { .. } | PosesError::Died { .. } | PosesError::FramesDied { .. } => {
            JobError::Retry(error.into())
        }
        PosesError::Unavailable { .. } | PosesError::VideoUnavailable { .. } => JobError::Hold(error.into()),
        other => JobError::Fail(other.into()),
    }
}
