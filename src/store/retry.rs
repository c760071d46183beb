//! What becomes of a job when an attempt at it ends. Pure: every database decides the same.
//!
//! What always holds: an attempt is charged only if its worker says that it failed. A job is given up for ending its worker only if
//! that ended alone, [`QueuePolicy::max_worker_crashes`] times in a row, with no newer checkpoint in between.

use std::time::Duration;

use jiff::Timestamp;

use super::{AttemptOutcome, Outcome, QueuePolicy, WorkerDeath};
use crate::domain::{JobId, Problem};

/// What of a running job bears on its future.
#[derive(Debug, Clone)]
pub(super) struct AttemptState {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) charged: u32,
    pub(super) max_attempts: u32,
    pub(super) setbacks: LossStreak,
    /// Step of the newest checkpoint.
    pub(super) checkpoint: u64,
    /// Whether that is newer than the end of the attempt before.
    pub(super) checkpoint_advanced: bool,
    pub(super) cancel_requested: bool,
    /// The deadline, once it has passed.
    pub(super) missed_deadline: Option<Timestamp>,
}

/// Attempts in a row that ended without a word and without a newer checkpoint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct LossStreak {
    /// Those whose worker ended alone.
    pub(super) alone: u32,
    /// The others.
    pub(super) with_service: u32,
}

/// How an attempt ended.
#[derive(Debug)]
pub(super) enum AttemptEnd {
    /// As its worker tells it.
    Reported(Outcome),
    /// Its worker fell silent.
    Lost(WorkerDeath),
}

/// Where the job goes.
#[derive(Debug)]
pub(super) enum NextState {
    Succeed(Outcome),
    Fail(Problem),
    Cancel,
    Requeue { delay: Duration, refund: bool, setbacks: LossStreak },
}

/// The attempt's entry in the history, its cause, and the job's next state.
pub(super) fn decide(
    policy: &QueuePolicy,
    state: &AttemptState,
    end: AttemptEnd,
) -> (AttemptOutcome, Option<Problem>, NextState) {
    if state.cancel_requested {
        let outcome =
            if matches!(end, AttemptEnd::Lost(_)) { AttemptOutcome::Lost } else { AttemptOutcome::Cancelled };
        return (outcome, None, NextState::Cancel);
    }
    match (by_end(policy, state, end), state.missed_deadline) {
        // There is no time for another attempt. What was finished is published, however late.
        ((outcome, cause, NextState::Requeue { .. }), Some(deadline)) => {
            let problem = deadline_exceeded(deadline, state.attempt);
            let outcome = if outcome == AttemptOutcome::Lost { outcome } else { AttemptOutcome::Failed };
            (outcome, Some(cause.unwrap_or_else(|| problem.clone())), NextState::Fail(problem))
        }
        (decided, _) => decided,
    }
}

/// As if there were no deadline and nobody had cancelled the job.
fn by_end(
    policy: &QueuePolicy,
    state: &AttemptState,
    end: AttemptEnd,
) -> (AttemptOutcome, Option<Problem>, NextState) {
    match end {
        AttemptEnd::Reported(succeeded @ Outcome::Succeeded { .. }) => {
            (AttemptOutcome::Succeeded, None, NextState::Succeed(succeeded))
        }
        AttemptEnd::Reported(Outcome::Cancelled) => (AttemptOutcome::Cancelled, None, NextState::Cancel),
        AttemptEnd::Reported(Outcome::Failed(problem)) => {
            (AttemptOutcome::Failed, Some(problem.clone()), NextState::Fail(problem))
        }
        AttemptEnd::Reported(Outcome::Retry(problem)) if state.charged >= state.max_attempts => (
            AttemptOutcome::Failed,
            Some(problem.clone()),
            NextState::Fail(attempts_exhausted(problem, state.charged)),
        ),
        AttemptEnd::Reported(Outcome::Retry(problem)) => {
            let delay = policy.backoff(state.job, state.charged);
            let setbacks = LossStreak::default();
            (AttemptOutcome::Retried, Some(problem), NextState::Requeue { delay, refund: false, setbacks })
        }
        AttemptEnd::Reported(Outcome::Held(problem)) => (
            AttemptOutcome::Released,
            Some(problem),
            NextState::Requeue { delay: policy.hold_delay, refund: true, setbacks: state.setbacks_so_far() },
        ),
        AttemptEnd::Reported(Outcome::Released) => (
            AttemptOutcome::Released,
            None,
            NextState::Requeue { delay: Duration::ZERO, refund: true, setbacks: LossStreak::default() },
        ),
        AttemptEnd::Lost(death) => {
            let (setbacks, next) = lost(policy, state, death);
            let next = next.unwrap_or_else(|| NextState::Requeue {
                delay: restart_delay(policy, state.job, setbacks),
                refund: true,
                setbacks,
            });
            (AttemptOutcome::Lost, Some(worker_lost(death)), next)
        }
    }
}

impl AttemptState {
    /// Those that a checkpoint has not made good.
    fn setbacks_so_far(&self) -> LossStreak {
        if self.checkpoint_advanced { LossStreak::default() } else { self.setbacks }
    }
}

