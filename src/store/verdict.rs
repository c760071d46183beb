//! What becomes of a job when an attempt at it ends. Pure: every database decides the same.

use std::time::Duration;

use jiff::Timestamp;

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
    /// The deadline, once it has passed.
    pub(super) overdue: Option<Timestamp>,
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
    match (by_end(policy, standing, end), standing.overdue) {
        // There is no time for another attempt. What was finished is published, however late.
        ((outcome, cause, Next::Requeue { .. }), Some(deadline)) => {
            let problem = overdue(deadline, standing.attempt);
            let outcome = if outcome == AttemptOutcome::Lost { outcome } else { AttemptOutcome::Failed };
            (outcome, Some(cause.unwrap_or_else(|| problem.clone())), Next::Fail(problem))
        }
        (decided, _) => decided,
    }
}

/// As if there were no deadline and nobody had cancelled the job.
fn by_end(policy: &QueuePolicy, standing: &Standing, end: End) -> (AttemptOutcome, Option<Problem>, Next) {
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

/// Why a job is given up whose deadline has passed after so many attempts at it.
pub(super) fn overdue(deadline: Timestamp, attempts: u32) -> Problem {
    let begun = match attempts {
        0 => "it was never begun".to_owned(),
        1 => "it was begun once".to_owned(),
        _ => format!("it was begun {attempts} times"),
    };
    let detail = format!("the job was to be finished by {deadline} and is given up; {begun}");
    Problem::new(504, "deadline-exceeded", "The deadline has passed", detail)
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
        Standing {
            job,
            attempt: charged,
            charged,
            max_attempts: 3,
            silent_deaths,
            cancel_requested,
            overdue: None,
        }
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
    fn after_the_deadline_there_is_no_other_attempt_but_what_is_finished_stands() {
        let policy = QueuePolicy::default();
        let deadline = Timestamp::from_second(1_800_000_000).expect("an instant");
        let late = Standing { overdue: Some(deadline), ..standing(1, 0, false) };
        for (end, attempt, cause) in [
            (End::Told(Outcome::Released), AttemptOutcome::Failed, "deadline-exceeded"),
            (End::Told(Outcome::Retry(problem())), AttemptOutcome::Failed, "device-lost"),
            (End::Lost, AttemptOutcome::Lost, "worker-lost"),
        ] {
            let (outcome, why, next) = verdict(&policy, &late, end);
            assert_eq!(outcome, attempt);
            assert!(why.expect("a cause").kind.ends_with(cause));
            let Next::Fail(problem) = next else { panic!("{next:?}") };
            assert!(problem.kind.ends_with("deadline-exceeded"), "{problem}");
            assert!(problem.detail.contains("2027-01-15T08:00:00Z") && problem.detail.contains("begun once"));
        }
        let asked = Standing { cancel_requested: true, ..late.clone() };
        assert!(matches!(verdict(&policy, &asked, End::Told(Outcome::Released)).2, Next::Cancel));
        let failed = verdict(&policy, &late, End::Told(Outcome::Failed(problem()))).2;
        assert!(matches!(failed, Next::Fail(why) if why == problem()), "its own reason says more");
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
