//! The claim loop.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;

use super::{
    WorkerConfig, WorkerError,
    attempt::{self, AttemptEnd, WorkerDeps},
    checkpoints,
    liveness::LivenessLock,
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
    let _liveness = config.liveness_dir.as_deref().and_then(|folder| {
        LivenessLock::announce(folder, &config.id)
            // Without it a power cut costs its job the rest of the lease.
            .inspect_err(|fault| tracing::warn!("no sign of life in {}: {fault}", folder.display()))
            .ok()
    });
    tracing::info!(worker = config.id, "worker {} is ready", config.id);
    let deps = WorkerDeps { store, blobs, runner, config };
    sweep(&deps).await;
    let mut swept = Instant::now();
    while !shutdown.is_cancelled() {
        match deps.store.claim(&deps.config.id).await {
            Ok(Some(claim)) => {
                if let AttemptEnd::Stalled(error) = attempt::run_attempt(&deps, claim, &shutdown).await {
                    return Err(error);
                }
                sweep(&deps).await;
            }
            Ok(None) => {
                if swept.elapsed() > SWEEP_EVERY {
                    sweep(&deps).await;
                    swept = Instant::now();
                }
                idle(&deps.config, &shutdown).await;
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "no claim: {error}");
                idle(&deps.config, &shutdown).await;
            }
        }
    }
    tracing::info!(worker = deps.config.id, "worker {} has stopped", deps.config.id);
    Ok(())
}

/// Jobs may end without their worker, so ended ones are looked for rather than told of.
async fn sweep(deps: &WorkerDeps) {
    if let Some(root) = &deps.config.checkpoints {
        checkpoints::sweep(root, &*deps.store).await;
    }
}

async fn idle(config: &WorkerConfig, shutdown: &CancellationToken) {
    tokio::select! {
        () = sleep(config.poll) => {}
        () = shutdown.cancelled() => {}
    }
}