/// Counts a lost attempt, and gives the job up if its worker alone has ended too often.
fn lost(policy: &QueuePolicy, state: &AttemptState, death: WorkerDeath) -> (LossStreak, Option<NextState>) {
    let before = state.setbacks_so_far();
    match death {
        WorkerDeath::Alone => {
            let setbacks = LossStreak { alone: before.alone.saturating_add(1), ..before };
            let given_up = setbacks.alone >= policy.max_worker_crashes;
            (setbacks, given_up.then(|| NextState::Fail(crash_loop(setbacks.alone, state.checkpoint))))
        }
        WorkerDeath::WithService => {
            (LossStreak { with_service: before.with_service.saturating_add(1), ..before }, None)
        }
    }
}

/// A job that gets nowhere between the ends of machines leaves the others a turn.
fn restart_delay(policy: &QueuePolicy, job: JobId, setbacks: LossStreak) -> Duration {
    match setbacks.with_service.saturating_sub(policy.immediate_restarts) {
        0 => Duration::ZERO,
        further => policy.backoff(job, further),
    }
}

/// Why a job is given up whose deadline has passed after so many attempts at it.
pub(super) fn deadline_exceeded(deadline: Timestamp, attempts: u32) -> Problem {
    let begun = match attempts {
        0 => "it was never begun".to_owned(),
        1 => "it was begun once".to_owned(),
        _ => format!("it was begun {attempts} times"),
    };
    let detail = format!("the job was to be finished by {deadline} and is given up; {begun}");
    Problem::new(504, "deadline-exceeded", "The deadline has passed", detail)
}

fn worker_lost(death: WorkerDeath) -> Problem {
    let detail = match death {
        WorkerDeath::Alone => {
            "the worker process that ran this attempt ended or stopped answering before it could say why, while the service \
             went on"
        }
        WorkerDeath::WithService => {
            "the worker process that ran this attempt ended together with the service, or unwatched, as in a power cut; the \
             attempt does not count against the job"
        }
    };
    Problem::new(500, "worker-lost", "The worker fell silent", detail)
}

