//! What goes into and comes out of a [`super::Store`].

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::IdempotentRequest;
use crate::domain::{
    Digest, Job, JobId, JobMetrics, JobState, KeyId, ModelKind, Problem, SceneFormat, SceneId, TrainOptions,
};

/// A published blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlobRef {
    /// SHA-256 of its content, which is also its name.
    pub digest: Digest,
    /// Length.
    pub bytes: u64,
}

/// A job to be queued.
#[derive(Debug, Clone)]
pub struct NewJob {
    /// Its identity, chosen by the caller.
    pub id: JobId,
    /// Whose it is.
    pub owner: Option<KeyId>,
    /// The scene that it is made of, if it did not come with its own archive.
    pub scene: Option<SceneId>,
    /// The job that it repeats.
    pub retry_of: Option<JobId>,
    /// When it is to be given up, finished or not.
    pub deadline_at: Option<Timestamp>,
    /// What to do.
    pub options: TrainOptions,
    /// The dataset archive, already published.
    pub dataset: BlobRef,
    /// Higher goes first; 0 is usual.
    pub priority: i32,
    /// Whether it may go on from where the job that it repeats stopped.
    pub from_checkpoint: bool,
    /// The `Idempotency-Key` of the request that makes it.
    pub intent: Option<IdempotentRequest>,
}

impl NewJob {
    /// A job of nobody's, of no scene, without priority or deadline.
    #[must_use]
    pub fn new(id: JobId, options: TrainOptions, dataset: BlobRef) -> Self {
        Self {
            id,
            owner: None,
            scene: None,
            retry_of: None,
            deadline_at: None,
            options,
            dataset,
            priority: 0,
            from_checkpoint: false,
            intent: None,
        }
    }
}

/// What an artifact is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ArtifactKind {
    /// The dataset's cameras as JSON, for views by frame name.
    Cameras,
    /// Held-out views as pictures ([`crate::domain::HeldOut`]) as JSON, for the report.
    #[serde(rename = "held_out")]
    HeldOut,
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
            ArtifactKind::Scene(format) => format.name(),
        }
    }
}

/// A blob that a finished job refers to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Artifact {
    /// What it is.
    pub kind: ArtifactKind,
    /// The weight of the rate that it was trained with, of a file of a rate-distortion curve.
    pub lambda: Option<f64>,
    /// Where it is.
    pub blob: BlobRef,
}

/// A file of a finished scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneArtifact {
    /// Its kind.
    pub format: SceneFormat,
    /// As in [`Artifact::lambda`].
    pub lambda: Option<f64>,
    /// Where it is.
    pub blob: BlobRef,
}

/// A job with what it refers to.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// The job.
    pub job: Job,
    /// Whose it is; nobody's if it was made while there were no keys.
    pub owner: Option<KeyId>,
    /// As in [`NewJob::scene`]; none either once the scene is deleted.
    pub scene: Option<SceneId>,
    /// As in [`NewJob::retry_of`]; none either once that job is deleted.
    pub retry_of: Option<JobId>,
    /// As in [`NewJob::deadline_at`].
    pub deadline_at: Option<Timestamp>,
    /// As in [`NewJob::priority`].
    pub priority: i32,
    /// Its dataset archive.
    pub dataset: BlobRef,
    /// What it left behind; empty unless it succeeded. Files of a rate-distortion curve are in its order.
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
            ArtifactKind::Cameras | ArtifactKind::HeldOut => None,
        })
    }
}

/// Which jobs a list shows; the default is all of them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobFilter {
    /// Only this owner's.
    pub owner: Option<KeyId>,
    /// Only those in one of these states; in any if empty.
    pub states: Vec<JobState>,
    /// Only those made of this scene.
    pub scene: Option<SceneId>,
    /// Only those that train this.
    pub model: Option<ModelKind>,
}

/// A place in the list of jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageKey {
    /// Creation of the last job seen.
    pub created_at: Timestamp,
    /// Its identity.
    pub id: JobId,
}

/// What a worker holds while it carries a job out; the attempt is the fence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// The attempt that was given out.
    pub attempt: u32,
    /// The worker that it was given to.
    pub worker: String,
}

