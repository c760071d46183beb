//! The flag that has workers stand back, the same for a service and for a worker by itself.

use super::Failure;

/// How far a worker lets others go first.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct NiceFlag {
    /// How far workers let other processes go first, the service's own requests and views among them: 0 not at all, 19 as far as
    /// the system knows. It adds to the niceness that the program was started with
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=19),
          env = "TCGS_WORKER_NICE")]
    worker_nice: u8,
}

impl NiceFlag {
    /// The number, if this system knows such a thing.
    ///
    /// # Errors
    /// [`Failure::Usage`] for any but 0 elsewhere than on Unix.
    pub(crate) fn value(self) -> Result<u8, Failure> {
        if cfg!(unix) || self.worker_nice == 0 {
            return Ok(self.worker_nice);
        }
        Err(Failure::Usage("--worker-nice: only Unix systems have such priorities".into()))
    }

    /// Has this process stand back. On Linux threads have priorities, and take over that of the one that starts them; so this
    /// comes before there is a second.
    ///
    /// # Errors
    /// As [`Self::value`].
    pub(crate) fn stand_back(self) -> Result<(), Failure> {
        let nice = self.value()?;
        #[cfg(unix)]
        if nice > 0
            && let Err(fault) = rustix::process::nice(nice.into())
        {
            // Going on as usual is better than not at all.
            tracing::warn!("the priority cannot be lowered by {nice}: {fault}");
        }
        #[cfg(not(unix))]
        let _ = nice;
        Ok(())
    }
}
