//! The outcome of an attempt whose work ended without a result.

use std::{any::Any, io, time::Duration};

use super::{
    WorkerError,
    lease_keeper::{StopReason, WorkResult},
    storage,
};
use crate::{
    domain::{Problem, ProblemType},
    pipeline::JobError,
    store::{Lease, Outcome},
};

/// The result of work, or the outcome of its attempt.
pub(super) fn completed<T>(lease: &Lease, result: WorkResult<T>, stop: StopReason) -> Result<T, Outcome> {
    Err(match (result, stop) {
        (_, StopReason::LeaseLost) => {
            tracing::warn!("the lease of job {} was lost; its result is dropped", lease.job);
            // If no other worker has claimed it, because no process could reach the database, this is no crash.
            Outcome::Released
        }
        (Ok(Ok(done)), _) => return Ok(done),
        (Ok(Err(JobError::Fail(problem))), _) => Outcome::Failed(problem),
        (Ok(Err(JobError::Retry(problem))), _) => Outcome::Retry(storage::redacted(problem)),
        (Ok(Err(JobError::Hold(problem))), _) => Outcome::Held(storage::redacted(problem)),
        (Ok(Err(JobError::Cancelled)), StopReason::Cancelled) => Outcome::Cancelled,
        (Ok(Err(JobError::Cancelled)), StopReason::DeadlinePassed | StopReason::ShuttingDown) => {
            Outcome::Released
        }
        (Ok(Err(JobError::Cancelled)), StopReason::None) => Outcome::Retry(stopped_unasked()),
        (Err(panic), _) => {
            tracing::error!("job {} panicked: {}", lease.job, panic_text(&*panic));
            Outcome::Retry(panicked())
        }
    })
}

/// The outcome of an attempt whose work makes no progress, and why the worker has to exit.
pub(super) fn stalled(lease: &Lease, limit: Duration) -> (Outcome, WorkerError) {
    let error = WorkerError::Stalled { job: lease.job, attempt: lease.attempt, limit };
    tracing::error!("{error}");
    let detail = format!("the run made no progress for {} s", limit.as_secs());
    (Outcome::Retry(Problem::new(ProblemType::Stalled, detail)), error)
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

/// The problem of work that has no thread.
pub(super) fn no_thread(error: &io::Error) -> Problem {
    tracing::error!("the run's thread cannot be started: {error}");
    Problem::new(ProblemType::ResourceExhausted, "the worker cannot start a thread for the job")
        .with_status(503)
}

fn stopped_unasked() -> Problem {
    Problem::new(ProblemType::Internal, "the run stopped without being cancelled")
}

fn panicked() -> Problem {
    let detail = "the run failed with an internal error; see the worker's log";
    Problem::new(ProblemType::WorkerPanicked, detail)
}
