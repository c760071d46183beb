//! The time by which a check must finish.

use std::time::{Duration, Instant};

use super::error::{IngestErrorKind, Result};

/// A point in time after which reading ends with [`IngestErrorKind::CheckTimeout`]; a load has none.
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
    /// [`IngestErrorKind::CheckTimeout`].
    pub(super) fn check(self) -> Result<()> {
        match self.0 {
            Some((at, time)) if Instant::now() >= at => {
                Err(IngestErrorKind::CheckTimeout { seconds: time.as_secs() })
            }
            _ => Ok(()),
        }
    }
}
