//! One attempt: runs the job on a thread, keeps its lease meanwhile, and publishes the result.

use std::{sync::Arc, time::Duration};

use thiserror::Error;
use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;
use tracing::Instrument as _;

use super::{
    WorkerError, checkpoint_copies,
    checkpoint_copies::CheckpointCopies,
    checkpoints,
    deps::WorkerDeps,
    lease_keeper::{LeaseKeeper, RunEnd, StopReason, WorkResult, while_renewing},
    outcomes::{completed, no_thread, stalled},
    preparation::{self, Prepared},
    publication::{Ending, Finished, publish},
    storage,
};
use crate::{
    domain::{CancelFlag, FailurePoint, JobState, Phase, Preparation, Progress, failure_point::reach},
    ingest,
    store::{BlobError, Claim, Lease, Outcome, StoreError, is_disk_full},
};

/// Pause between tries to write the end of an attempt.
const FINISH_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Runs a claimed job to its end. All log lines meanwhile carry job and attempt.
///
/// # Errors
/// [`WorkerError::Stalled`] if the run's thread hangs; the process must exit.
pub(super) async fn run_attempt(
    deps: &WorkerDeps,
    claim: Claim,
    shutdown: &CancellationToken,
) -> Result<(), WorkerError> {
    let Claim { lease: Lease { job, attempt, .. }, .. } = claim;
    // At the highest level, so that every log level includes it.
    let span = tracing::error_span!("job", %job, attempt);
    run_in_span(deps, claim, shutdown).instrument(span).await
}

async fn run_in_span(
    deps: &WorkerDeps,
    claim: Claim,
    shutdown: &CancellationToken,
) -> Result<(), WorkerError> {
    let Claim { lease, dataset, needs, is_posed, options, resume_from } = claim;
    tracing::info!("job {} starts", lease.job);
    let mut keeper = LeaseKeeper::new(deps, &lease, Instant::now());
    let fetched = tokio::select! {
        fetched = while_renewing(deps, &lease, &mut keeper.last_renewed, deps.blobs.local_copy(dataset)) => fetched,
        () = shutdown.cancelled() => {
            finish(deps, &lease, Outcome::Released, Instant::now(), shutdown).await;
            return Ok(());
        }
    };
    let fetched = match fetched {
        Ok(copy) if needs == Preparation::None => Ok(copy),
        Ok(copy) => match preparation::prepare(&mut keeper, copy, (&options, resume_from), shutdown).await {
            Prepared::Dataset(copy) => Ok(copy),
            Prepared::Ended(outcome, result) => {
                finish(deps, &lease, outcome, keeper.last_renewed, shutdown).await;
                return result;
            }
        },
        Err(error) => Err(error),
    };
    let dataset = match fetched {
        Ok(copy) => copy,
        Err(error) => {
            finish(deps, &lease, storage::outcome(&error), Instant::now(), shutdown).await;
            return Ok(());
        }
    };
    let root = deps.config.checkpoints.as_deref();
    let shared = deps.blobs.shared_files();
    if let (Some(root), Some(files)) = (root, &shared) {
        let fetched = checkpoint_copies::fetch(files, root, &lease, resume_from);
        if let Err(error) = while_renewing(deps, &lease, &mut keeper.last_renewed, fetched).await {
            finish(deps, &lease, storage::outcome(&error), Instant::now(), shutdown).await;
            return Ok(());
        }
    }
    let checkpoints = checkpoints::of_attempt(root, &lease, resume_from);
    let copies = shared.zip(checkpoints.keep.clone()).map(|(files, folder)| {
        CheckpointCopies::start(files, folder, &lease, deps.config.copy_checkpoints_every)
    });
    let runner = Arc::clone(&deps.runner);
    let has_model = is_posed || needs > Preparation::None;
    let run = move |report: &mut dyn FnMut(Phase, &Progress), cancel: &CancelFlag| {
        let output = runner.run(dataset.path(), &options, &checkpoints, report, cancel)?;
        let model = if has_model { Some(ingest::sparse_model(dataset.path())?) } else { None };
        Ok(Finished { output, sparse_model: model })
    };
    let (ending, result) = match keeper.run(shutdown, run).await {
        RunEnd::Ended(result) => {
            keeper.report_progress().await;
            if matches!(*result, Ok(Ok(_))) {
                keeper.start_publication().await;
            }
            let ending = ending_of(deps, &lease, *result, keeper.stop);
            (while_renewing(deps, &lease, &mut keeper.last_renewed, ending).await, Ok(()))
        }
        RunEnd::NotStarted(error) => (Outcome::Retry(no_thread(&error)).into(), Ok(())),
        RunEnd::DrainOver => {
            tracing::warn!("job {} did not stop in time; releasing it", lease.job);
            (Outcome::Released.into(), Ok(()))
        }
        RunEnd::Stalled => {
            let (outcome, error) = stalled(&lease, deps.config.stall_limit);
            (outcome.into(), Err(error))
        }
    };
    match copies {
        // Before another machine can claim the job.
        Some(copies) if !matches!(ending.outcome, Outcome::Succeeded { .. }) => {
            while_renewing(deps, &lease, &mut keeper.last_renewed, copies.finish()).await;
        }
        Some(copies) => copies.abandon(),
        None => {}
    }
    finish(deps, &lease, ending, keeper.last_renewed, shutdown).await;
    result
}

