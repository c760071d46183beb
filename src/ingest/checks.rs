//! Checks of what strangers send: few at a time, each within a time.

use std::{
    path::Path,
    sync::{Condvar, Mutex, PoisonError},
    time::Duration,
};

use super::{
    check_by,
    deadline::Deadline,
    error::{Error, Fault},
    limits::Limits,
};
use crate::domain::{DatasetSummary, Problem};

/// Bounds how many datasets are checked at a time, and for how long each.
///
/// One check takes less than 128 MiB of memory, so all together take less than that times their number.
#[derive(Debug)]
pub struct Checks {
    limits: Limits,
    time: Duration,
    free: Mutex<usize>,
    freed: Condvar,
}

impl Checks {
    /// At most `together` at a time, of at most `time` each. Whoever comes when all are taken waits as long for one.
    #[must_use]
    pub fn new(together: usize, time: Duration) -> Self {
        Self { limits: Limits::default(), time, free: Mutex::new(together), freed: Condvar::new() }
    }

    /// As [`super::check`], when there is a place.
    ///
    /// # Errors
    /// As [`super::check`], 413 if the check takes too long, and 503 if no place becomes free.
    pub fn check(&self, path: &Path) -> Result<DatasetSummary, Problem> {
        let _place = self.place()?;
        Ok(check_by(Deadline::after(self.time), path, &self.limits)?)
    }

    fn place(&self) -> Result<Place<'_>, Error> {
        let free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut free, _) = self
            .freed
            .wait_timeout_while(free, self.time, |free| *free == 0)
            .unwrap_or_else(PoisonError::into_inner);
        if *free == 0 {
            return Err(Fault::ChecksBusy.into());
        }
        *free -= 1;
        Ok(Place(self))
    }
}

/// A place among the checks, given back when this is dropped.
struct Place<'a>(&'a Checks);

impl Drop for Place<'_> {
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
            assert!(Checks::new(1, MINUTE).check(&written.path).is_ok());
            let problem = Checks::new(1, Duration::ZERO).check(&written.path).expect_err("no time");
            assert_eq!(problem.status, 413, "{problem}");
            assert!(problem.detail.contains("was ended after 0 s"), "{problem}");
        }
    }

    #[test]
    fn no_more_than_stated_run_at_a_time_and_places_are_given_back() {
        let checks = Checks::new(2, Duration::ZERO);
        let (one, _two) = (checks.place().expect("a place"), checks.place().expect("another"));
        assert!(matches!(checks.place(), Err(Error { fault: Fault::ChecksBusy, .. })));
        drop(one);
        assert!(checks.place().is_ok());

        let checks = Checks::new(2, MINUTE);
        let (now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..20 {
                        let place = checks.place().expect("whoever waits gets one");
                        most.fetch_max(1 + now.fetch_add(1, Ordering::SeqCst), Ordering::SeqCst);
                        std::thread::yield_now();
                        now.fetch_sub(1, Ordering::SeqCst);
                        drop(place);
                    }
                });
            }
        });
        assert!(most.into_inner() <= 2);
        let none = Checks::new(0, Duration::ZERO).check(Path::new("anything")).expect_err("no place");
        assert_eq!((none.status, none.kind.as_str()), (503, "urn:tcgs:problem:busy"), "{none}");
    }
}
