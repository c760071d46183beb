//! Reports progress again and again during work that has none to report, so that nobody takes it for stalled.

use std::{
    panic::resume_unwind,
    sync::mpsc::{self, RecvTimeoutError},
    thread,
    time::Duration,
};

use super::PoseProgress;

/// Time after which progress is reported again while it stays the same.
pub(super) const REPORT_AGAIN: Duration = Duration::from_secs(30);

/// What `work` returns. It runs on a thread of its own, while this one reports `progress` at once and every 30 seconds.
pub fn while_reporting<T: Send>(
    progress: PoseProgress,
    report: &mut dyn FnMut(PoseProgress),
    work: impl FnOnce() -> T + Send,
) -> T {
    reporting_every(REPORT_AGAIN, progress, report, work)
}

fn reporting_every<T: Send>(
    pause: Duration,
    progress: PoseProgress,
    report: &mut dyn FnMut(PoseProgress),
    work: impl FnOnce() -> T + Send,
) -> T {
    report(progress);
    thread::scope(|scope| {
        let (sender, ended) = mpsc::channel::<()>();
        let working = scope.spawn(move || {
            let _dropped_at_the_end = sender;
            work()
        });
        while ended.recv_timeout(pause) == Err(RecvTimeoutError::Timeout) {
            report(progress);
        }
        working.join().unwrap_or_else(|panic| resume_unwind(panic))
    })
}

#[cfg(test)]
mod tests {
    use super::{super::PoseStage, *};

    #[test]
    fn progress_is_reported_until_the_work_ends() {
        let progress =
            PoseProgress { stage: PoseStage::Features, done: 0, total: 3, reprojection_error: None };
        let (sender, seen) = mpsc::channel();
        // The last may come when the work has just ended.
        let mut report = |reported| _ = sender.send(reported);
        let work = move || {
            // Without reports it would never end.
            (0..4).map(|_| seen.recv().expect("a report")).collect::<Vec<_>>()
        };
        assert_eq!(reporting_every(Duration::from_millis(1), progress, &mut report, work), [progress; 4]);
    }
}