/// A claimed job.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// What to name in every further write.
    pub lease: Lease,
    /// The dataset archive.
    pub dataset: Digest,
    /// What to do.
    pub options: TrainOptions,
    /// The job whose checkpoint it may go on from if it has none of its own.
    pub resume_from: Option<JobId>,
}

/// The answer to a heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    /// Somebody asked for the job to stop.
    pub cancel_requested: bool,
    /// The job's deadline has passed.
    pub deadline_passed: bool,
}

/// How a worker died, as far as anybody can tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkerDeath {
    /// While who watched it lived on: its job may be what ended it.
    Alone,
    /// With who watched it, by its hand, or unwatched. A power cut is one such end.
    WithService,
}

/// How an attempt ended, as its worker tells it.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// With a result, whose blobs are already published.
    Succeeded {
        /// Its figures.
        metrics: Box<JobMetrics>,
        /// Its blobs.
        artifacts: Vec<Artifact>,
    },
    /// For good: another attempt cannot help.
    Failed(Problem),
    /// By the machine's fault: another attempt may help.
    Retry(Problem),
    /// For want of something that time or an operator brings, such as room on the disk. The job waits; the attempt is not
    /// charged.
    Held(Problem),
    /// Because somebody asked for it.
    Cancelled,
    /// Because the worker shuts down, or the job's deadline has passed; the attempt is not charged.
    Released,
}

/// How an attempt ended, as the history has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptOutcome {
    /// Its result was published.
    Succeeded,
    /// The job failed with it.
    Failed,
    /// It failed and the job was queued again.
    Retried,
    /// It was stopped on request.
    Cancelled,
    /// It was given back without a charge: its worker shut down, or the job is held, then with a cause.
    Released,
    /// Its worker fell silent.
    Lost,
}

impl AttemptOutcome {
    /// Every outcome.
    pub const ALL: [Self; 6] =
        [Self::Succeeded, Self::Failed, Self::Retried, Self::Cancelled, Self::Released, Self::Lost];

    /// The name in the database and in events.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            AttemptOutcome::Succeeded => "succeeded",
            AttemptOutcome::Failed => "failed",
            AttemptOutcome::Retried => "retried",
            AttemptOutcome::Cancelled => "cancelled",
            AttemptOutcome::Released => "released",
            AttemptOutcome::Lost => "lost",
        }
    }
}

/// One attempt at a job.
#[derive(Debug, Clone, PartialEq)]
pub struct AttemptRecord {
    /// Counts from 1.
    pub number: u32,
    /// Who had it.
    pub worker: String,
    /// When it began.
    pub started_at: Timestamp,
    /// When it ended, if it has.
    pub ended_at: Option<Timestamp>,
    /// How it ended, if it has.
    pub outcome: Option<AttemptOutcome>,
    /// Why it failed, if it did.
    pub cause: Option<Problem>,
}

/// A job to be repeated.
#[derive(Debug, Clone)]
pub struct RetryRequest {
    /// The new job's identity, chosen by the caller.
    pub id: JobId,
    /// As in [`NewJob::from_checkpoint`].
    pub from_checkpoint: bool,
    /// As in [`NewJob::deadline_at`].
    pub deadline_at: Option<Timestamp>,
    /// As in [`NewJob::intent`].
    pub intent: Option<IdempotentRequest>,
}

/// What a request to repeat a job came to.
#[derive(Debug, Clone, PartialEq)]
pub enum RetryOutcome {
    /// This job repeats it.
    Created(Box<JobRecord>),
    /// The job is in this state: it has not failed and was not cancelled.
    NotRetryable(JobState),
}

/// What a request to delete a job came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Deletion {
    /// It is gone.
    Deleted,
    /// It is in this state, which is not an end.
    Active(JobState),
    /// It has another version than the one that was to be deleted.
    VersionMismatch,
}

/// What a request to cancel came to.
#[derive(Debug, Clone, PartialEq)]
pub enum Cancellation {
    /// The job is cancelled, now or since before.
    Done(JobRecord),
    /// The job runs; its worker will be told.
    Requested(JobRecord),
    /// The job had already succeeded or failed.
    TooLate(JobRecord),
}
