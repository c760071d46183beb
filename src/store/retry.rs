//! Decides a job's next state when an attempt ends: succeeded, failed, cancelled or queued again. Pure functions.
//!
//! Invariants: an attempt is charged only if its worker reports a failure. A job fails for crashing its worker only if the worker died
//! alone, [`QueuePolicy::max_worker_crashes`] times in a row, without a newer checkpoint in between.

use std::time::Duration;

use jiff::Timestamp;

use super::{Artifact, AttemptOutcome, Outcome, QueuePolicy, WorkerDeath};
use crate::domain::{JobId, JobMetrics, Problem, ProblemType};

/// The part of a running job's row that its next state depends on.
#[derive(Debug, Clone)]
pub(super) struct AttemptState {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) charged: u32,
    pub(super) max_attempts: u32,
    /// Attempts in a row before this one that were held; only known of an attempt that is held itself.
    pub(super) holds: u32,
    /// Attempts lost in a row before this one.
    pub(super) losses: LossStreak,
    /// Step of the newest checkpoint.
    pub(super) checkpoint: u64,
    /// Whether that was written by this attempt.
    pub(super) checkpoint_advanced: bool,
    pub(super) cancel_requested: bool,
    /// The deadline, once it has passed.
    pub(super) missed_deadline: Option<Timestamp>,
}

/// Attempts in a row that were lost without a newer checkpoint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct LossStreak {
    /// Those whose worker died alone.
    pub(super) alone: u32,
    /// The others.
    pub(super) with_service: u32,
}

/// How an attempt ended.
#[derive(Debug)]
pub(super) enum AttemptEnd {
    /// As its worker reported.
    Reported(Outcome),
    /// Its worker died or stopped renewing the lease.
    Lost(WorkerDeath),
}

/// The job's next state.
#[derive(Debug)]
pub(super) enum NextState {
    Succeed { metrics: Box<JobMetrics>, artifacts: Vec<Artifact> },
    Fail(Problem),
    Cancel,
    Requeue { delay: Duration, refund: bool, losses: LossStreak },
}

/// The attempt's outcome and cause for its record, and the job's next state.
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
        // No time is left for another attempt. A finished result is published, however late.
        ((outcome, cause, NextState::Requeue { .. }), Some(deadline)) => {
            let problem = deadline_exceeded(deadline, state.attempt);
            let outcome = if outcome == AttemptOutcome::Lost { outcome } else { AttemptOutcome::Failed };
            (outcome, Some(cause.unwrap_or_else(|| problem.clone())), NextState::Fail(problem))
        }
        (decided, _) => decided,
    }
}

/// The decision without deadline and cancellation.
fn by_end(
    policy: &QueuePolicy,
    state: &AttemptState,
    end: AttemptEnd,
) -> (AttemptOutcome, Option<Problem>, NextState) {
    match end {
        AttemptEnd::Reported(Outcome::Succeeded { metrics, artifacts }) => {
            (AttemptOutcome::Succeeded, None, NextState::Succeed { metrics, artifacts })
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
            let losses = LossStreak::default();
            (AttemptOutcome::Retried, Some(problem), NextState::Requeue { delay, refund: false, losses })
        }
        AttemptEnd::Reported(Outcome::Held(problem)) => (
            AttemptOutcome::Released,
            Some(problem),
            NextState::Requeue {
                delay: policy.hold(state.holds),
                refund: true,
                losses: state.losses_so_far(),
            },
        ),
        AttemptEnd::Reported(Outcome::Released) => (
            AttemptOutcome::Released,
            None,
            NextState::Requeue { delay: Duration::ZERO, refund: true, losses: LossStreak::default() },
        ),
        AttemptEnd::Lost(death) => {
            let (losses, next) = lost(policy, state, death);
            let next = next.unwrap_or_else(|| NextState::Requeue {
                delay: restart_delay(policy, state.job, losses),
                refund: true,
                losses,
            });
            (AttemptOutcome::Lost, Some(worker_lost(death)), next)
        }
    }
}

impl AttemptState {
    /// Losses since the newest checkpoint.
    fn losses_so_far(&self) -> LossStreak {
        if self.checkpoint_advanced { LossStreak::default() } else { self.losses }
    }
}