fn crash_loop(deaths: u32, checkpoint: u64) -> Problem {
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

fn attempts_exhausted(mut problem: Problem, attempts: u32) -> Problem {
    problem.detail = format!("{} ({attempts} attempts were made)", problem.detail);
    problem
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    fn attempt_state(charged: u32, alone: u32, cancel_requested: bool) -> AttemptState {
        let job = JobId(Uuid::from_u128(1));
        AttemptState {
            job,
            attempt: charged,
            charged,
            max_attempts: 3,
            setbacks: LossStreak { alone, with_service: 0 },
            checkpoint: 0,
            checkpoint_advanced: false,
            cancel_requested,
            missed_deadline: None,
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
            let (_, _, next) = decide(&policy, &attempt_state(1, 0, true), AttemptEnd::Reported(outcome));
            assert!(matches!(next, NextState::Cancel));
        }
        for death in [WorkerDeath::Alone, WorkerDeath::WithService] {
            let (outcome, _, next) = decide(&policy, &attempt_state(1, 1, true), AttemptEnd::Lost(death));
            assert_eq!(outcome, AttemptOutcome::Lost);
            assert!(matches!(next, NextState::Cancel));
        }
    }

    #[test]
    fn after_the_deadline_there_is_no_other_attempt_but_what_is_finished_stands() {
        let policy = QueuePolicy::default();
        let deadline = Timestamp::from_second(1_800_000_000).expect("an instant");
        let late = AttemptState { missed_deadline: Some(deadline), ..attempt_state(1, 0, false) };
        for (end, attempt, cause) in [
            (AttemptEnd::Reported(Outcome::Released), AttemptOutcome::Failed, "deadline-exceeded"),
            (AttemptEnd::Reported(Outcome::Retry(problem())), AttemptOutcome::Failed, "device-lost"),
            (AttemptEnd::Reported(Outcome::Held(problem())), AttemptOutcome::Failed, "device-lost"),
            (AttemptEnd::Lost(WorkerDeath::Alone), AttemptOutcome::Lost, "worker-lost"),
            (AttemptEnd::Lost(WorkerDeath::WithService), AttemptOutcome::Lost, "worker-lost"),
        ] {
            let (outcome, why, next) = decide(&policy, &late, end);
            assert_eq!(outcome, attempt);
            assert!(why.expect("a cause").kind.ends_with(cause));
            let NextState::Fail(problem) = next else { panic!("{next:?}") };
            assert!(problem.kind.ends_with("deadline-exceeded"), "{problem}");
            assert!(problem.detail.contains("2027-01-15T08:00:00Z") && problem.detail.contains("begun once"));
        }
        let asked = AttemptState { cancel_requested: true, ..late.clone() };
        assert!(matches!(
            decide(&policy, &asked, AttemptEnd::Reported(Outcome::Released)).2,
            NextState::Cancel
        ));
        let failed = decide(&policy, &late, AttemptEnd::Reported(Outcome::Failed(problem()))).2;
        assert!(matches!(failed, NextState::Fail(why) if why == problem()), "its own reason says more");
    }

    #[test]
    fn a_release_gives_the_charge_back_and_breaks_the_row_of_deaths() {
        let (_, cause, next) = decide(
            &QueuePolicy::default(),
            &attempt_state(3, 1, false),
            AttemptEnd::Reported(Outcome::Released),
        );
        assert_eq!(cause, None);
        let NextState::Requeue { delay, refund, setbacks } = next else { panic!("{next:?}") };
        assert_eq!((delay, refund, setbacks), (Duration::ZERO, true, LossStreak::default()));
    }

    #[test]
    fn a_job_that_is_held_says_why_waits_and_is_not_charged_however_often() {
        let policy = QueuePolicy::default();
        for charged in [1, 3, 1000] {
            let (outcome, cause, next) = decide(
                &policy,
                &attempt_state(charged, 1, false),
                AttemptEnd::Reported(Outcome::Held(problem())),
            );
            assert_eq!((outcome, cause), (AttemptOutcome::Released, Some(problem())));
            let NextState::Requeue { delay, refund, setbacks } = next else { panic!("{next:?}") };
            assert_eq!((delay, refund), (policy.hold_delay, true));
            assert_eq!(
                setbacks,
                LossStreak { alone: 1, with_service: 0 },
                "it says nothing of earlier deaths"
            );
        }
    }

    /// How attempts are lost one after another: each with the step of the newest checkpoint then.
    type Ends = &'static [(WorkerDeath, u64)];

    /// What becomes of a job whose attempts are lost so.
    fn lose(ends: &[(WorkerDeath, u64)]) -> Result<(LossStreak, Vec<u64>), Problem> {
        let policy = QueuePolicy::default();
        let (mut setbacks, mut reached, mut delays) = (LossStreak::default(), 0, Vec::new());
        for (death, checkpoint) in ends {
            // Charged as often as may be: that has no part in this.
            let state = AttemptState {
                setbacks,
                checkpoint: *checkpoint,
                checkpoint_advanced: *checkpoint > reached,
                ..attempt_state(3, 0, false)
            };
            match decide(&policy, &state, AttemptEnd::Lost(*death)).2 {
                NextState::Requeue { delay, refund: true, setbacks: now } => {
                    (setbacks, reached) = (now, *checkpoint);
                    delays.push(delay.as_secs());
                }
                NextState::Fail(problem) => return Err(problem),
                other => panic!("{other:?}"),
            }
        }
        Ok((setbacks, delays))
    }

    #[test]
    fn a_job_is_given_up_once_its_worker_alone_died_twice_at_the_same_step_and_for_no_other_loss() {
        use WorkerDeath::{Alone, WithService};
        // The row of ends, and after how many deaths at which step the job is given up, if it is.
        let table: [(Ends, Option<&str>); 9] = [
            (&[(Alone, 0)], None),
            (&[(Alone, 0), (Alone, 0)], Some("2 attempts in a row ended before its first checkpoint")),
            (&[(Alone, 70), (Alone, 70)], Some("2 attempts in a row ended after its checkpoint at step 70")),
            (&[(Alone, 0), (Alone, 70), (Alone, 140), (Alone, 141)], None),
            (&[(Alone, 0), (Alone, 70), (Alone, 70)], Some("step 70, without reaching another")),
            // What a power cut does in between makes nothing worse and nothing good.
            (&[(Alone, 70), (WithService, 70), (Alone, 70)], Some("2 attempts")),
            (&[(Alone, 70), (WithService, 71), (Alone, 71)], None),
            (&[(WithService, 0); 100], None),
            (&[(WithService, 5), (WithService, 5), (WithService, 5), (Alone, 5)], None),
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
        use WorkerDeath::WithService;
        let (setbacks, delays) = lose(&[(WithService, 0); 5]).expect("not given up");
        assert_eq!(setbacks, LossStreak { alone: 0, with_service: 5 });
        assert_eq!(delays[..3], [0, 0, 0]);
        assert!((9..=11).contains(&delays[3]) && (18..=22).contains(&delays[4]), "{delays:?}");
        let onwards: Vec<_> = (0..10).map(|step| (WithService, step)).collect();
        let (setbacks, delays) = lose(&onwards).expect("not given up");
        assert_eq!((setbacks.with_service, delays), (1, vec![0; 10]));
    }

    #[test]
    fn retries_are_charged_until_they_are_used_up() {
        let policy = QueuePolicy::default();
        for charged in [1, 2] {
            let (_, _, next) = decide(
                &policy,
                &attempt_state(charged, 1, false),
                AttemptEnd::Reported(Outcome::Retry(problem())),
            );
            let NextState::Requeue { refund, setbacks, .. } = next else { panic!("{next:?}") };
            assert_eq!((refund, setbacks), (false, LossStreak::default()));
        }
        let (_, _, last) =
            decide(&policy, &attempt_state(3, 0, false), AttemptEnd::Reported(Outcome::Retry(problem())));
        let NextState::Fail(problem) = last else { panic!("{last:?}") };
        assert!(problem.detail.contains("3 attempts"), "{problem}");
    }
}
