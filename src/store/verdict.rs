//! What becomes of a job when an attempt at it ends. Pure: every database decides the same.

use std::time::Duration;

use super::{AttemptOutcome, Outcome, QueuePolicy};
use crate::domain::{JobId, Problem};

/// What of a running job bears on its future.
#[derive(Debug, Clone)]
pub(super) struct Standing {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) charged: u32,
    pub(super) max_attempts: u32,
    pub(super) silent_deaths: u32,
    pub(super) cancel_requested: bool,
}

/// How an attempt ended.
#[derive(Debug)]
pub(super) enum End {
    /// As its worker tells it.
    Told(Outcome),
    /// Its worker fell silent.
    Lost,
}

/// Where the job goes.
#[derive(Debug)]
pub(super) enum Next {
    Succeed(Outcome),
    Fail(Problem),
    Cancel,
    Requeue { delay: Duration, refund: bool, silent_deaths: u32 },
}

/// The attempt's entry in the history, its cause, and the job's next state.
pub(super) fn verdict(
    policy: &QueuePolicy,
    standing: &Standing,
    end: End,
) -> (AttemptOutcome, Option<Problem>, Next) {
    if standing.cancel_requested {
        let outcome = if matches!(end, End::Lost) { AttemptOutcome::Lost } else { AttemptOutcome::Cancelled };
        return (outcome, None, Next::Cancel);
    }
    match end {
        End::Told(succeeded @ Outcome::Succeeded { .. }) => {
            (AttemptOutcome::Succeeded, None, Next::Succeed(succeeded))
        }
        End::Told(Outcome::Cancelled) => (AttemptOutcome::Cancelled, None, Next::Cancel),
        End::Told(Outcome::Failed(problem)) => {
            (AttemptOutcome::Failed, Some(problem.clone()), Next::Fail(problem))
        }
        End::Told(Outcome::Retry(problem)) if standing.charged >= standing.max_attempts => {
            (AttemptOutcome::Failed, Some(problem.clone()), Next::Fail(exhausted(problem, standing.charged)))
        }
        End::Told(Outcome::Retry(problem)) => {
            let delay = policy.backoff(standing.job, standing.charged);
            (AttemptOutcome::Retried, Some(problem), Next::Requeue { delay, refund: false, silent_deaths: 0 })
        }
        End::Told(Outcome::Released) => (
            AttemptOutcome::Released,
            None,
            Next::Requeue { delay: Duration::ZERO, refund: true, silent_deaths: 0 },
        ),
        End::Lost => {
            let silent_deaths = standing.silent_deaths + 1;
            let next = if silent_deaths >= policy.max_silent_deaths {
                Next::Fail(poison(silent_deaths))
            } else if standing.charged >= standing.max_attempts {
                Next::Fail(exhausted(worker_lost(), standing.charged))
            } else {
                Next::Requeue { delay: Duration::ZERO, refund: false, silent_deaths }
            };
            (AttemptOutcome::Lost, Some(worker_lost()), next)
        }
    }
}

fn worker_lost() -> Problem {
    Problem::new(
        500,
        "worker-lost",
        "The worker fell silent",
        "the worker process that ran this attempt ended or stopped answering before it could say why",
    )
}

fn poison(deaths: u32) -> Problem {
    Problem::new(
        507,
        "resource-exhausted",
        "The job ended its worker",
        format!(
            "{deaths} attempts in a row ended without a word from the worker, which is what running out of memory \
             looks like; try fewer or smaller images, or a machine with more memory"
        ),
    )
}

fn exhausted(mut problem: Problem, attempts: u32) -> Problem {
    problem.detail = format!("{} ({attempts} attempts were made)", problem.detail);
    problem
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    fn standing(charged: u32, silent_deaths: u32, cancel_requested: bool) -> Standing {
        let job = JobId(Uuid::from_u128(1));
        Standing { job, attempt: charged, charged, max_attempts: 3, silent_deaths, cancel_requested }
    }

    fn problem() -> Problem {
        Problem::new(500, "device-lost", "Device lost", "the adapter went away")
    }

    #[test]
    fn cancel_beats_retry_failure_and_release() {
        let policy = QueuePolicy::default();
        for outcome in [Outcome::Retry(problem()), Outcome::Failed(problem()), Outcome::Released] {
            let (_, _, next) = verdict(&policy, &standing(1, 0, true), End::Told(outcome));
            assert!(matches!(next, Next::Cancel));
        }
        assert!(matches!(verdict(&policy, &standing(1, 0, true), End::Lost).2, Next::Cancel));
    }

    #[test]
    fn a_release_gives_the_charge_back_and_breaks_the_row_of_deaths() {
        let (_, _, next) =
            verdict(&QueuePolicy::default(), &standing(3, 1, false), End::Told(Outcome::Released));
        assert!(matches!(next, Next::Requeue { refund: true, silent_deaths: 0, delay: Duration::ZERO }));
    }

    #[test]
    fn the_second_silent_death_in_a_row_is_poison() {
        let policy = QueuePolicy::default();
        let (_, _, first) = verdict(&policy, &standing(1, 0, false), End::Lost);
        assert!(matches!(first, Next::Requeue { silent_deaths: 1, .. }));
        let (_, _, second) = verdict(&policy, &standing(2, 1, false), End::Lost);
        let Next::Fail(problem) = second else { panic!("{second:?}") };
        assert!(problem.kind.ends_with("resource-exhausted"));
    }

    #[test]
    fn a_loss_on_the_last_attempt_fails_the_job() {
        let (_, _, next) = verdict(&QueuePolicy::default(), &standing(3, 0, false), End::Lost);
        let Next::Fail(problem) = next else { panic!("{next:?}") };
        assert!(problem.detail.contains("3 attempts"), "{problem}");
    }
}
