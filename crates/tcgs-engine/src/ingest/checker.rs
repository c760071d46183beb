//! Checks of uploaded datasets, limited in number at a time and in duration.

use std::{path::Path, time::Duration};

use super::{
    check_by,
    deadline::Deadline,
    error::{IngestError, IngestErrorKind},
    limits::Limits,
    semaphore::{Semaphore, SemaphoreGuard},
};
use crate::domain::{DatasetSummary, Problem, ReadOptions};

/// Bounds how many datasets are checked at a time, and for how long each.
///
/// One check takes less than 128 MiB of memory, so all together take less than that times their number.
#[derive(Debug)]
pub struct DatasetChecker {
    limits: Limits,
    time: Duration,
    slots: Semaphore,
}

impl DatasetChecker {
    /// At most `max_concurrent` at a time, of at most `time` each. Further callers wait for a slot, for at most `time`.
    #[must_use]
    pub fn new(max_concurrent: usize, time: Duration) -> Self {
        Self { limits: Limits::default(), time, slots: Semaphore::new(max_concurrent as u64) }
    }

    /// As [`super::check`], once a slot is free.
    ///
    /// # Errors
    /// As [`super::check`], 413 if the check takes too long, and 503 if no slot becomes free.
    pub fn check(&self, path: &Path, read: &ReadOptions) -> Result<DatasetSummary, Problem> {
        let _slot = self.acquire()?;
        Ok(check_by(Deadline::after(self.time), path, &self.limits, read)?)
    }

    fn acquire(&self) -> Result<SemaphoreGuard<'_>, IngestError> {
        self.slots.acquire_within(1, self.time).ok_or_else(|| IngestErrorKind::ChecksBusy.into())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::{
        super::fixtures::{colmap, file, nerfstudio},
        *,
    };

    const MINUTE: Duration = Duration::from_secs(60);

    #[test]
    fn a_check_that_has_no_time_left_is_refused_with_the_time() {
        let read = ReadOptions::default();
        for archive in [nerfstudio().archive(), colmap().archive()] {
            let written = file(&archive);
            assert!(DatasetChecker::new(1, MINUTE).check(&written.path, &read).is_ok());
            let problem =
                DatasetChecker::new(1, Duration::ZERO).check(&written.path, &read).expect_err("no time");
            assert_eq!(problem.status, 413, "{problem}");
            assert!(problem.detail.contains("was ended after 0 s"), "{problem}");
        }
    }

    #[test]
    fn no_more_than_stated_run_at_a_time_and_slots_are_released() {
        let checks = DatasetChecker::new(2, Duration::ZERO);
        let (one, _two) = (checks.acquire().expect("a slot"), checks.acquire().expect("another"));
        assert!(matches!(checks.acquire(), Err(IngestError { kind: IngestErrorKind::ChecksBusy, .. })));
        drop(one);
        assert!(checks.acquire().is_ok());

        let checks = DatasetChecker::new(2, MINUTE);
        let (now, max) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..20 {
                        let slot = checks.acquire().expect("every waiter gets one");
                        max.fetch_max(1 + now.fetch_add(1, Ordering::SeqCst), Ordering::SeqCst);
                        std::thread::yield_now();
                        now.fetch_sub(1, Ordering::SeqCst);
                        drop(slot);
                    }
                });
            }
        });
        assert!(max.into_inner() <= 2);
        let none = DatasetChecker::new(0, Duration::ZERO)
            .check(Path::new("anything"), &ReadOptions::default())
            .expect_err("no slot");
        assert_eq!((none.status, none.kind.as_str()), (503, "urn:tcgs:problem:busy"), "{none}");
    }
}
