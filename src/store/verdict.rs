//! What becomes of a job when an attempt at it ends. Pure: every database decides the same.
//!
//! What always holds: an attempt is charged only if its worker says that it failed. A job is given up for ending its worker only if
//! that ended alone, [`QueuePolicy::max_silent_deaths`] times in a row, with no newer checkpoint in between.

use std::time::Duration;

use jiff::Timestamp;

use super::{AttemptOutcome, Death, Outcome, QueuePolicy};
use crate::domain::{JobId, Problem};

/// What of a running job bears on its future.
#[derive(Debug, Clone)]
pub(super) struct Standing {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) charged: u32,
    pub(super) max_attempts: u32,
    pub(super) setbacks: Setbacks,
    /// Step of the newest checkpoint.
    pub(super) checkpoint: u64,
    /// Whether that is newer than the end of the attempt before.
    pub(super) progressed: bool,
    pub(super) cancel_requested: bool,
    /// The deadline, once it has passed.
    pub(super) overdue: Option<Timestamp>,
}

/// Attempts in a row that ended without a word and without a newer checkpoint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Setbacks {
    /// Those whose worker ended alone.
    pub(super) alone: u32,
    /// The others.
    pub(super) together: u32,
}

/// How an attempt ended.
#[derive(Debug)]
pub(super) enum End {
    /// As its worker tells it.
    Told(Outcome),
    /// Its worker fell silent.
    Lost(Death),
}

/// Where the job goes.
#[derive(Debug)]
pub(super) enum Next {
    Succeed(Outcome),
    Fail(Problem),
    Cancel,
    Requeue { delay: Duration, refund: bool, setbacks: Setbacks },
}

/// The attempt's entry in the history, its cause, and the job's next state.
pub(super) fn verdict(
    policy: &QueuePolicy,
    standing: &Standing,
    end: End,
) -> (AttemptOutcome, Option<Problem>, Next) {
    if standing.cancel_requested {
        let outcome =
            if matches!(end, End::Lost(_)) { AttemptOutcome::Lost } else { AttemptOutcome::Cancelled };
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
            let setbacks = Setbacks::default();
            (AttemptOutcome::Retried, Some(problem), Next::Requeue { delay, refund: false, setbacks })
        }
        End::Told(Outcome::Held(problem)) => (
            AttemptOutcome::Released,
            Some(problem),
            Next::Requeue { delay: policy.hold, refund: true, setbacks: standing.setbacks_so_far() },
        ),
        End::Told(Outcome::Released) => (
            AttemptOutcome::Released,
            None,
            Next::Requeue { delay: Duration::ZERO, refund: true, setbacks: Setbacks::default() },
        ),
        End::Lost(death) => {
            let (setbacks, next) = lost(policy, standing, death);
            let next = next.unwrap_or_else(|| Next::Requeue {
                delay: restart_delay(policy, standing.job, setbacks),
                refund: true,
                setbacks,
            });
            (AttemptOutcome::Lost, Some(worker_lost(death)), next)
        }
    }
}

impl Standing {
    /// Those that a checkpoint has not made good.
    fn setbacks_so_far(&self) -> Setbacks {
        if self.progressed { Setbacks::default() } else { self.setbacks }
    }
}

/// Counts a lost attempt, and gives the job up if its worker alone has ended too often.
fn lost(policy: &QueuePolicy, standing: &Standing, death: Death) -> (Setbacks, Option<Next>) {
    let before = standing.setbacks_so_far();
    match death {
        Death::Alone => {
            let setbacks = Setbacks { alone: before.alone.saturating_add(1), ..before };
            let given_up = setbacks.alone >= policy.max_silent_deaths;
            (setbacks, given_up.then(|| Next::Fail(poison(setbacks.alone, standing.checkpoint))))
        }
        Death::Together => (Setbacks { together: before.together.saturating_add(1), ..before }, None),
    }
}

