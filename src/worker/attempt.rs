//! One attempt: runs the job on a thread, keeps its lease meanwhile, and publishes the result.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    pin::pin,
    sync::Arc,
    time::Duration,
};

use thiserror::Error;
use tokio::{
    sync::{oneshot, watch},
    time::{Instant, MissedTickBehavior, interval_at, sleep, sleep_until},
};
use tokio_util::sync::CancellationToken;
use tracing::{Instrument as _, Span};

use super::{
    WorkerConfig, WorkerError, checkpoint_copies,
    checkpoint_copies::CheckpointCopies,
    checkpoints,
    publication::{Ending, publish},
    series_buffer::SeriesBuffer,
    storage,
};
use crate::{
    domain::{
        CancelFlag, FailurePoint, JobState, Phase, Problem, ProblemType, Progress, TrainOptions,
        failure_point::reach,
    },
    pipeline::{CheckpointPlan, JobError, JobOutput, RunJob},
    store::{BlobCopy, BlobError, Blobs, Claim, Lease, Outcome, Store, StoreError, is_disk_full},
};

/// Pause between tries to write the end of an attempt.
const FINISH_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// What every attempt uses.
pub(super) struct WorkerDeps {
    pub(super) store: Store,
    pub(super) blobs: Blobs,
    pub(super) runner: Arc<dyn RunJob>,
    pub(super) config: WorkerConfig,
}

type RunResult = Result<Result<JobOutput, JobError>, Box<dyn Any + Send>>;

