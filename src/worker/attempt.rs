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

use super::{WorkerConfig, WorkerError, checkpoints, points::Points, storage};
use crate::{
    domain::{CancelFlag, Phase, Problem, Progress, TrainOptions},
    pipeline::{Checkpoints, JobError, JobOutput, RunJob},
    store::{Artifact, ArtifactKind, Blobs, Claim, Lease, Outcome, Store, StoreError},
};

/// Pause between tries to write the end of an attempt.
const SETTLE_PAUSE: Duration = Duration::from_secs(1);

/// What every attempt needs.
pub(super) struct Context {
    pub(super) store: Arc<dyn Store>,
    pub(super) blobs: Blobs,
    pub(super) runner: Arc<dyn RunJob>,
    pub(super) config: WorkerConfig,
}

/// How an attempt left the worker.
pub(super) enum End {
    /// Free for the next job.
    Free,
    /// With a thread that hangs.
    Stalled(WorkerError),
}

type RunResult = Result<Result<JobOutput, JobError>, Box<dyn Any + Send>>;

/// What happened to the lease while the job ran.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stop {
    No,
    /// Somebody cancelled the job.
    Asked,
    /// Its deadline has passed.
    Late,
    /// The worker shuts down.
    Draining,
    /// The job is no longer this worker's.
    Lost,
}

/// Runs a claimed job to its end. Whatever is logged meanwhile, here or by the run, carries the job and the attempt.
pub(super) async fn carry_out(context: &Context, claim: Claim, shutdown: &CancellationToken) -> End {
    let Claim { lease: Lease { job, attempt, .. }, .. } = claim;
    // Of the highest level, so that lines carry it however little is logged.
    let span = tracing::error_span!("job", %job, attempt);
    attempt_at(context, claim, shutdown).instrument(span).await
}

async fn attempt_at(context: &Context, claim: Claim, shutdown: &CancellationToken) -> End {
    let Claim { lease, dataset, options, adopts } = claim;
    tracing::info!("job {} begins", lease.job);
    let dataset = match context.blobs.local_file(dataset).await {
        Ok(path) => path,
        Err(error) => {
            settle(context, &lease, storage::outcome(&error), Instant::now(), shutdown).await;
            return End::Free;
        }
    };
    let cancel = CancelFlag::default();
    let (progress, watched) = watch::channel((Phase::Ingest, Progress::default()));
    let points = Points::default();
    let checkpoints = checkpoints::of_attempt(context.config.checkpoints.as_deref(), &lease, adopts);
    let run = Run { dataset, options, checkpoints, cancel: cancel.clone() };
    let result = match start(context, &lease, run, progress, points.clone()) {
        Ok(result) => result,
        Err(error) => {
            settle(context, &lease, Outcome::Retry(no_thread(&error)), Instant::now(), shutdown).await;
            return End::Free;
        }
    };
    let mut watch = Watch {
        context,
        lease: &lease,
        cancel,
        progress: watched,
        points,
        stop: Stop::No,
        renewed: Instant::now(),
        moved: Instant::now(),
    };
    match watch.until(result, shutdown).await {
        Waited::Ended(result) => {
            watch.pass_progress_on().await;
            if matches!(*result, Ok(Ok(_))) {
                watch.enter_publication().await;
            }
            conclude(context, &lease, *result, watch.stop, watch.renewed, shutdown).await;
            End::Free
        }
        Waited::DrainOver => {
            tracing::warn!("job {} did not stop in time; releasing it", lease.job);
            settle(context, &lease, Outcome::Released, watch.renewed, shutdown).await;
            End::Free
        }
        Waited::Stalled => {
            let limit = context.config.stall_limit;
            let error = WorkerError::Stalled { job: lease.job, attempt: lease.attempt, limit };
            tracing::error!("{error}");
            settle(context, &lease, Outcome::Retry(stalled(limit)), watch.renewed, shutdown).await;
            End::Stalled(error)
        }
    }
}

/// What a run is told.
struct Run {
    dataset: PathBuf,
    options: TrainOptions,
    checkpoints: Checkpoints,
    cancel: CancelFlag,
}

/// Starts the run on a thread of its own: it may take hours, and tokio's pool is not for that.
fn start(
    context: &Context,
    lease: &Lease,
    run: Run,
    progress: watch::Sender<(Phase, Progress)>,
    points: Points,
) -> std::io::Result<oneshot::Receiver<RunResult>> {
    let runner = Arc::clone(&context.runner);
    let (send, receive) = oneshot::channel();
    let span = Span::current();
    std::thread::Builder::new().name(format!("job-{}", lease.job)).spawn(move || {
        let _of_the_job = span.entered();
        let mut report = |phase: Phase, state: &Progress| {
            points.add(phase, state);
            progress.send_replace((phase, state.clone()));
        };
        let Run { dataset, options, checkpoints, cancel } = run;
        let result = catch_unwind(AssertUnwindSafe(|| {
            runner.run(&dataset, &options, &checkpoints, &mut report, &cancel)
        }));
        // Nobody listens any more if the worker gave the job up.
        let _ = send.send(result);
    })?;
    Ok(receive)
}

enum Waited {
    Ended(Box<RunResult>),
    DrainOver,
    Stalled,
}

/// Keeps the lease while the run goes on.
struct Watch<'a> {
    context: &'a Context,
    lease: &'a Lease,
    cancel: CancelFlag,
    progress: watch::Receiver<(Phase, Progress)>,
    points: Points,
    stop: Stop,
    renewed: Instant,
    moved: Instant,
}

