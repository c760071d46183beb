//! The signals that ask a process to stop, and runs that they cancel.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    thread,
    time::Duration,
};

use tcgs::domain::CancelFlag;

use super::{CliError, notice::notice};

/// Signals within this time count as one: wrappers such as `timeout` send each twice.
pub(crate) const SIGNAL_DEBOUNCE: Duration = Duration::from_millis(500);

/// The signals that ask a process to stop.
#[cfg(unix)]
pub(crate) struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl Signals {
    /// Receives what arrives from now on.
    pub(crate) fn listen() -> io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    /// Waits for one, and returns the exit status of a process that it ends, as shells have it.
    pub(crate) async fn next(&mut self) -> u8 {
        tokio::select! {
            _ = self.interrupt.recv() => 128 + 2,
            _ = self.terminate.recv() => 128 + 15,
        }
    }
}

/// The signal that asks a process to stop.
#[cfg(windows)]
pub(crate) struct Signals(tokio::signal::windows::CtrlC);

#[cfg(windows)]
impl Signals {
    /// Receives what arrives from now on.
    pub(crate) fn listen() -> io::Result<Self> {
        tokio::signal::windows::ctrl_c().map(Self)
    }

    /// Waits for one, and returns the exit status of a process that it ends.
    pub(crate) async fn next(&mut self) -> u8 {
        self.0.recv().await;
        130
    }
}

/// A run of this process that the first signal cancels. The second ends the process.
#[derive(Debug, Clone, Default)]
pub(crate) struct Interruption {
    /// Set by the first signal.
    pub(crate) cancel: CancelFlag,
    /// Exit status of a process that the signal ends; set before `cancel` is.
    status: Arc<AtomicU8>,
}

impl Interruption {
    /// Watches for signals from now on.
    pub(crate) fn listen() -> Self {
        let interruption = Self::default();
        if let Err(error) = interruption.clone().watch() {
            tracing::warn!(%error, "a signal will end the run without a checkpoint");
        }
        interruption
    }

    fn watch(self) -> io::Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        // Registered before the run begins, so that no signal is missed.
        let mut signals = {
            let _entered = runtime.enter();
            Signals::listen()?
        };
        let watch = move || {
            runtime.block_on(async {
                self.status.store(signals.next().await, Ordering::Relaxed);
                self.cancel.cancel();
                notice("tcgs: stopping; another signal ends this at once");
                tokio::time::sleep(SIGNAL_DEBOUNCE).await;
                // New listeners do not get the signals that arrived meanwhile.
                if let Ok(mut signals) = Signals::listen() {
                    std::process::exit(signals.next().await.into());
                }
            });
        };
        thread::Builder::new().name("signals".to_owned()).spawn(watch).map(drop)
    }

    /// The error of the run that was cancelled; `advice` says how to go on.
    pub(crate) fn error(&self, advice: impl Into<String>) -> CliError {
        CliError::Stopped { status: self.status.load(Ordering::Relaxed), advice: advice.into() }
    }
}
