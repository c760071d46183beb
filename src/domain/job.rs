//! Jobs, their states and legal transitions, and the events that record them.

use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{JobId, JobMetrics, Phase, Problem, Progress, TrainOptions};

/// Where a job is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waiting for a worker.
    Queued,
    /// A worker holds its lease.
    Running,
    /// Its file is published.
    Succeeded,
    /// It ended with a problem.
    Failed,
    /// Somebody stopped it.
    Cancelled,
}

impl JobState {
    /// Every state.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The name in the database and the API.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            JobState::Queued => "queued",
            JobState::Running => "running",
            JobState::Succeeded => "succeeded",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
        }
    }

    /// Whether nothing will change any more.
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

impl FromStr for JobState {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|state| state.name() == text)
            .ok_or_else(|| format!("'{text}' is not a job state"))
    }
}

/// A job as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Identity.
    pub id: JobId,
    /// State.
    pub state: JobState,
    /// Stage within the state.
    pub phase: Phase,
    /// What to do.
    pub options: TrainOptions,
    /// Latest report.
    pub progress: Progress,
    /// Figures, once succeeded.
    pub metrics: Option<JobMetrics>,
    /// Why it failed.
    pub error: Option<Problem>,
    /// How many times it was begun.
    pub attempt: u32,
    /// Whether somebody asked for it to stop.
    pub cancel_requested: bool,
    /// Row version, raised by every change.
    pub version: u64,
    /// Creation.
    pub created_at: Timestamp,
    /// Begin of the latest attempt.
    pub started_at: Option<Timestamp>,
    /// End.
    pub finished_at: Option<Timestamp>,
}

/// What an event records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EventKind {
    /// The state changed.
    State,
    /// The phase changed.
    Phase,
    /// Progress was reported.
    Progress,
    /// An attempt ended without finishing the job.
    Attempt,
}

/// One entry of a job's history; `seq` counts from 1 without gaps within the job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Position in the job's history.
    pub seq: u64,
    /// When.
    pub at: Timestamp,
    /// What kind.
    pub kind: EventKind,
    /// The attempt that it belongs to.
    pub attempt: u32,
    /// Kind-specific content.
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
