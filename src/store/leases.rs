//! Detects expired leases without relying on the wall clock.
//!
//! A lease has expired when this process has observed it without renewal for its whole length, by a monotonic clock. So a wall clock
//! that is set forward takes no job from its worker, and one that is set back delays no expiry. A process that starts waits just as
//! long for the leases that it finds, since it cannot know whether their workers live.

use std::{collections::HashMap, time::Duration};

use super::WorkerDeath;
use crate::domain::JobId;

/// A lease in the database. Every renewal changes `until`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct LeaseRow {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) until: i64,
}

/// The leases that this process has observed.
#[derive(Debug, Default)]
pub(super) struct LeaseWatch {
    /// `None` until the first observation.
    seen: Option<HashMap<JobId, Seen>>,
}

#[derive(Debug, Clone, Copy)]
struct Seen {
    row: LeaseRow,
    since: Duration,
    /// Whether it was granted or renewed while this process observed it.
    in_use: bool,
}

impl LeaseWatch {
    /// Compares all leases at the time `now` with the observation before, and returns the expired ones.
    pub(super) fn observe(
        &mut self,
        rows: &[LeaseRow],
        lease: Duration,
        now: Duration,
    ) -> Vec<(LeaseRow, WorkerDeath)> {
        let before = self.seen.take();
        let seen = rows.iter().map(|&row| {
            let known =
                before.as_ref().and_then(|before| before.get(&row.job)).filter(|seen| seen.row == row);
            (row.job, known.copied().unwrap_or(Seen { row, since: now, in_use: before.is_some() }))
        });
        let seen = self.seen.insert(seen.collect());
        let expired = seen.values().filter(|seen| now.saturating_sub(seen.since) >= lease);
        expired
            .map(|seen| (seen.row, if seen.in_use { WorkerDeath::Alone } else { WorkerDeath::WithService }))
            .collect()
    }

    /// A lease was granted or renewed through this process.
    pub(super) fn renewed(&mut self, row: LeaseRow, now: Duration) {
        if let Some(seen) = &mut self.seen {
            seen.insert(row.job, Seen { row, since: now, in_use: true });
        }
    }

    /// Starts anew, after a time in which workers may have been unable to renew.
    pub(super) fn reset(&mut self) {
        self.seen = None;
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    const LEASE: Duration = Duration::from_secs(60);

    fn row(attempt: u32, until: i64) -> LeaseRow {
        LeaseRow { job: JobId(Uuid::from_u128(1)), attempt, until }
    }

    /// Results of observations at these seconds, each of one lease.
    fn observe_all(watch: &mut LeaseWatch, observations: &[(u64, LeaseRow)]) -> Vec<Option<WorkerDeath>> {
        let observe = |(seconds, row): &(u64, LeaseRow)| {
            let expired = watch.observe(&[*row], LEASE, Duration::from_secs(*seconds));
            assert!(expired.iter().all(|(expired, _)| expired == row));
            expired.first().map(|(_, death)| *death)
        };
        observations.iter().map(observe).collect()
    }

    #[test]
    fn a_lease_expires_once_it_was_observed_without_renewal_for_its_length() {
        for (seen, expected) in [
            // Found at the first observation: its worker's past is unknown.
            (vec![(0, row(1, 7)), (59, row(1, 7)), (60, row(1, 7))], Some(WorkerDeath::WithService)),
            // A renewal restarts the time, and shows that its worker lived.
            (vec![(0, row(1, 7)), (59, row(1, 8)), (118, row(1, 8))], None),
            (vec![(0, row(1, 7)), (59, row(1, 8)), (119, row(1, 8))], Some(WorkerDeath::Alone)),
            // So does one to an earlier time, by a clock that was set back.
            (vec![(0, row(1, 7)), (59, row(1, 3)), (118, row(1, 3))], None),
            (vec![(0, row(1, 7)), (59, row(2, 7)), (119, row(2, 7))], Some(WorkerDeath::Alone)),
        ] {
            let ends = observe_all(&mut LeaseWatch::default(), &seen);
            assert_eq!(ends.last(), Some(&expected), "{seen:?}");
            assert!(ends[..ends.len() - 1].iter().all(Option::is_none), "{seen:?}");
        }
    }

    #[test]
    fn a_lease_that_appears_between_observations_was_in_use() {
        let mut watch = LeaseWatch::default();
        assert_eq!(watch.observe(&[], LEASE, Duration::ZERO), []);
        assert_eq!(
            observe_all(&mut watch, &[(1, row(1, 7)), (61, row(1, 7))]),
            [None, Some(WorkerDeath::Alone)]
        );
    }

    #[test]
    fn after_a_time_without_renewals_the_count_starts_anew() {
        let mut watch = LeaseWatch::default();
        assert_eq!(observe_all(&mut watch, &[(0, row(1, 7)), (50, row(1, 8))]), [None, None]);
        watch.reset();
        assert_eq!(
            observe_all(&mut watch, &[(110, row(1, 8)), (169, row(1, 8)), (170, row(1, 8))]),
            [None, None, Some(WorkerDeath::WithService)]
        );
    }

    #[test]
    fn a_renewal_through_this_process_counts_at_once() {
        let mut watch = LeaseWatch::default();
        assert_eq!(observe_all(&mut watch, &[(0, row(1, 7))]), [None]);
        watch.renewed(row(1, 9), Duration::from_secs(50));
        assert_eq!(
            observe_all(&mut watch, &[(109, row(1, 9)), (110, row(1, 9))]),
            [None, Some(WorkerDeath::Alone)]
        );
        assert_eq!(
            watch.observe(&[], LEASE, Duration::from_secs(300)),
            [],
            "the lease of a job that has ended is dropped"
        );
    }
}