/// Why the run is to stop; a later reason outweighs an earlier one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum StopReason {
    None,
    /// The job was cancelled.
    Cancelled,
    /// The job's deadline has passed.
    DeadlinePassed,
    /// The worker shuts down.
    ShuttingDown,
    /// The worker has lost the lease.
    LeaseLost,
}

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
    let Claim { lease, dataset, options, resume_from } = claim;
    tracing::info!("job {} starts", lease.job);
    let mut renewed = Instant::now();
    let fetched = tokio::select! {
        fetched = while_renewing(deps, &lease, &mut renewed, deps.blobs.local_copy(dataset)) => fetched,
        () = shutdown.cancelled() => {
            finish(deps, &lease, Outcome::Released, Instant::now(), shutdown).await;
            return Ok(());
        }
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
        if let Err(error) = while_renewing(deps, &lease, &mut renewed, fetched).await {
            finish(deps, &lease, storage::outcome(&error), Instant::now(), shutdown).await;
            return Ok(());
        }
    }
    let cancel = CancelFlag::default();
    let (progress, watched) = watch::channel((Phase::Ingest, Progress::default()));
    let points = SeriesBuffer::default();
    let checkpoints = checkpoints::of_attempt(root, &lease, resume_from);
    let copied = shared.zip(checkpoints.keep.clone());
    let run = RunArgs { dataset, options, checkpoints, cancel: cancel.clone() };
    let result = match start(deps, &lease, run, progress, points.clone()) {
        Ok(result) => result,
        Err(error) => {
            finish(deps, &lease, Outcome::Retry(no_thread(&error)), Instant::now(), shutdown).await;
            return Ok(());
        }
    };
    let copies = copied.map(|(files, folder)| {
        CheckpointCopies::start(files, folder, &lease, deps.config.copy_checkpoints_every)
    });
    let mut keeper = LeaseKeeper {
        deps,
        lease: &lease,
        cancel,
        progress: watched,
        points,
        stop: StopReason::None,
        last_renewed: Instant::now(),
        last_progress: Instant::now(),
    };
    let (ending, result) = match keeper.wait(result, shutdown).await {
        RunEnd::Ended(result) => {
            keeper.report_progress().await;
            if matches!(*result, Ok(Ok(_))) {
                keeper.start_publication().await;
            }
            let ending = ending_of(deps, &lease, *result, keeper.stop);
            (while_renewing(deps, &lease, &mut keeper.last_renewed, ending).await, Ok(()))
        }
        RunEnd::DrainOver => {
            tracing::warn!("job {} did not stop in time; releasing it", lease.job);
            (Outcome::Released.into(), Ok(()))
        }
        RunEnd::Stalled => {
            let limit = deps.config.stall_limit;
            let error = WorkerError::Stalled { job: lease.job, attempt: lease.attempt, limit };
            tracing::error!("{error}");
            (Outcome::Retry(stalled(limit)).into(), Err(error))
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

/// Does work that a bucket may take long for, and renews the lease meanwhile.
async fn while_renewing<T>(
    deps: &WorkerDeps,
    lease: &Lease,
    last_renewed: &mut Instant,
    work: impl Future<Output = T>,
) -> T {
    let every = deps.config.heartbeat;
    let mut heartbeat = interval_at(Instant::now() + every, every);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut work = pin!(work);
    loop {
        tokio::select! {
            done = &mut work => return done,
            _ = heartbeat.tick() => {
                // What it says is heard again when the run begins, or when its end is written.
                match deps.store.heartbeat(lease).await {
                    Ok(_) => *last_renewed = Instant::now(),
                    Err(error) => {
                        tracing::warn!(error = &error as &dyn std::error::Error, "heartbeat: {error}");
                    }
                }
            }
        }
    }
}

/// Arguments of a run.
struct RunArgs {
    dataset: BlobCopy,
    options: TrainOptions,
    checkpoints: CheckpointPlan,
    cancel: CancelFlag,
}

/// Starts the run on a thread of its own, since it may take hours.
fn start(
    deps: &WorkerDeps,
    lease: &Lease,
    run: RunArgs,
    progress: watch::Sender<(Phase, Progress)>,
    points: SeriesBuffer,
) -> std::io::Result<oneshot::Receiver<RunResult>> {
    let runner = Arc::clone(&deps.runner);
    let (send, receive) = oneshot::channel();
    let span = Span::current();
    std::thread::Builder::new().name(format!("job-{}", lease.job)).spawn(move || {
        let _entered = span.entered();
        let mut report = |phase: Phase, state: &Progress| {
            points.add(phase, state);
            progress.send_replace((phase, state.clone()));
        };
        let RunArgs { dataset, options, checkpoints, cancel } = run;
        let result = catch_unwind(AssertUnwindSafe(|| {
            runner.run(dataset.path(), &options, &checkpoints, &mut report, &cancel)
        }));
        // There is no receiver if the worker has released the job.
        let _ = send.send(result);
    })?;
    Ok(receive)
}

enum RunEnd {
    Ended(Box<RunResult>),
    DrainOver,
    Stalled,
}

/// Renews the lease and reports progress during a run.
struct LeaseKeeper<'a> {
    deps: &'a WorkerDeps,
    lease: &'a Lease,
    cancel: CancelFlag,
    progress: watch::Receiver<(Phase, Progress)>,
    points: SeriesBuffer,
    stop: StopReason,
    last_renewed: Instant,
    last_progress: Instant,
}

impl LeaseKeeper<'_> {
    async fn wait(
        &mut self,
        mut result: oneshot::Receiver<RunResult>,
        shutdown: &CancellationToken,
    ) -> RunEnd {
        let config = &self.deps.config;
        let mut heartbeat = interval_at(Instant::now() + config.heartbeat, config.heartbeat);
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut report = interval_at(Instant::now() + config.report_every, config.report_every);
        report.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut drain_until = None;
        loop {
            tokio::select! {
                ended = &mut result => {
                    let vanished = |_| Err(Box::new("the run's thread vanished") as _);
                    return RunEnd::Ended(Box::new(ended.unwrap_or_else(vanished)));
                }
                () = shutdown.cancelled(), if drain_until.is_none() => {
                    drain_until = Some(Instant::now() + config.drain);
                    self.stop(StopReason::ShuttingDown);
                }
                () = sleep_until(drain_until.unwrap_or_else(Instant::now)), if drain_until.is_some() => {
                    return RunEnd::DrainOver;
                }
                _ = heartbeat.tick(), if self.stop != StopReason::LeaseLost => self.heartbeat().await,
                _ = report.tick() => {
                    self.report_progress().await;
                    if self.last_progress.elapsed() > config.stall_limit {
                        return RunEnd::Stalled;
                    }
                }
            }
        }
    }

    /// Asks the run to stop.
    fn stop(&mut self, why: StopReason) {
        if why > self.stop {
            tracing::info!(reason = ?why, "stopping job {}", self.lease.job);
            self.stop = why;
        }
        self.cancel.cancel();
    }

    async fn heartbeat(&mut self) {
        match self.deps.store.heartbeat(self.lease).await {
            Ok(heartbeat) => {
                self.last_renewed = Instant::now();
                if heartbeat.cancel_requested {
                    self.stop(StopReason::Cancelled);
                }
                if heartbeat.deadline_passed {
                    self.stop(StopReason::DeadlinePassed);
                }
            }
            Err(error) => self.store_failed("heartbeat", &error),
        }
    }

    async fn report_progress(&mut self) {
        // An error means that the run has ended; its last report is still there.
        if !self.progress.has_changed().unwrap_or(true) || self.stop == StopReason::LeaseLost {
            return;
        }
        let (phase, progress) = self.progress.borrow_and_update().clone();
        self.last_progress = Instant::now();
        // Points first, so that readers of the job's new version see them.
        self.record_points().await;
        if let Err(error) = self.deps.store.report(self.lease, phase, &progress).await {
            self.store_failed("report", &error);
        }
    }

    async fn record_points(&mut self) {
        let points = self.points.take();
        if points.is_empty() {
            return;
        }
        if let Err(error) = self.deps.store.record(self.lease, &points).await {
            self.points.put_back(points);
            self.store_failed("points", &error);
        }
    }

    /// Renews the lease for the time of publication, and reports that phase.
    async fn start_publication(&mut self) {
        self.heartbeat().await;
        let (_, progress) = self.progress.borrow().clone();
        if self.stop != StopReason::LeaseLost
            && let Err(error) = self.deps.store.report(self.lease, Phase::Publish, &progress).await
        {
            self.store_failed("report", &error);
        }
    }

    fn store_failed(&mut self, what: &str, error: &StoreError) {
        tracing::warn!(error = error as &dyn std::error::Error, "{what}: {error}");
        let gone = matches!(error, StoreError::LeaseLost { .. });
        // Nothing can be written, so no other worker can claim the job either.
        if error.is_disk_full() {
            return;
        }
        // Without the database, the run may continue until the lease has expired.
        if gone || self.last_renewed.elapsed() > self.deps.config.lease {
            self.stop(StopReason::LeaseLost);
        }
    }
}

