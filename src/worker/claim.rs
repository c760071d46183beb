//! The claim loop.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;

use super::{
    WorkerConfig, WorkerError,
    attempt::{self, Context, End},
    checkpoints,
    presence::Presence,
};
use crate::{
    pipeline::RunJob,
    store::{Blobs, Store},
};

/// How often an idle worker looks for checkpoints that nobody needs any more.
const SWEEP_EVERY: Duration = Duration::from_secs(60);

/// Claims and runs jobs, one at a time, until `shutdown`.
///
/// On shutdown the running job is asked to stop; if it does, or if [`WorkerConfig::drain`] passes, its lease is
/// released without charging the attempt, and another worker can take it at once. The caller should then end
/// the process: a run that did not stop in time is still on its thread.
///
/// # Errors
/// [`WorkerError::Stalled`]; the process must end.
pub async fn serve(
    store: Arc<dyn Store>,
    blobs: Blobs,
    runner: Arc<dyn RunJob>,
    config: WorkerConfig,
    shutdown: CancellationToken,
) -> Result<(), WorkerError> {
    let _presence = config.presence.as_deref().and_then(|folder| {
        Presence::announce(folder, &config.id)
            // Without it a power cut costs its job the rest of the lease.
            .inspect_err(|fault| tracing::warn!("no sign of life in {}: {fault}", folder.display()))
            .ok()
    });
    tracing::info!(worker = config.id, "worker {} is ready", config.id);
    let context = Context { store, blobs, runner, config };
    sweep(&context).await;
    let mut swept = Instant::now();
    while !shutdown.is_cancelled() {
        match context.store.claim(&context.config.id).await {
            Ok(Some(claim)) => {
                if let End::Stalled(error) = attempt::carry_out(&context, claim, &shutdown).await {
                    return Err(error);
                }
                sweep(&context).await;
            }
            Ok(None) => {
                if swept.elapsed() > SWEEP_EVERY {
                    sweep(&context).await;
                    swept = Instant::now();
                }
                idle(&context.config, &shutdown).await;
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "no claim: {error}");
                idle(&context.config, &shutdown).await;
            }
        }
    }
    tracing::info!(worker = context.config.id, "worker {} has stopped", context.config.id);
    Ok(())
}

/// Jobs may end without their worker, so ended ones are looked for rather than told of.
async fn sweep(context: &Context) {
    if let Some(root) = &context.config.checkpoints {
        checkpoints::sweep(root, &*context.store).await;
    }
}

async fn idle(config: &WorkerConfig, shutdown: &CancellationToken) {
    tokio::select! {
        () = sleep(config.poll) => {}
        () = shutdown.cancelled() => {}
    }
}
