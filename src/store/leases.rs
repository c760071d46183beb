//! Which leases have run out, as this process has seen for itself.
//!
//! A lease runs out when this process has seen it unrenewed for as long as it lasts. Its own time counts that, not the clock, so
//! a clock that is set forward takes no job from its worker, and one that is set back keeps none from the next. After its start a
//! process finds leases of which it cannot tell whether anybody renews them; it waits for them as long.

use std::{collections::HashMap, time::Duration};

use super::WorkerDeath;
use crate::domain::JobId;

/// A lease as the database has it. Every renewal changes `until`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct LeaseRow {
    pub(super) job: JobId,
    pub(super) attempt: u32,
    pub(super) until: i64,
}

/// What a process knows of the leases in the database.
#[derive(Debug, Default)]
pub(super) struct LeaseWatch {
    /// `None` until the first look.
    seen: Option<HashMap<JobId, Seen>>,
}

#[derive(Debug, Clone, Copy)]
struct Seen {
    row: LeaseRow,
    since: Duration,
    /// Whether it was given out or renewed while this process looked on.
    in_use: bool,
}

impl LeaseWatch {
    /// Compares all leases there are at the time `now` with those of the look before, and returns those that have run out.
    pub(super) fn look(
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

    /// A lease was given out or renewed through this process.
    pub(super) fn renewed(&mut self, row: LeaseRow, now: Duration) {
        if let Some(seen) = &mut self.seen {
            seen.insert(row.job, Seen { row, since: now, in_use: true });
        }
    }

    /// Begins anew: for a while nobody may have been able to renew.
    pub(super) fn forget(&mut self) {
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

    /// What comes of looks at these seconds, each at one lease.
    fn looks(watch: &mut LeaseWatch, looks: &[(u64, LeaseRow)]) -> Vec<Option<WorkerDeath>> {
        let look = |(seconds, row): &(u64, LeaseRow)| {
            let expired = watch.look(&[*row], LEASE, Duration::from_secs(*seconds));
            assert!(expired.iter().all(|(expired, _)| expired == row));
            expired.first().map(|(_, death)| *death)
        };
        looks.iter().map(look).collect()
    }

    #[test]
    fn a_lease_runs_out_once_it_was_seen_unrenewed_for_its_length() {
        for (seen, expected) in [
            // Found at the first look: nobody knows what its worker did before.
            (vec![(0, row(1, 7)), (59, row(1, 7)), (60, row(1, 7))], Some(WorkerDeath::WithService)),
            // A renewal begins the time anew, and says that its worker lived.
            (vec![(0, row(1, 7)), (59, row(1, 8)), (118, row(1, 8))], None),
            (vec![(0, row(1, 7)), (59, row(1, 8)), (119, row(1, 8))], Some(WorkerDeath::Alone)),
            // So does one to an earlier time, by a clock that was set back.
            (vec![(0, row(1, 7)), (59, row(1, 3)), (118, row(1, 3))], None),
            (vec![(0, row(1, 7)), (59, row(2, 7)), (119, row(2, 7))], Some(WorkerDeath::Alone)),
        ] {
            let ends = looks(&mut LeaseWatch::default(), &seen);
            assert_eq!(ends.last(), Some(&expected), "{seen:?}");
            assert!(ends[..ends.len() - 1].iter().all(Option::is_none), "{seen:?}");
        }
    }

    #[test]
    fn a_lease_that_came_while_this_process_looked_on_was_in_use() {
        let mut watch = LeaseWatch::default();
        assert_eq!(watch.look(&[], LEASE, Duration::ZERO), []);
        assert_eq!(looks(&mut watch, &[(1, row(1, 7)), (61, row(1, 7))]), [None, Some(WorkerDeath::Alone)]);
    }

    #[test]
    fn after_a_time_in_which_nobody_could_renew_the_count_begins_anew() {
        let mut watch = LeaseWatch::default();
        assert_eq!(looks(&mut watch, &[(0, row(1, 7)), (50, row(1, 8))]), [None, None]);
        watch.forget();
        assert_eq!(
            looks(&mut watch, &[(110, row(1, 8)), (169, row(1, 8)), (170, row(1, 8))]),
            [None, None, Some(WorkerDeath::WithService)]
        );
    }

    #[test]
    fn what_this_process_renews_itself_is_not_looked_for() {
        let mut watch = LeaseWatch::default();
        assert_eq!(looks(&mut watch, &[(0, row(1, 7))]), [None]);
        watch.renewed(row(1, 9), Duration::from_secs(50));
        assert_eq!(
            looks(&mut watch, &[(109, row(1, 9)), (110, row(1, 9))]),
            [None, Some(WorkerDeath::Alone)]
        );
        assert_eq!(watch.look(&[], LEASE, Duration::from_secs(300)), [], "a job that has ended is forgotten");
    }
}
