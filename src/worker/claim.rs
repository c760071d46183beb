//! The loop that claims and runs jobs.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;

use super::{
    WorkerConfig, WorkerError, attempt::run_attempt, capabilities::Capabilities, checkpoint_copies,
    checkpoints, deps::WorkerDeps, liveness::LivenessLock,
};
use crate::{
    domain::{FailurePoint, failure_point::reach},
    pipeline::RunJob,
    store::{Blobs, ChangeKind, Claimant, Store},
};

/// How often an idle worker removes unneeded checkpoints.
const SWEEP_EVERY: Duration = Duration::from_secs(60);

/// How many times rarer an idle worker asks for jobs while the database tells of new ones.
const RARER: u32 = 8;

/// Claims and runs jobs, one at a time, until `shutdown`.
///
/// On shutdown the running job is asked to stop; once it has stopped, or after [`WorkerConfig::drain`], its lease is released without
/// charging the attempt, and another worker can claim it at once. The caller should then end the process: a run that did not stop in
/// time is still on its thread.
///
/// # Errors
/// [`WorkerError::Stalled`]; the process must end.
pub async fn serve(
    store: Store,
    blobs: Blobs,
    runner: Arc<dyn RunJob>,
    config: WorkerConfig,
    shutdown: CancellationToken,
) -> Result<(), WorkerError> {
    let _liveness = config.liveness_dir.as_deref().and_then(|folder| {
        LivenessLock::acquire(folder, &config.id)
            // Without it, its job waits for the end of the lease after a power cut.
            .inspect_err(|error| tracing::warn!("no lock file in {}: {error}", folder.display()))
            .ok()
    });
    tracing::info!(worker = config.id, "worker {} is ready", config.id);
    let capabilities = Capabilities::announce(&store, &config);
    let deps = WorkerDeps { store, blobs, runner, config };
    let sweep = async || {
        if let Some(root) = &deps.config.checkpoints {
            checkpoints::sweep(root, &deps.store).await;
            if let Some(files) = deps.blobs.shared_files() {
                checkpoint_copies::sweep(&files, &deps.store).await;
            }
        }
        Instant::now()
    };
    let mut swept = sweep().await;
    let mut changes = deps.store.changes(ChangeKind::Queue);
    while !shutdown.is_cancelled() {
        let claimant = Claimant { id: &deps.config.id, can: capabilities.known() };
        match deps.store.claim(claimant).await {
            Ok(Some(claim)) => {
                reach(FailurePoint::AfterClaim);
                run_attempt(&deps, claim, &shutdown).await?;
                swept = sweep().await;
                continue;
            }
            Ok(None) if swept.elapsed() > SWEEP_EVERY => swept = sweep().await,
            Ok(None) => {}
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "no job can be claimed: {error}");
            }
        }
        // What it tells may be lost, so it is asked in any case.
        let poll = deps.config.poll * if changes.is_live() { RARER } else { 1 };
        tokio::select! {
            () = sleep(poll) => {}
            () = changes.wait() => {}
            () = shutdown.cancelled() => {}
        }
    }
    capabilities.withdraw().await;
    tracing::info!(worker = deps.config.id, "worker {} has stopped", deps.config.id);
    Ok(())
}
