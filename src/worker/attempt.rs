//! One attempt at one job: the run on its thread, the lease beside it, and the publication of the result.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::Arc,
    time::Duration,
};

use bytes::Bytes;
use tokio::{
    sync::{oneshot, watch},
    time::{Instant, MissedTickBehavior, interval_at, sleep, sleep_until},
};
use tokio_util::sync::CancellationToken;
use tracing::{Instrument as _, Span};

use super::{WorkerConfig, WorkerError, checkpoints, series_buffer::SeriesBuffer, storage};
use crate::{
    domain::{CancelFlag, Phase, Problem, Progress, TrainOptions},
    pipeline::{Checkpoints, JobError, JobOutput, RunJob},
    store::{Artifact, ArtifactKind, Blobs, Claim, Lease, Outcome, Store, StoreError},
};

/// Pause between tries to write the end of an attempt.
const FINISH_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// What every attempt needs.
pub(super) struct WorkerDeps {
    pub(super) store: Arc<dyn Store>,
    pub(super) blobs: Blobs,
    pub(super) runner: Arc<dyn RunJob>,
    pub(super) config: WorkerConfig,
}

/// How an attempt left the worker.
pub(super) enum AttemptEnd {
    /// Free for the next job.
    Free,
    /// With a thread that hangs.
    Stalled(WorkerError),
}

type RunResult = Result<Result<JobOutput, JobError>, Box<dyn Any + Send>>;

/// Why the run is to stop; a later reason outweighs an earlier one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum StopReason {
    None,
    /// Somebody cancelled the job.
    Cancelled,
    /// Its deadline has passed.
    DeadlinePassed,
    /// The worker shuts down.
    ShuttingDown,
    /// The job is no longer this worker's.
    LeaseLost,
}

/// Runs a claimed job to its end. Whatever is logged meanwhile, here or by the run, carries the job and the attempt.
pub(super) async fn run_attempt(deps: &WorkerDeps, claim: Claim, shutdown: &CancellationToken) -> AttemptEnd {
    let Claim { lease: Lease { job, attempt, .. }, .. } = claim;
    // Of the highest level, so that lines carry it however little is logged.
    let span = tracing::error_span!("job", %job, attempt);
    run_in_span(deps, claim, shutdown).instrument(span).await
}

async fn run_in_span(deps: &WorkerDeps, claim: Claim, shutdown: &CancellationToken) -> AttemptEnd {
    let Claim { lease, dataset, options, resume_from } = claim;
    tracing::info!("job {} begins", lease.job);
    let dataset = match deps.blobs.local_file(dataset).await {
        Ok(path) => path,
        Err(error) => {
            finish(deps, &lease, storage::outcome(&error), Instant::now(), shutdown).await;
            return AttemptEnd::Free;
        }
    };
    let cancel = CancelFlag::default();
    let (progress, watched) = watch::channel((Phase::Ingest, Progress::default()));
    let points = SeriesBuffer::default();
    let checkpoints = checkpoints::of_attempt(deps.config.checkpoints.as_deref(), &lease, resume_from);
    let run = RunArgs { dataset, options, checkpoints, cancel: cancel.clone() };
    let result = match start(deps, &lease, run, progress, points.clone()) {
        Ok(result) => result,
        Err(error) => {
            finish(deps, &lease, Outcome::Retry(no_thread(&error)), Instant::now(), shutdown).await;
            return AttemptEnd::Free;
        }
    };
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
    match keeper.until(result, shutdown).await {
        RunEnd::Ended(result) => {
            keeper.pass_progress_on().await;
            if matches!(*result, Ok(Ok(_))) {
                keeper.enter_publication().await;
            }
            finish_run(deps, &lease, *result, keeper.stop, keeper.last_renewed, shutdown).await;
            AttemptEnd::Free
        }
        RunEnd::DrainOver => {
            tracing::warn!("job {} did not stop in time; releasing it", lease.job);
            finish(deps, &lease, Outcome::Released, keeper.last_renewed, shutdown).await;
            AttemptEnd::Free
        }
        RunEnd::Stalled => {
            let limit = deps.config.stall_limit;
            let error = WorkerError::Stalled { job: lease.job, attempt: lease.attempt, limit };
            tracing::error!("{error}");
            finish(deps, &lease, Outcome::Retry(stalled(limit)), keeper.last_renewed, shutdown).await;
            AttemptEnd::Stalled(error)
        }
    }
}

/// What a run is told.
struct RunArgs {
    dataset: PathBuf,
    options: TrainOptions,
    checkpoints: Checkpoints,
    cancel: CancelFlag,
}

/// Starts the run on a thread of its own: it may take hours, and tokio's pool is not for that.
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
        let _of_the_job = span.entered();
        let mut report = |phase: Phase, state: &Progress| {
            points.add(phase, state);
            progress.send_replace((phase, state.clone()));
        };
        let RunArgs { dataset, options, checkpoints, cancel } = run;
        let result = catch_unwind(AssertUnwindSafe(|| {
            runner.run(&dataset, &options, &checkpoints, &mut report, &cancel)
        }));
        // Nobody listens any more if the worker gave the job up.
        let _ = send.send(result);
    })?;
    Ok(receive)
}

enum RunEnd {
    Ended(Box<RunResult>),
    DrainOver,
    Stalled,
}

