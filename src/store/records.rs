//! Arguments and results of [`super::Store`].

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::IdempotentRequest;
use crate::domain::{
    DatasetId, DatasetSummary, Digest, Job, JobId, JobMetrics, JobState, KeyId, Metadata, ModelKind,
    Preparation, Problem, ProjectId, SceneFormat, TrainOptions, named_choice,
};

/// A published blob, serialized as the API shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct BlobRef {
    /// Length.
    pub bytes: u64,
    /// SHA-256 of its content, which is also its name.
    #[serde(rename = "sha256")]
    pub digest: Digest,
}

/// The dataset that comes as the body of a job.
#[derive(Debug, Clone)]
pub struct JobDataset {
    /// Its identity, chosen by the caller, unless the project has a dataset with the same archive.
    pub id: DatasetId,
    /// Summary of the structure check.
    pub summary: DatasetSummary,
}

/// A job to be queued.
#[derive(Debug, Clone)]
pub struct NewJob {
    /// Its identity, chosen by the caller.
    pub id: JobId,
    pub project: ProjectId,
    /// The key that creates it; `None` without keys.
    pub key: Option<KeyId>,
    /// What its user calls it.
    pub name: Option<String>,
    /// Its user's labels.
    pub metadata: Metadata,
    /// The dataset that it trains on, if it did not come with its own archive.
    pub dataset_id: Option<DatasetId>,
    /// The dataset that it came with, without a [`Self::dataset_id`].
    pub own_dataset: Option<JobDataset>,
    /// The job that it retries.
    pub retry_of: Option<JobId>,
    /// When it fails if it is not finished by then.
    pub deadline_at: Option<Timestamp>,
    pub options: TrainOptions,
    /// The dataset archive, already published.
    pub dataset: BlobRef,
    /// What the dataset needs before training.
    pub needs: Preparation,
    /// The photographs or the video that the dataset was made of, if its cameras were found here.
    pub photographs: Option<Digest>,
    /// Higher runs first; the default is 0.
    pub priority: i32,
    /// The job whose checkpoint it may resume from: the one that it retries, or one before it.
    pub resume_from: Option<JobId>,
    /// The `Idempotency-Key` of the request that creates it.
    pub intent: Option<IdempotentRequest>,
}

impl NewJob {
    /// A job of the default project without key, name, metadata, dataset id, priority or deadline.
    #[must_use]
    pub fn new(id: JobId, options: TrainOptions, dataset: BlobRef) -> Self {
        Self {
            id,
            project: ProjectId::DEFAULT,
            key: None,
            name: None,
            metadata: Metadata::default(),
            dataset_id: None,
            own_dataset: None,
            retry_of: None,
            deadline_at: None,
            options,
            dataset,
            needs: Preparation::None,
            photographs: None,
            priority: 0,
            resume_from: None,
            intent: None,
        }
    }
}

/// The kind of an artifact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ArtifactKind {
    /// The dataset's cameras as JSON, for views by frame name.
    Cameras,
    /// Pictures of held-out views ([`crate::domain::HeldOut`]) as JSON, for the report.
    #[serde(rename = "held_out")]
    HeldOut,
    /// COLMAP's model of the cameras that were found, as a zip archive.
    #[serde(rename = "sparse_model")]
    SparseModel,
    /// A small JPEG of one view, for lists.
    Thumbnail,
    /// A JPEG of the model in training; replaced by the next one, and removed once the job succeeds.
    Preview,
    /// The photograph beside the preview.
    #[serde(rename = "preview_photograph")]
    PreviewPhotograph,
    /// The finished scene.
    #[serde(untagged)]
    Scene(SceneFormat),
}

impl ArtifactKind {
    /// The name in the database and the API.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            ArtifactKind::Cameras => "cameras",
            ArtifactKind::HeldOut => "held_out",
            ArtifactKind::SparseModel => "sparse_model",
            ArtifactKind::Thumbnail => "thumbnail",
            ArtifactKind::Preview => "preview",
            ArtifactKind::PreviewPhotograph => "preview_photograph",
            ArtifactKind::Scene(format) => format.name(),
        }
    }
}

/// A blob that a finished job refers to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Artifact {
    pub kind: ArtifactKind,
    /// The weight of the rate term that it was trained with, if it belongs to a rate-distortion curve.
    pub lambda: Option<f64>,
    /// Its content.
    pub blob: BlobRef,
}

/// A file of a finished scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneArtifact {
    pub format: SceneFormat,
    /// As in [`Artifact::lambda`].
    pub lambda: Option<f64>,
    /// Its content.
    pub blob: BlobRef,
}