/// The end to record for a run that has ended; publishes its result.
async fn ending_of(
    deps: &WorkerDeps,
    lease: &Lease,
    result: WorkResult<Finished>,
    stop: StopReason,
) -> Ending {
    match completed(lease, result, stop) {
        Ok(finished) => publish(&deps.blobs, finished).await,
        Err(outcome) => outcome.into(),
    }
}

/// Why the end of an attempt is not recorded.
#[derive(Debug, Error)]
enum FinishError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(transparent)]
    Blobs(#[from] BlobError),
}

/// Writes the end of the attempt. Retries while the lease may still be held: hours of work must not be lost because the database is
/// busy for a moment or the disk is full for a while.
async fn finish(
    deps: &WorkerDeps,
    lease: &Lease,
    ending: impl Into<Ending>,
    last_renewed: Instant,
    shutdown: &CancellationToken,
) {
    let mut ending = ending.into();
    // When it was last certain that no other worker could claim the job.
    let mut last_held = last_renewed;
    loop {
        let error = match record(deps, lease, &mut ending).await {
            Ok(state) => {
                if state == JobState::Succeeded {
                    reach(FailurePoint::AfterCommit);
                }
                let state = state.name();
                tracing::info!(state, "job {} is {state}", lease.job);
                return;
            }
            Err(FinishError::Store(error @ StoreError::LeaseLost { .. })) => {
                tracing::warn!("{error}");
                return;
            }
            Err(error) => error,
        };
        let is_full = is_disk_full(&error);
        let since = if is_full { last_renewed } else { last_held };
        if since.elapsed() > deps.config.lease && (shutdown.is_cancelled() || !is_full) {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "the end of the attempt is not recorded: {error}"
            );
            return;
        }
        tracing::warn!(
            error = &error as &dyn std::error::Error,
            "the end of the attempt is not recorded yet: {error}"
        );
        sleep(FINISH_RETRY_PAUSE).await;
        if is_full {
            // Small changes may find room where the end does not: a renewal, or the claim of another worker.
            let renewed = deps.store.heartbeat(lease).await;
            if renewed.map_or_else(|error| error.is_disk_full(), |_| true) {
                last_held = Instant::now();
            }
        }
    }
}

/// Writes the end once, after the result was published again if its latest publication is old.
async fn record(deps: &WorkerDeps, lease: &Lease, ending: &mut Ending) -> Result<JobState, FinishError> {
    ending.renew(&deps.blobs, deps.config.republish_every).await?;
    Ok(deps.store.finish(lease, ending.outcome.clone()).await?)
}
