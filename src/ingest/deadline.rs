//! By when a check has to be done.

use std::time::{Duration, Instant};

use super::error::Fault;

/// A point in time after which reading ends with [`Fault::CheckTimeout`]; a load has none.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Deadline(Option<(Instant, Duration)>);

impl Deadline {
    /// Never.
    pub(super) const NONE: Self = Self(None);

    /// After `time` from now.
    pub(super) fn after(time: Duration) -> Self {
        Self(Instant::now().checked_add(time).map(|at| (at, time)))
    }

    /// Whether it has not passed.
    ///
    /// # Errors
    /// [`Fault::CheckTimeout`].
    pub(super) fn check(self) -> Result<(), Fault> {
        match self.0 {
            Some((at, time)) if Instant::now() >= at => Err(Fault::CheckTimeout { seconds: time.as_secs() }),
            _ => Ok(()),
        }
    }
}