/// A job with its references.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    pub job: Job,
    pub project: ProjectId,
    /// As in [`NewJob::key`].
    pub key: Option<KeyId>,
    /// As in [`NewJob::name`].
    pub name: Option<String>,
    /// As in [`NewJob::metadata`].
    pub metadata: Metadata,
    /// Its position among the queued jobs of its project, from 1 for the next; at most [`MAX_QUEUE_POSITION`]. `None` unless queued.
    pub queue_position: Option<u32>,
    /// Its latest attempts, at most [`SHOWN_ATTEMPTS`], oldest first.
    pub attempts: Vec<AttemptRecord>,
    /// As in [`NewJob::dataset_id`]; `None` also once the dataset is deleted.
    pub dataset_id: Option<DatasetId>,
    /// As in [`NewJob::retry_of`]; `None` also once that job is deleted.
    pub retry_of: Option<JobId>,
    /// As in [`NewJob::resume_from`].
    pub resume_from: Option<JobId>,
    /// As in [`NewJob::deadline_at`].
    pub deadline_at: Option<Timestamp>,
    /// As in [`NewJob::priority`].
    pub priority: i32,
    /// Its dataset archive; once cameras were found, the one with them.
    pub dataset: BlobRef,
    /// As in [`NewJob::needs`]; nothing once cameras were found.
    pub needs: Preparation,
    /// As in [`NewJob::photographs`].
    pub photographs: Option<Digest>,
    /// Its artifacts; but for previews empty unless it succeeded. Files of a rate-distortion curve are in its order.
    pub artifacts: Vec<Artifact>,
}

impl JobRecord {
    /// The artifact of one kind.
    #[must_use]
    pub fn artifact(&self, kind: ArtifactKind) -> Option<BlobRef> {
        self.artifacts.iter().find(|artifact| artifact.kind == kind).map(|artifact| artifact.blob)
    }

    /// The files of the finished scene.
    pub fn scenes(&self) -> impl Iterator<Item = SceneArtifact> {
        self.artifacts.iter().filter_map(|artifact| match artifact.kind {
            ArtifactKind::Scene(format) => {
                Some(SceneArtifact { format, lambda: artifact.lambda, blob: artifact.blob })
            }
            ArtifactKind::Cameras
            | ArtifactKind::HeldOut
            | ArtifactKind::SparseModel
            | ArtifactKind::Thumbnail
            | ArtifactKind::Preview
            | ArtifactKind::PreviewPhotograph => None,
        })
    }
}

/// Farthest queue position that is counted; a job farther back has this one.
pub const MAX_QUEUE_POSITION: u32 = 1000;

/// Most attempts in a [`JobRecord`].
pub const SHOWN_ATTEMPTS: u32 = 20;

/// Which jobs a list contains; the default is all of them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobFilter {
    /// Only this project's.
    pub project: Option<ProjectId>,
    /// Only those in one of these states; in any if empty.
    pub states: Vec<JobState>,
    /// Only those of this dataset.
    pub dataset_id: Option<DatasetId>,
    /// Only those that train this model.
    pub model: Option<ModelKind>,
    /// Only those with this name.
    pub name: Option<String>,
    /// Only those created then or later.
    pub created_from: Option<Timestamp>,
    /// Only those created before.
    pub created_before: Option<Timestamp>,
    /// Only those with these labels.
    pub metadata: Metadata,
}

/// What tells whether a job has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JobVersion {
    /// As in [`Job::version`].
    pub version: u64,
    pub state: JobState,
}

/// A position in the list of jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageKey {
    /// Creation of the last job seen.
    pub created_at: Timestamp,
    /// Its identity.
    pub id: JobId,
}

/// Result of one step of [`super::Store::remove_ended_jobs`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedJobs {
    /// How many jobs were removed.
    pub count: u64,
    /// Where the next step continues; `None` once there are no more.
    pub next: Option<PageKey>,
}

/// A worker's right to run a job; the attempt number is the fencing token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    pub job: JobId,
    /// The attempt that was granted.
    pub attempt: u32,
    /// The worker that it was granted to.
    pub worker: String,
}

/// A claimed job.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// To be named in every further write.
    pub lease: Lease,
    /// The dataset archive.
    pub dataset: Digest,
    /// What the dataset needs before training.
    pub needs: Preparation,
    /// Whether the dataset's cameras were found here.
    pub is_posed: bool,
    /// The job's options.
    pub options: TrainOptions,
    /// The job whose checkpoint it may resume from if it has none of its own.
    pub resume_from: Option<JobId>,
}