/// Keeps the lease while the run goes on.
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
    async fn until(
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
                    self.pass_progress_on().await;
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

    async fn pass_progress_on(&mut self) {
        // An error means only that the run has ended; what it reported last is still there.
        if !self.progress.has_changed().unwrap_or(true) || self.stop == StopReason::LeaseLost {
            return;
        }
        let (phase, progress) = self.progress.borrow_and_update().clone();
        self.last_progress = Instant::now();
        // Points first: whoever sees the job's new version sees them too.
        self.pass_points_on().await;
        if let Err(error) = self.deps.store.report(self.lease, phase, &progress).await {
            self.store_failed("report", &error);
        }
    }

    async fn pass_points_on(&mut self) {
        let points = self.points.take();
        if points.is_empty() {
            return;
        }
        if let Err(error) = self.deps.store.record(self.lease, &points).await {
            self.points.put_back(points);
            self.store_failed("points", &error);
        }
    }

    /// Renews the lease for the time that publication takes, and says so.
    async fn enter_publication(&mut self) {
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
        // Where nothing can be written, nobody else can take the job either.
        if error.is_disk_full() {
            return;
        }
        // Without a database the run may go on until others may take the job.
        if gone || self.last_renewed.elapsed() > self.deps.config.lease {
            self.stop(StopReason::LeaseLost);
        }
    }
}

async fn finish_run(
    deps: &WorkerDeps,
    lease: &Lease,
    result: RunResult,
    stop: StopReason,
    last_renewed: Instant,
    shutdown: &CancellationToken,
) {
    let outcome = match (result, stop) {
        (_, StopReason::LeaseLost) => {
            tracing::warn!("job {} was lost; its result is dropped", lease.job);
            // If nobody has taken it, since the database was out of everybody's reach, this worker has not died.
            Outcome::Released
        }
        (Ok(Ok(output)), _) => publish(deps, output).await,
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
    finish(deps, lease, outcome, last_renewed, shutdown).await;
}

/// Makes the output's blobs durable; only then may the job refer to them.
async fn publish(deps: &WorkerDeps, output: JobOutput) -> Outcome {
    let (cameras, held_out) = match documents(&output) {
        Ok(documents) => documents,
        Err(error) => {
            tracing::error!("a document cannot be written: {error}");
            return Outcome::Failed(Problem::new(
                500,
                "internal",
                "Internal error",
                "the dataset's cameras or held-out views cannot be written as JSON",
            ));
        }
    };
    let scenes = output
        .files()
        .map(|(lambda, file)| (ArtifactKind::Scene(output.format), lambda, Bytes::copy_from_slice(file)));
    let cameras = Some((ArtifactKind::Cameras, None, cameras));
    let held_out = held_out.map(|document| (ArtifactKind::HeldOut, None, document));
    let contents: Vec<_> = scenes.chain(cameras).chain(held_out).collect();
    let mut artifacts = Vec::new();
    for (kind, lambda, content) in contents {
        match deps.blobs.put(content).await {
            Ok(blob) => artifacts.push(Artifact { kind, lambda, blob }),
            Err(error) => return storage::outcome(&error),
        }
    }
    Outcome::Succeeded { metrics: Box::new(output.metrics), artifacts }
}

/// What goes with the files as JSON: the cameras, and the held-out views if there are any.
fn documents(output: &JobOutput) -> serde_json::Result<(Bytes, Option<Bytes>)> {
    let held_out = output.held_out.as_ref().map(serde_json::to_vec).transpose()?;
    Ok((serde_json::to_vec(&output.cameras)?.into(), held_out.map(Bytes::from)))
}

/// Writes the end of the attempt, trying again while the lease may still be held: hours of work must not be
/// lost to a database that is busy for a moment, nor to a disk that is full until somebody comes.
async fn finish(
    deps: &WorkerDeps,
    lease: &Lease,
    outcome: Outcome,
    last_renewed: Instant,
    shutdown: &CancellationToken,
) {
    loop {
        match deps.store.finish(lease, outcome.clone()).await {
            Ok(state) => {
                let state = state.name();
                tracing::info!(state, "job {} is {state}", lease.job);
                return;
            }
            Err(error @ StoreError::LeaseLost { .. }) => {
                tracing::warn!("{error}");
                return;
            }
            Err(error)
                if last_renewed.elapsed() > deps.config.lease
                    && (shutdown.is_cancelled() || !error.is_disk_full()) =>
            {
                tracing::error!(error = &error as &dyn std::error::Error, "giving up: {error}");
                return;
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "trying again: {error}");
                sleep(FINISH_RETRY_PAUSE).await;
            }
        }
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

fn no_thread(error: &std::io::Error) -> Problem {
    tracing::error!("no thread for the run: {error}");
    Problem::new(
        503,
        "resource-exhausted",
        "Resource exhausted",
        "the worker cannot start a thread for the job",
    )
}

fn stalled(limit: Duration) -> Problem {
    let detail = format!("the run made no progress for {} s", limit.as_secs());
    Problem::new(500, "stalled", "The run hangs", detail)
}

fn stopped_unasked() -> Problem {
    Problem::new(500, "internal", "Internal error", "the run stopped although nobody had asked it to")
}

fn panicked() -> Problem {
    let detail = "the run met an internal error; the worker's log has the particulars";
    Problem::new(500, "worker-panicked", "The run failed", detail)
}
