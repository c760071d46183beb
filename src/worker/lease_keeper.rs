//! Work of an attempt on a thread of its own, while the lease is renewed, progress is reported, and the reasons to stop are listened for.

use std::{
    any::Any,
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    pin::pin,
    time::Duration,
};

use futures_util::future::{Either, select};
use tokio::{
    sync::{oneshot, watch},
    time::{Instant, MissedTickBehavior, interval_at, sleep_until},
};
use tokio_util::sync::CancellationToken;
use tracing::Span;

use super::{deps::WorkerDeps, previews::Previews, series_buffer::SeriesBuffer};
use crate::{
    domain::{CancelFlag, Phase, Progress},
    pipeline::JobError,
    store::{Lease, StoreError},
};

/// How the work of a thread ended.
pub(super) type WorkResult<T> = Result<Result<T, JobError>, Box<dyn Any + Send>>;

/// Why the run is to stop; a later reason outweighs an earlier one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum StopReason {
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

/// Does work that a bucket may take long for, and renews the lease meanwhile.
pub(super) async fn while_renewing<T>(
    deps: &WorkerDeps,
    lease: &Lease,
    last_renewed: &mut Instant,
    work: impl Future<Output = T>,
) -> T {
    let renew = || async {
        // What it says is heard again when the run begins, or when its end is written.
        let renewed = deps.store.heartbeat(lease).await;
        if let Err(error) = &renewed {
            tracing::warn!(error = error as &dyn std::error::Error, "heartbeat: {error}");
        }
        renewed.is_ok()
    };
    with_renewals(deps.config.heartbeat, renew, last_renewed, work).await
}

/// Does work, and renews something every so often meanwhile. The work goes on during a renewal: it may hold what that waits for, such
/// as the one connection that writes to SQLite.
async fn with_renewals<T, R: Future<Output = bool>>(
    every: Duration,
    mut renew: impl FnMut() -> R,
    last_renewed: &mut Instant,
    work: impl Future<Output = T>,
) -> T {
    let mut heartbeat = interval_at(Instant::now() + every, every);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut work = pin!(work);
    loop {
        tokio::select! {
            done = &mut work => return done,
            _ = heartbeat.tick() => {}
        }
        let (done, is_renewed) = match select(work.as_mut(), pin!(renew())).await {
            Either::Left((done, renewal)) => (Some(done), renewal.await),
            Either::Right((is_renewed, _)) => (None, is_renewed),
        };
        if is_renewed {
            *last_renewed = Instant::now();
        }
        if let Some(done) = done {
            return done;
        }
    }
}

/// How a run ended, or why its end is not awaited.
pub(super) enum RunEnd<T> {
    Ended(Box<WorkResult<T>>),
    /// There is no thread for it.
    NotStarted(io::Error),
    /// It did not stop in the time for draining.
    DrainOver,
    /// It makes no progress.
    Stalled,
}

/// Renews the lease and reports progress while an attempt works.
pub(super) struct LeaseKeeper<'a> {
    pub(super) deps: &'a WorkerDeps,
    pub(super) lease: &'a Lease,
    cancel: CancelFlag,
    progress: watch::Receiver<(Phase, Progress)>,
    points: SeriesBuffer,
    previews: Previews,
    /// Why the work is to stop.
    pub(super) stop: StopReason,
    pub(super) last_renewed: Instant,
    last_progress: Instant,
}

impl<'a> LeaseKeeper<'a> {
    pub(super) fn new(deps: &'a WorkerDeps, lease: &'a Lease, last_renewed: Instant) -> Self {
        Self {
            deps,
            lease,
            cancel: CancelFlag::default(),
            progress: watch::channel((Phase::Ingest, Progress::default())).1,
            points: SeriesBuffer::default(),
            previews: Previews::default(),
            stop: StopReason::None,
            last_renewed,
            last_progress: Instant::now(),
        }
    }

    /// Runs `work` on a thread of its own, since it may take hours. The work reports progress, and stops once the flag is set.
    pub(super) async fn run<T: Send + 'static>(
        &mut self,
        shutdown: &CancellationToken,
        work: impl FnOnce(&mut dyn FnMut(Phase, &Progress), &CancelFlag) -> Result<T, JobError> + Send + 'static,
    ) -> RunEnd<T> {
        let (progress, watched) = watch::channel((Phase::Ingest, Progress::default()));
        let (points, previews, cancel) = (self.points.clone(), self.previews.clone(), self.cancel.clone());
        let (send, receive) = oneshot::channel();
        let span = Span::current();
        let started = std::thread::Builder::new().name(format!("job-{}", self.lease.job)).spawn(move || {
            let _entered = span.entered();
            let mut report = |phase: Phase, state: &Progress| {
                points.add(phase, state);
                previews.add(state);
                progress.send_replace((phase, state.clone()));
            };
            let result = catch_unwind(AssertUnwindSafe(|| work(&mut report, &cancel)));
            // There is no receiver if the worker has released the job.
            let _ = send.send(result);
        });
        if let Err(error) = started {
            return RunEnd::NotStarted(error);
        }
        (self.progress, self.last_progress) = (watched, Instant::now());
        self.wait(receive, shutdown).await
    }

    async fn wait<T>(
        &mut self,
        mut result: oneshot::Receiver<WorkResult<T>>,
        shutdown: &CancellationToken,
    ) -> RunEnd<T> {
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
                    self.publish_preview().await;
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

    pub(super) async fn report_progress(&mut self) {
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

    async fn publish_preview(&mut self) {
        if self.stop == StopReason::None {
            let (previews, deps, lease) = (self.previews.clone(), self.deps, self.lease);
            while_renewing(deps, lease, &mut self.last_renewed, previews.publish(deps, lease)).await;
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
    pub(super) async fn start_publication(&mut self) {
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

#[cfg(test)]
mod tests {
    use tokio::{
        sync::Mutex,
        time::{sleep, timeout},
    };

    use super::*;

    #[tokio::test]
    async fn work_that_holds_what_a_renewal_waits_for_goes_on() {
        let connection = Mutex::new(());
        let every = Duration::from_millis(1);
        let renew = || async {
            let _held = connection.lock().await;
            true
        };
        let work = async {
            for _ in 0..20 {
                let _held = connection.lock().await;
                sleep(3 * every).await;
            }
        };
        let started = Instant::now();
        let mut last_renewed = started;
        let both = with_renewals(every, renew, &mut last_renewed, work);
        timeout(Duration::from_secs(60), both).await.expect("both go on");
        assert!(last_renewed > started, "it was renewed meanwhile");
    }
}