/// The answer to a heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    /// The job is to be cancelled.
    pub cancel_requested: bool,
    /// The job's deadline has passed.
    pub deadline_passed: bool,
}

/// How a worker died, as far as is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkerDeath {
    /// While its supervisor kept running: its job may have crashed it.
    Alone,
    /// With its supervisor, stopped by it, or while none was running; for example in a power cut.
    WithService,
}

/// How an attempt ended, as its worker reports it.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// With a result, whose blobs are already published.
    Succeeded {
        metrics: Box<JobMetrics>,
        /// Its blobs.
        artifacts: Vec<Artifact>,
    },
    /// With an error that another attempt cannot avoid.
    Failed(Problem),
    /// With an error of the machine: another attempt may succeed.
    Retry(Problem),
    /// Because something is missing that time or an operator provides, such as disk space. The job waits; the attempt is not
    /// charged.
    Held(Problem),
    /// Because the job was cancelled.
    Cancelled,
    /// Because the worker shuts down, or the job's deadline has passed; the attempt is not charged.
    Released,
}

named_choice! {
    /// How an attempt ended, as recorded; the names are those in the database and in events.
    pub enum AttemptOutcome {
        /// Its result was published.
        Succeeded = "succeeded",
        /// The job failed with it.
        Failed = "failed",
        /// It failed, and the job was queued again.
        Retried = "retried",
        /// It was stopped because the job was cancelled.
        Cancelled = "cancelled",
        /// It ended without a charge: its worker shut down, or the job is held, then with a cause.
        Released = "released",
        /// Its worker died or stopped renewing the lease.
        Lost = "lost",
    }
}

/// One attempt at a job, serialized as the API shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AttemptRecord {
    /// Counts from 1.
    pub number: u32,
    /// Its worker. The API does not show the name, which tells of the service's machines.
    #[serde(skip)]
    pub worker: String,
    pub started_at: Timestamp,
    /// End, if it has ended.
    pub ended_at: Option<Timestamp>,
    /// Its outcome, if it has ended.
    pub outcome: Option<AttemptOutcome>,
    /// Why it failed, if it failed.
    #[serde(rename = "error")]
    pub cause: Option<Problem>,
}

/// A retry of a job.
#[derive(Debug, Clone)]
pub struct RetryRequest {
    /// The new job's identity, chosen by the caller.
    pub id: JobId,
    /// As in [`NewJob::key`].
    pub key: Option<KeyId>,
    /// Whether it may resume from the job's checkpoint; if the job never ran, from that which the job was to resume from.
    pub from_checkpoint: bool,
    /// Other options than those of the job.
    pub options: Option<TrainOptions>,
    /// Another name and other labels than those of the job.
    pub change: JobChange,
    /// As in [`NewJob::deadline_at`].
    pub deadline_at: Option<Timestamp>,
    /// As in [`NewJob::intent`].
    pub intent: Option<IdempotentRequest>,
}

impl RetryRequest {
    /// A retry as the job was, without key and deadline, from its checkpoint.
    #[must_use]
    pub fn of(id: JobId) -> Self {
        let change = JobChange::default();
        Self { id, key: None, from_checkpoint: true, options: None, change, deadline_at: None, intent: None }
    }
}

/// A change of what a job's user calls it; `None` leaves a field as it is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JobChange {
    /// As in [`NewJob::name`].
    pub name: Option<Option<String>>,
    /// As in [`NewJob::metadata`].
    pub metadata: Option<Metadata>,
}

/// Result of a request to change a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobUpdate {
    /// The job as it is now.
    Changed(Box<JobRecord>),
    /// It has another version than the requested one.
    VersionMismatch,
}

/// Result of a request to retry a job.
#[derive(Debug, Clone, PartialEq)]
pub enum RetryOutcome {
    /// The new job.
    Created(Box<JobRecord>),
    /// The job is in this state: it has not ended, or it has succeeded with these very options.
    NotRetryable(JobState),
    /// Its cameras are to be found by another search, but the photographs were deleted.
    NoPhotographs,
}

/// Result of a request to delete a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Deletion {
    Deleted,
    /// It is in this state, which is not terminal.
    Active(JobState),
    /// It has another version than the requested one.
    VersionMismatch,
}

/// Result of a request to cancel a job.
#[derive(Debug, Clone, PartialEq)]
pub enum Cancellation {
    /// The job is cancelled, now or before.
    Done(JobRecord),
    /// The job is running; its worker will stop it.
    Requested(JobRecord),
    /// The job had already succeeded or failed.
    TooLate(JobRecord),
}
