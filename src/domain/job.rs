//! Jobs, their states and legal transitions, and the events that record them.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{JobId, JobMetrics, Phase, Problem, Progress, TrainOptions, named_choice};

named_choice! {
    /// The state of a job.
    pub enum JobState {
        /// Waiting for a worker.
        Queued = "queued",
        /// A worker holds its lease.
        Running = "running",
        /// Its file is published.
        Succeeded = "succeeded",
        /// It ended with a problem.
        Failed = "failed",
        /// It was cancelled.
        Cancelled = "cancelled",
    }
}

impl JobState {
    /// Whether the job has ended.
    #[must_use]
    pub fn is_terminal(self) -> bool {
        match self {
            JobState::Queued | JobState::Running => false,
            JobState::Succeeded | JobState::Failed | JobState::Cancelled => true,
        }
    }

    /// Whether a job may go from this state to `next`.
    #[must_use]
    pub fn may_become(self, next: JobState) -> bool {
        match self {
            JobState::Queued => matches!(next, JobState::Running | JobState::Failed | JobState::Cancelled),
            JobState::Running => next != JobState::Running,
            JobState::Succeeded | JobState::Failed | JobState::Cancelled => false,
        }
    }
}

/// A job.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    pub id: JobId,
    pub state: JobState,
    /// Stage within the state.
    pub phase: Phase,
    pub options: TrainOptions,
    pub progress: Progress,
    /// Metrics, once succeeded.
    pub metrics: Option<JobMetrics>,
    /// Why it failed.
    pub error: Option<Problem>,
    /// Number of attempts so far.
    pub attempt: u32,
    /// Whether cancellation was requested.
    pub cancel_requested: bool,
    /// Row version, raised by every change.
    pub version: u64,
    pub created_at: Timestamp,
    /// Start of the latest attempt.
    pub started_at: Option<Timestamp>,
    pub finished_at: Option<Timestamp>,
}

named_choice! {
    /// What an event records.
    pub enum EventKind {
        /// The state changed.
        State = "state",
        /// The phase changed.
        Phase = "phase",
        /// Progress was reported.
        Progress = "progress",
        /// An attempt ended without finishing the job.
        Attempt = "attempt",
    }
}

/// One entry of a job's history; `seq` counts from 1 without gaps within the job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Position in the job's history.
    pub seq: u64,
    pub at: Timestamp,
    pub kind: EventKind,
    /// The attempt that it belongs to.
    pub attempt: u32,
    pub data: serde_json::Value,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terminal_states_never_change() {
        let all =
            [JobState::Queued, JobState::Running, JobState::Succeeded, JobState::Failed, JobState::Cancelled];
        for state in all {
            assert_eq!(state.name().parse(), Ok(state));
            assert_eq!(state.is_terminal(), all.iter().all(|next| !state.may_become(*next)), "{state:?}");
        }
    }
}