/// Counts a lost attempt, and fails the job if its worker has died alone too often.
fn lost(policy: &QueuePolicy, state: &AttemptState, death: WorkerDeath) -> (LossStreak, Option<NextState>) {
    let before = state.losses_so_far();
    match death {
        WorkerDeath::Alone => {
            let losses = LossStreak { alone: before.alone.saturating_add(1), ..before };
            let has_failed = losses.alone >= policy.max_worker_crashes;
            (losses, has_failed.then(|| NextState::Fail(crash_loop(losses.alone, state.checkpoint))))
        }
        WorkerDeath::WithService => {
            (LossStreak { with_service: before.with_service.saturating_add(1), ..before }, None)
        }
    }
}

/// A job that makes no progress between restarts of the machine waits, so that other jobs get a turn.
fn restart_delay(policy: &QueuePolicy, job: JobId, losses: LossStreak) -> Duration {
    match losses.with_service.saturating_sub(policy.immediate_restarts) {
        0 => Duration::ZERO,
        further => policy.backoff(job, further),
    }
}

/// The problem of a job whose deadline has passed after `attempts` attempts.
pub(super) fn deadline_exceeded(deadline: Timestamp, attempts: u32) -> Problem {
    let started = match attempts {
        0 => "it was never started".to_owned(),
        1 => "it was started once".to_owned(),
        _ => format!("it was started {attempts} times"),
    };
    let detail = format!("the job was not finished by its deadline, {deadline}; {started}");
    Problem::new(ProblemType::DeadlineExceeded, detail)
}

fn worker_lost(death: WorkerDeath) -> Problem {
    let detail = match death {
        WorkerDeath::Alone => {
            "the worker process of this attempt died or stopped responding without reporting an error, while the service kept \
             running"
        }
        WorkerDeath::WithService => {
            "the worker process of this attempt ended together with the service, or while none was running, as in a power cut; \
             the attempt does not count against the job"
        }
    };
    Problem::new(ProblemType::WorkerLost, detail)
}

