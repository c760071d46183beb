//! The runtime of a process, and the signals that stop it.

use std::error::Error;

use tcgs::{
    domain::{Problem, ProblemType},
    http::ServeError,
};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use crate::cli::{
    CliError,
    signals::{SIGNAL_DEBOUNCE, Signals},
};

pub(super) fn runtime() -> Result<Runtime, CliError> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(|error| unavailable(&error))
}

/// Runs a process to its end, and does not wait for blocking tasks that did not end in time: runs, renders, exports, checks. Dropping the
/// runtime would wait for them without limit, while no signal is received any more.
pub(super) fn run_until_stopped<T>(
    process: impl Future<Output = Result<T, CliError>>,
) -> Result<T, CliError> {
    let runtime = runtime()?;
    let outcome = runtime.block_on(process);
    runtime.shutdown_background();
    outcome
}

/// Cancelled by the first interrupt or termination signal. A second ends the process at once.
pub(super) fn stop_on_signals() -> Result<CancellationToken, CliError> {
    let stop = CancellationToken::new();
    let cancel = stop.clone();
    // Registered before the task runs, so that no signal is missed.
    let mut signals = Signals::listen().map_err(|error| unavailable(&error))?;
    tokio::spawn(async move {
        signals.next().await;
        tracing::info!("stopping; another signal ends this at once");
        cancel.cancel();
        tokio::time::sleep(SIGNAL_DEBOUNCE).await;
        // New listeners do not get the signals that arrived meanwhile.
        match Signals::listen() {
            Ok(mut signals) => {
                let status = signals.next().await;
                tracing::warn!(
                    "ending at once; jobs under way go back to the queue, at the latest when their leases run out"
                );
                std::process::exit(status.into());
            }
            Err(error) => tracing::warn!(%error, "a second signal cannot be received"),
        }
    });
    Ok(stop)
}

/// A problem for a missing resource, with the causes of the error.
pub(super) fn unavailable(error: &(dyn Error + 'static)) -> CliError {
    let mut detail = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        detail = format!("{detail}: {cause}");
        source = cause.source();
    }
    Problem::new(ProblemType::Unavailable, detail).into()
}

/// A problem for an address that cannot be listened on.
pub(super) fn cannot_listen(error: &ServeError) -> CliError {
    match error {
        ServeError::Bind { address, source } if source.kind() == std::io::ErrorKind::AddrInUse => {
            let detail =
                format!("another program listens on {address}; choose another address with --listen");
            Problem::new(ProblemType::AddressTaken, detail).into()
        }
        error => unavailable(error),
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::mpsc,
        time::{Duration, Instant},
    };

    use super::*;

    #[test]
    fn a_process_does_not_wait_for_a_blocking_task_that_does_not_end() {
        let (end, ended) = mpsc::channel::<()>();
        let started = Instant::now();
        let outcome = run_until_stopped(async {
            let (started, running) = tokio::sync::oneshot::channel();
            tokio::task::spawn_blocking(move || {
                let _ = started.send(());
                let _ = ended.recv_timeout(Duration::from_secs(60));
            });
            running.await.map_err(|error| unavailable(&error))
        });
        assert!(outcome.is_ok(), "{outcome:?}");
        assert!(started.elapsed() < Duration::from_secs(30), "it waited for the task");
        drop(end);
    }
}
