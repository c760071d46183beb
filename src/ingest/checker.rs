//! Checks of uploaded datasets, limited in number at a time and in duration.

use std::{
    path::Path,
    sync::{Condvar, Mutex, PoisonError},
    time::Duration,
};

use super::{
    check_by,
    deadline::Deadline,
    error::{IngestError, IngestErrorKind},
    limits::Limits,
};
use crate::domain::{DatasetSummary, Problem};

/// Bounds how many datasets are checked at a time, and for how long each.
///
/// One check takes less than 128 MiB of memory, so all together take less than that times their number.
#[derive(Debug)]
pub struct DatasetChecker {
    limits: Limits,
    time: Duration,
    free: Mutex<usize>,
    freed: Condvar,
}

impl DatasetChecker {
    /// At most `max_concurrent` at a time, of at most `time` each. Further callers wait for a slot, for at most `time`.
    #[must_use]
    pub fn new(max_concurrent: usize, time: Duration) -> Self {
        Self { limits: Limits::default(), time, free: Mutex::new(max_concurrent), freed: Condvar::new() }
    }

    /// As [`super::check`], once a slot is free.
    ///
    /// # Errors
    /// As [`super::check`], 413 if the check takes too long, and 503 if no slot becomes free.
    pub fn check(&self, path: &Path) -> Result<DatasetSummary, Problem> {
        let _slot = self.acquire()?;
        Ok(check_by(Deadline::after(self.time), path, &self.limits)?)
    }

    fn acquire(&self) -> Result<CheckSlot<'_>, IngestError> {
        let free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut free, _) = self
            .freed
            .wait_timeout_while(free, self.time, |free| *free == 0)
            .unwrap_or_else(PoisonError::into_inner);
        if *free == 0 {
            return Err(IngestErrorKind::ChecksBusy.into());
        }
        *free -= 1;
        Ok(CheckSlot(self))
    }
}

/// The right to run one check, released when this is dropped.
struct CheckSlot<'a>(&'a DatasetChecker);

impl Drop for CheckSlot<'_> {
    fn drop(&mut self) {
        *self.0.free.lock().unwrap_or_else(PoisonError::into_inner) += 1;
        self.0.freed.notify_one();
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
        for archive in [nerfstudio().archive(), colmap().archive()] {
            let written = file(&archive);
            assert!(DatasetChecker::new(1, MINUTE).check(&written.path).is_ok());
            let problem = DatasetChecker::new(1, Duration::ZERO).check(&written.path).expect_err("no time");
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
        let (now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..20 {
                        let slot = checks.acquire().expect("every waiter gets one");
                        most.fetch_max(1 + now.fetch_add(1, Ordering::SeqCst), Ordering::SeqCst);
                        std::thread::yield_now();
                        now.fetch_sub(1, Ordering::SeqCst);
                        drop(slot);
                    }
                });
            }
        });
        assert!(most.into_inner() <= 2);
        let none = DatasetChecker::new(0, Duration::ZERO).check(Path::new("anything")).expect_err("no slot");
        assert_eq!((none.status, none.kind.as_str()), (503, "urn:tcgs:problem:busy"), "{none}");
    }
}