/// The end to record for a run that has ended; publishes its result.
async fn ending_of(deps: &WorkerDeps, lease: &Lease, result: RunResult, stop: StopReason) -> Ending {
    let outcome = match (result, stop) {
        (_, StopReason::LeaseLost) => {
            tracing::warn!("the lease of job {} was lost; its result is dropped", lease.job);
            // If no other worker has claimed it, because no process could reach the database, this is no crash.
            Outcome::Released
        }
        (Ok(Ok(output)), _) => return publish(&deps.blobs, output).await,
        (Ok(Err(JobError::Fail(problem))), _) => Outcome::Failed(problem),
        (Ok(Err(JobError::Retry(problem))), _) => Outcome::Retry(storage::redacted(problem)),
        (Ok(Err(JobError::Hold(problem))), _) => Outcome::Held(storage::redacted(problem)),
        (Ok(Err(JobError::Cancelled)), StopReason::Cancelled) => Outcome::Cancelled,
        (Ok(Err(JobError::Cancelled)), StopReason::DeadlinePassed | StopReason::ShuttingDown) => {
            Outcome::Released
        }
        (Ok(Err(JobError::Cancelled)), StopReason::None) => Outcome::Retry(stopped_unasked()),
        (Err(panic), _) => {
            tracing::error!("job {} panicked: {}", lease.job, panic_text(&*panic));
            Outcome::Retry(panicked())
        }
    };
    outcome.into()
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

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

fn no_thread(error: &std::io::Error) -> Problem {
    tracing::error!("the run's thread cannot be started: {error}");
    Problem::new(ProblemType::ResourceExhausted, "the worker cannot start a thread for the job")
        .with_status(503)
}

fn stalled(limit: Duration) -> Problem {
    let detail = format!("the run made no progress for {} s", limit.as_secs());
    Problem::new(ProblemType::Stalled, detail)
}

fn stopped_unasked() -> Problem {
    Problem::new(ProblemType::Internal, "the run stopped without being cancelled")
}

fn panicked() -> Problem {
    let detail = "the run failed with an internal error; see the worker's log";
    Problem::new(ProblemType::WorkerPanicked, detail)
}