/// A job that gets nowhere between the ends of machines leaves the others a turn.
fn restart_delay(policy: &QueuePolicy, job: JobId, setbacks: Setbacks) -> Duration {
    match setbacks.together.saturating_sub(policy.prompt_restarts) {
        0 => Duration::ZERO,
        further => policy.backoff(job, further),
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

fn worker_lost(death: Death) -> Problem {
    let detail = match death {
        Death::Alone => {
            "the worker process that ran this attempt ended or stopped answering before it could say why, while the service \
             went on"
        }
        Death::Together => {
            "the worker process that ran this attempt ended together with the service, or unwatched, as in a power cut; the \
             attempt does not count against the job"
        }
    };
    Problem::new(500, "worker-lost", "The worker fell silent", detail)
}

fn poison(deaths: u32, checkpoint: u64) -> Problem {
    let place = match checkpoint {
        0 => "before its first checkpoint".to_owned(),
        step => format!("after its checkpoint at step {step}, without reaching another"),
    };
    Problem::new(
        507,
        "resource-exhausted",
        "The job ended its worker",
        format!(
            "{deaths} attempts in a row ended {place}, without a word from the worker, while the service went on; that is what \
             running out of memory looks like; try fewer or smaller images, or a machine with more memory"
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

    fn standing(charged: u32, alone: u32, cancel_requested: bool) -> Standing {
        let job = JobId(Uuid::from_u128(1));
        Standing {
            job,
            attempt: charged,
            charged,
            max_attempts: 3,
            setbacks: Setbacks { alone, together: 0 },
            checkpoint: 0,
            progressed: false,
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
        for outcome in [
            Outcome::Retry(problem()),
            Outcome::Failed(problem()),
            Outcome::Held(problem()),
            Outcome::Released,
        ] {
            let (_, _, next) = verdict(&policy, &standing(1, 0, true), End::Told(outcome));
            assert!(matches!(next, Next::Cancel));
        }
        for death in [Death::Alone, Death::Together] {
            let (outcome, _, next) = verdict(&policy, &standing(1, 1, true), End::Lost(death));
            assert_eq!(outcome, AttemptOutcome::Lost);
            assert!(matches!(next, Next::Cancel));
        }
    }

    #[test]
    fn after_the_deadline_there_is_no_other_attempt_but_what_is_finished_stands() {
        let policy = QueuePolicy::default();
        let deadline = Timestamp::from_second(1_800_000_000).expect("an instant");
        let late = Standing { overdue: Some(deadline), ..standing(1, 0, false) };
        for (end, attempt, cause) in [
            (End::Told(Outcome::Released), AttemptOutcome::Failed, "deadline-exceeded"),
            (End::Told(Outcome::Retry(problem())), AttemptOutcome::Failed, "device-lost"),
            (End::Told(Outcome::Held(problem())), AttemptOutcome::Failed, "device-lost"),
            (End::Lost(Death::Alone), AttemptOutcome::Lost, "worker-lost"),
            (End::Lost(Death::Together), AttemptOutcome::Lost, "worker-lost"),
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
        let (_, cause, next) =
            verdict(&QueuePolicy::default(), &standing(3, 1, false), End::Told(Outcome::Released));
        assert_eq!(cause, None);
        let Next::Requeue { delay, refund, setbacks } = next else { panic!("{next:?}") };
        assert_eq!((delay, refund, setbacks), (Duration::ZERO, true, Setbacks::default()));
    }

    #[test]
    fn a_job_that_is_held_says_why_waits_and_is_not_charged_however_often() {
        let policy = QueuePolicy::default();
        for charged in [1, 3, 1000] {
            let (outcome, cause, next) =
                verdict(&policy, &standing(charged, 1, false), End::Told(Outcome::Held(problem())));
            assert_eq!((outcome, cause), (AttemptOutcome::Released, Some(problem())));
            let Next::Requeue { delay, refund, setbacks } = next else { panic!("{next:?}") };
            assert_eq!((delay, refund), (policy.hold, true));
            assert_eq!(setbacks, Setbacks { alone: 1, together: 0 }, "it says nothing of earlier deaths");
        }
    }

    /// How attempts are lost one after another: each with the step of the newest checkpoint then.
    type Ends = &'static [(Death, u64)];

    /// What becomes of a job whose attempts are lost so.
    fn lose(ends: &[(Death, u64)]) -> Result<(Setbacks, Vec<u64>), Problem> {
        let policy = QueuePolicy::default();
        let (mut setbacks, mut reached, mut delays) = (Setbacks::default(), 0, Vec::new());
        for (death, checkpoint) in ends {
            // Charged as often as may be: that has no part in this.
            let standing = Standing {
                setbacks,
                checkpoint: *checkpoint,
                progressed: *checkpoint > reached,
                ..standing(3, 0, false)
            };
            match verdict(&policy, &standing, End::Lost(*death)).2 {
                Next::Requeue { delay, refund: true, setbacks: now } => {
                    (setbacks, reached) = (now, *checkpoint);
                    delays.push(delay.as_secs());
                }
                Next::Fail(problem) => return Err(problem),
                other => panic!("{other:?}"),
            }
        }
        Ok((setbacks, delays))
    }

    #[test]
    fn a_job_is_given_up_once_its_worker_alone_died_twice_at_the_same_step_and_for_no_other_loss() {
        use Death::{Alone, Together};
        // The row of ends, and after how many deaths at which step the job is given up, if it is.
        let table: [(Ends, Option<&str>); 9] = [
            (&[(Alone, 0)], None),
            (&[(Alone, 0), (Alone, 0)], Some("2 attempts in a row ended before its first checkpoint")),
            (&[(Alone, 70), (Alone, 70)], Some("2 attempts in a row ended after its checkpoint at step 70")),
            (&[(Alone, 0), (Alone, 70), (Alone, 140), (Alone, 141)], None),
            (&[(Alone, 0), (Alone, 70), (Alone, 70)], Some("step 70, without reaching another")),
            // What a power cut does in between makes nothing worse and nothing good.
            (&[(Alone, 70), (Together, 70), (Alone, 70)], Some("2 attempts")),
            (&[(Alone, 70), (Together, 71), (Alone, 71)], None),
            (&[(Together, 0); 100], None),
            (&[(Together, 5), (Together, 5), (Together, 5), (Alone, 5)], None),
        ];
        for (ends, expected) in table {
            match (lose(ends), expected) {
                (Ok(_), None) => {}
                (Err(problem), Some(said)) => {
                    assert!(problem.kind.ends_with("resource-exhausted"), "{problem}");
                    assert!(problem.detail.contains(said), "{ends:?}: {problem}");
                }
                (came, _) => panic!("{ends:?}: {came:?}"),
            }
        }
    }

    #[test]
    fn ends_of_the_machine_delay_a_job_only_once_it_gets_nowhere_between_them() {
        use Death::Together;
        let (setbacks, delays) = lose(&[(Together, 0); 5]).expect("not given up");
        assert_eq!(setbacks, Setbacks { alone: 0, together: 5 });
        assert_eq!(delays[..3], [0, 0, 0]);
        assert!((9..=11).contains(&delays[3]) && (18..=22).contains(&delays[4]), "{delays:?}");
        let onwards: Vec<_> = (0..10).map(|step| (Together, step)).collect();
        let (setbacks, delays) = lose(&onwards).expect("not given up");
        assert_eq!((setbacks.together, delays), (1, vec![0; 10]));
    }

    #[test]
    fn retries_are_charged_until_they_are_used_up() {
        let policy = QueuePolicy::default();
        for charged in [1, 2] {
            let (_, _, next) =
                verdict(&policy, &standing(charged, 1, false), End::Told(Outcome::Retry(problem())));
            let Next::Requeue { refund, setbacks, .. } = next else { panic!("{next:?}") };
            assert_eq!((refund, setbacks), (false, Setbacks::default()));
        }
        let (_, _, last) = verdict(&policy, &standing(3, 0, false), End::Told(Outcome::Retry(problem())));
        let Next::Fail(problem) = last else { panic!("{last:?}") };
        assert!(problem.detail.contains("3 attempts"), "{problem}");
    }
}