impl Watch<'_> {
    async fn until(
        &mut self,
        mut result: oneshot::Receiver<RunResult>,
        shutdown: &CancellationToken,
    ) -> Waited {
        let config = &self.context.config;
        let mut heartbeat = interval_at(Instant::now() + config.heartbeat, config.heartbeat);
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut report = interval_at(Instant::now() + config.report_every, config.report_every);
        report.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut drain_until = None;
        loop {
            tokio::select! {
                ended = &mut result => {
                    let vanished = |_| Err(Box::new("the run's thread vanished") as _);
                    return Waited::Ended(Box::new(ended.unwrap_or_else(vanished)));
                }
                () = shutdown.cancelled(), if drain_until.is_none() => {
                    drain_until = Some(Instant::now() + config.drain);
                    self.stop(Stop::Draining);
                }
                () = sleep_until(drain_until.unwrap_or_else(Instant::now)), if drain_until.is_some() => {
                    return Waited::DrainOver;
                }
                _ = heartbeat.tick(), if self.stop != Stop::Lost => self.beat().await,
                _ = report.tick() => {
                    self.pass_progress_on().await;
                    if self.moved.elapsed() > config.stall_limit {
                        return Waited::Stalled;
                    }
                }
            }
        }
    }

    /// Asks the run to stop; a lost lease outweighs a shutdown, which outweighs a deadline, which outweighs a request.
    fn stop(&mut self, why: Stop) {
        let rank = |stop| match stop {
            Stop::No => 0,
            Stop::Asked => 1,
            Stop::Late => 2,
            Stop::Draining => 3,
            Stop::Lost => 4,
        };
        if rank(why) > rank(self.stop) {
            tracing::info!(reason = ?why, "stopping job {}", self.lease.job);
            self.stop = why;
        }
        self.cancel.cancel();
    }

    async fn beat(&mut self) {
        match self.context.store.heartbeat(self.lease).await {
            Ok(heartbeat) => {
                self.renewed = Instant::now();
                if heartbeat.cancel_requested {
                    self.stop(Stop::Asked);
                }
                if heartbeat.overdue {
                    self.stop(Stop::Late);
                }
            }
            Err(error) => self.store_failed("heartbeat", &error),
        }
    }

    async fn pass_progress_on(&mut self) {
        // An error means only that the run has ended; what it reported last is still there.
        if !self.progress.has_changed().unwrap_or(true) || self.stop == Stop::Lost {
            return;
        }
        let (phase, progress) = self.progress.borrow_and_update().clone();
        self.moved = Instant::now();
        // Points first: whoever sees the job's new version sees them too.
        self.pass_points_on().await;
        if let Err(error) = self.context.store.report(self.lease, phase, &progress).await {
            self.store_failed("report", &error);
        }
    }

    async fn pass_points_on(&mut self) {
        let points = self.points.take();
        if points.is_empty() {
            return;
        }
        if let Err(error) = self.context.store.record(self.lease, &points).await {
            self.points.put_back(points);
            self.store_failed("points", &error);
        }
    }

    /// Renews the lease for the time that publication takes, and says so.
    async fn enter_publication(&mut self) {
        self.beat().await;
        let (_, progress) = self.progress.borrow().clone();
        if self.stop != Stop::Lost
            && let Err(error) = self.context.store.report(self.lease, Phase::Publish, &progress).await
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
        if gone || self.renewed.elapsed() > self.context.config.lease {
            self.stop(Stop::Lost);
        }
    }
}

async fn conclude(
    context: &Context,
    lease: &Lease,
    result: RunResult,
    stop: Stop,
    renewed: Instant,
    shutdown: &CancellationToken,
) {
    let outcome = match (result, stop) {
        (_, Stop::Lost) => {
            tracing::warn!("job {} was lost; its result is dropped", lease.job);
            // If nobody has taken it, since the database was out of everybody's reach, this worker has not died.
            Outcome::Released
        }
        (Ok(Ok(output)), _) => publish(context, output).await,
        (Ok(Err(JobError::Fail(problem))), _) => Outcome::Failed(problem),
        (Ok(Err(JobError::Retry(problem))), _) => Outcome::Retry(storage::shown(problem)),
        (Ok(Err(JobError::Hold(problem))), _) => Outcome::Held(storage::shown(problem)),
        (Ok(Err(JobError::Cancelled)), Stop::Asked) => Outcome::Cancelled,
        (Ok(Err(JobError::Cancelled)), Stop::Late | Stop::Draining) => Outcome::Released,
        (Ok(Err(JobError::Cancelled)), Stop::No) => Outcome::Retry(stopped_unasked()),
        (Err(panic), _) => {
            tracing::error!("job {} panicked: {}", lease.job, panic_text(&*panic));
            Outcome::Retry(panicked())
        }
    };
    settle(context, lease, outcome, renewed, shutdown).await;
}

/// Makes the output's blobs durable; only then may the job refer to them.
async fn publish(context: &Context, output: JobOutput) -> Outcome {
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
        match context.blobs.put(content).await {
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
async fn settle(
    context: &Context,
    lease: &Lease,
    outcome: Outcome,
    renewed: Instant,
    shutdown: &CancellationToken,
) {
    loop {
        match context.store.finish(lease, outcome.clone()).await {
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
                if renewed.elapsed() > context.config.lease
                    && (shutdown.is_cancelled() || !error.is_disk_full()) =>
            {
                tracing::error!(error = &error as &dyn std::error::Error, "giving up: {error}");
                return;
            }
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "trying again: {error}");
                sleep(SETTLE_PAUSE).await;
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
