//! Durations and limits of the queue.

use std::time::Duration;

use crate::domain::{Digest, JobId, ProjectLimits, with_defaults};

with_defaults! {
    /// Durations and limits of the queue.
    #[derive(Debug, Clone, PartialEq)]
    pub struct QueuePolicy {
        /// How long a claim or a heartbeat holds a job.
        pub lease: Duration = Duration::from_secs(60),
        /// Charged attempts before a job fails.
        pub max_attempts: u32 = 3,
        /// Consecutive attempts whose worker died alone (killed, out of memory), without a newer checkpoint in between, before the job
        /// fails as the cause.
        pub max_worker_crashes: u32 = 2,
        /// Consecutive attempts that ended together with the service, without a newer checkpoint in between, before the next one is
        /// delayed. Such a job never fails for that, but it may be what brings the machine down.
        pub immediate_restarts: u32 = 3,
        /// How long a job that is held for the first time waits until its next attempt; each further hold doubles it.
        pub hold_delay: Duration = Duration::from_secs(10),
        /// Longest time that a held job waits: soon after there is room again, everything goes on.
        pub hold_cap: Duration = Duration::from_secs(60),
        /// Delay before the second attempt; each further one doubles it.
        pub backoff_base: Duration = Duration::from_secs(10),
        /// Longest delay between attempts.
        pub backoff_cap: Duration = Duration::from_secs(600),
        /// Shortest time between two `progress` events of a job.
        pub progress_event_every: Duration = Duration::from_secs(5),
        /// How long a job that failed or was cancelled keeps its checkpoint, for a job that retries it.
        pub checkpoint_ttl: Duration = Duration::from_secs(24 * 3600),
        /// How long an `Idempotency-Key` is kept.
        pub idempotency_ttl: Duration = Duration::from_secs(24 * 3600),
        /// Limits of projects that have none of their own. Of these, the default project gets only the bound on running jobs.
        pub limits: ProjectLimits = ProjectLimits::default(),
    }
}

impl QueuePolicy {
    /// The delay after the `charged`-th charged attempt failed: `min(cap, base * 2^(charged - 1))`, spread by a
    /// factor in [0.9, 1.1] that the job and the attempt decide, so that it needs no randomness.
    #[must_use]
    pub fn backoff(&self, job: JobId, charged: u32) -> Duration {
        let doubled = self.backoff_base.saturating_mul(1_u32 << charged.saturating_sub(1).min(20));
        let draw = Digest::of(format!("{job}/{charged}").as_bytes()).as_bytes()[0];
        doubled.min(self.backoff_cap).mul_f64(0.9 + 0.2 * f64::from(draw) / 255.0)
    }

    /// The delay after a job was held whose `earlier` attempts before were held too.
    #[must_use]
    pub fn hold(&self, earlier: u32) -> Duration {
        self.hold_delay.saturating_mul(1_u32 << earlier.min(20)).min(self.hold_cap)
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn backoff_doubles_up_to_the_cap_within_a_tenth() {
        let policy = QueuePolicy::default();
        for (charged, seconds) in [(0, 10.0), (1, 10.0), (2, 20.0), (3, 40.0), (30, 600.0), (u32::MAX, 600.0)]
        {
            let delay = policy.backoff(JobId(Uuid::from_u128(7)), charged).as_secs_f64();
            assert!((delay / seconds - 1.0).abs() < 0.1001, "attempt {charged}: {delay} s");
        }
    }

    #[test]
    fn jobs_that_fail_together_are_not_repeated_together() {
        let policy = QueuePolicy::default();
        let delays = (0..100).map(|job| policy.backoff(JobId(Uuid::from_u128(job)), 1).as_secs_f64());
        let (min, max) = delays.fold((f64::MAX, 0.0), |(min, max), delay| (delay.min(min), delay.max(max)));
        assert!((9.0..9.2).contains(&min) && (10.8..=11.0).contains(&max), "{min} to {max} s");
    }
}
