//! The flag of the workers' niceness, shared by `serve` and `worker`.

use super::CliError;

/// The niceness of workers.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct WorkerPriorityFlag {
    /// Niceness of workers, 0 to 19, in addition to the program's own: higher values leave more time to requests and views
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=19),
          env = "TCGS_WORKER_NICE")]
    worker_nice: u8,
}

impl WorkerPriorityFlag {
    /// The niceness, if this system has one.
    ///
    /// # Errors
    /// [`CliError::Usage`] for any but 0 elsewhere than on Unix.
    pub(crate) fn value(self) -> Result<u8, CliError> {
        if cfg!(unix) || self.worker_nice == 0 {
            return Ok(self.worker_nice);
        }
        Err(CliError::Usage("--worker-nice: only Unix systems have such priorities".into()))
    }

    /// Lowers the priority of this process. Linux threads inherit theirs from the thread that starts them, so call it before there is a
    /// second.
    ///
    /// # Errors
    /// As [`Self::value`].
    pub(crate) fn lower_priority(self) -> Result<(), CliError> {
        let nice = self.value()?;
        #[cfg(unix)]
        if nice > 0
            && let Err(error) = rustix::process::nice(nice.into())
        {
            // Run at the usual priority rather than not at all.
            tracing::warn!("the priority cannot be lowered by {nice}: {error}");
        }
        #[cfg(not(unix))]
        let _ = nice;
        Ok(())
    }
}