fn crash_loop(crashes: u32, checkpoint: u64) -> Problem {
    let place = match checkpoint {
        0 => "before its first checkpoint".to_owned(),
        step => format!("after its checkpoint at step {step}, without reaching another"),
    };
    Problem::new(
        ProblemType::ResourceExhausted,
        format!(
            "{crashes} attempts in a row ended {place}: the worker died without reporting an error while the service kept running, \
             which usually means that memory ran out; try fewer or smaller images, or a machine with more memory"
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
            holds: 0,
            losses: LossStreak { alone, with_service: 0 },
            checkpoint: 0,
            checkpoint_advanced: false,
            cancel_requested,
            missed_deadline: None,
        }
    }

    fn problem() -> Problem {
        Problem::new(ProblemType::DeviceLost, "the adapter went away")
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
    fn after_the_deadline_there_is_no_other_attempt_but_a_finished_result_counts() {
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
            assert!(
                problem.detail.contains("2027-01-15T08:00:00Z") && problem.detail.contains("started once")
            );
        }
        let asked = AttemptState { cancel_requested: true, ..late.clone() };
        assert!(matches!(
            decide(&policy, &asked, AttemptEnd::Reported(Outcome::Released)).2,
            NextState::Cancel
        ));
        let failed = decide(&policy, &late, AttemptEnd::Reported(Outcome::Failed(problem()))).2;
        assert!(
            matches!(failed, NextState::Fail(why) if why == problem()),
            "its own problem is more specific"
        );
    }

    #[test]
    fn a_missed_deadline_says_how_often_the_job_was_started() {
        for (attempts, said) in
            [(0, "it was never started"), (1, "it was started once"), (2, "it was started 2 times")]
        {
            let problem = deadline_exceeded(Timestamp::UNIX_EPOCH, attempts);
            assert!(problem.detail.ends_with(said), "{problem}");
        }
    }

    #[test]
    fn a_release_refunds_the_attempt_and_resets_the_losses() {
        let (_, cause, next) = decide(
            &QueuePolicy::default(),
            &attempt_state(3, 1, false),
            AttemptEnd::Reported(Outcome::Released),
        );
        assert_eq!(cause, None);
        let NextState::Requeue { delay, refund, losses } = next else { panic!("{next:?}") };
        assert_eq!((delay, refund, losses), (Duration::ZERO, true, LossStreak::default()));
    }

    #[test]
    fn a_held_job_states_the_cause_waits_and_is_never_charged() {
        let policy = QueuePolicy::default();
        for charged in [1, 3, 1000] {
            let (outcome, cause, next) = decide(
                &policy,
                &attempt_state(charged, 1, false),
                AttemptEnd::Reported(Outcome::Held(problem())),
            );
            assert_eq!((outcome, cause), (AttemptOutcome::Released, Some(problem())));
            let NextState::Requeue { delay, refund, losses } = next else { panic!("{next:?}") };
            assert_eq!((delay, refund), (policy.hold_delay, true));
            assert_eq!(losses, LossStreak { alone: 1, with_service: 0 }, "earlier losses still count");
        }
    }

    #[test]
    fn a_job_that_is_held_again_and_again_waits_longer_but_a_minute_at_most() {
        let policy = QueuePolicy::default();
        let delays = [0, 1, 2, 3, 1000].map(|holds| {
            let state = AttemptState { holds, ..attempt_state(1, 0, false) };
            let (_, _, next) = decide(&policy, &state, AttemptEnd::Reported(Outcome::Held(problem())));
            let NextState::Requeue { delay, .. } = next else { panic!("{next:?}") };
            delay.as_secs()
        });
        assert_eq!(delays, [10, 20, 40, 60, 60]);
    }

    /// Lost attempts in order, each with the step of the newest checkpoint at that time.
    type Losses = &'static [(WorkerDeath, u64)];

    /// The decisions for a job whose attempts are lost like this.
    fn lose(ends: &[(WorkerDeath, u64)]) -> Result<(LossStreak, Vec<u64>), Problem> {
        let policy = QueuePolicy::default();
        let (mut losses, mut reached, mut delays) = (LossStreak::default(), 0, Vec::new());
        for (death, checkpoint) in ends {
            // The number of charged attempts must not matter.
            let state = AttemptState {
                losses,
                checkpoint: *checkpoint,
                checkpoint_advanced: *checkpoint > reached,
                ..attempt_state(3, 0, false)
            };
            match decide(&policy, &state, AttemptEnd::Lost(*death)).2 {
                NextState::Requeue { delay, refund: true, losses: now } => {
                    (losses, reached) = (now, *checkpoint);
                    delays.push(delay.as_secs());
                }
                NextState::Fail(problem) => return Err(problem),
                other => panic!("{other:?}"),
            }
        }
        Ok((losses, delays))
    }

    #[test]
    fn a_job_fails_once_its_worker_died_alone_twice_at_the_same_step_and_for_no_other_loss() {
        use WorkerDeath::{Alone, WithService};
        // The losses, and a part of the problem's detail if the job fails.
        let table: [(Losses, Option<&str>); 9] = [
            (&[(Alone, 0)], None),
            (&[(Alone, 0), (Alone, 0)], Some("2 attempts in a row ended before its first checkpoint")),
            (&[(Alone, 70), (Alone, 70)], Some("2 attempts in a row ended after its checkpoint at step 70")),
            (&[(Alone, 0), (Alone, 70), (Alone, 140), (Alone, 141)], None),
            (&[(Alone, 0), (Alone, 70), (Alone, 70)], Some("step 70, without reaching another")),
            // A power cut in between neither counts nor resets.
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
    fn power_cuts_delay_a_job_only_if_it_makes_no_progress_between_them() {
        use WorkerDeath::WithService;
        let (losses, delays) = lose(&[(WithService, 0); 5]).expect("not failed");
        assert_eq!(losses, LossStreak { alone: 0, with_service: 5 });
        assert_eq!(delays[..3], [0, 0, 0]);
        assert!((9..=11).contains(&delays[3]) && (18..=22).contains(&delays[4]), "{delays:?}");
        let onwards: Vec<_> = (0..10).map(|step| (WithService, step)).collect();
        let (losses, delays) = lose(&onwards).expect("not failed");
        assert_eq!((losses.with_service, delays), (1, vec![0; 10]));
    }

    #[test]
    fn retries_are_charged_until_none_are_left() {
        let policy = QueuePolicy::default();
        for charged in [1, 2] {
            let (_, _, next) = decide(
                &policy,
                &attempt_state(charged, 1, false),
                AttemptEnd::Reported(Outcome::Retry(problem())),
            );
            let NextState::Requeue { refund, losses, .. } = next else { panic!("{next:?}") };
            assert_eq!((refund, losses), (false, LossStreak::default()));
        }
        let (_, _, last) =
            decide(&policy, &attempt_state(3, 0, false), AttemptEnd::Reported(Outcome::Retry(problem())));
        let NextState::Fail(problem) = last else { panic!("{last:?}") };
        assert!(problem.detail.contains("3 attempts"), "{problem}");
    }
}
