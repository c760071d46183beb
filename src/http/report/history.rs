//! What a job's events tell of its course: one line of reports, whatever interruptions there were.

use serde_json::Value;

use crate::{
    domain::{Event, EventKind, JobId, Progress},
    store::{Store, StoreError},
};

/// Events that are read at a time, and how often at most.
const PAGE: u32 = 1000;
const PAGES: usize = 30;

/// The reports that led to where the job is now, oldest first. What an attempt did again is there once; its seconds go on from
/// those of the attempt before it.
#[derive(Debug, Default)]
pub(super) struct History {
    pub(super) reports: Vec<Progress>,
    /// Seconds of work until the latest report.
    pub(super) end: f64,
    /// The attempt of the latest report.
    attempt: u32,
    /// Seconds before the latest attempt's own.
    before: f64,
}

impl History {
    /// Reads the events of a job; of one with more than tens of thousands, the first of them.
    pub(super) async fn read(store: &dyn Store, job: JobId) -> Result<Self, StoreError> {
        let (mut history, mut after) = (Self::default(), 0);
        for _ in 0..PAGES {
            let Some(events) = store.events(job, after, PAGE).await? else { break };
            let Some(last) = events.last() else { break };
            after = last.seq;
            let is_last = events.len() < PAGE as usize;
            events.into_iter().for_each(|event| history.take(event));
            if is_last {
                break;
            }
        }
        Ok(history)
    }

    fn take(&mut self, event: Event) {
        if event.kind != EventKind::Progress {
            return;
        }
        let Ok(progress) = serde_json::from_value::<Progress>(Value::clone(&event.data)) else { return };
        if event.attempt != self.attempt {
            self.attempt = event.attempt;
            // The first report of an attempt that goes on from a checkpoint tells where from.
            self.reports.retain(|report| report.step < progress.step);
            self.before = self.reports.last().map_or(0.0, |report| report.elapsed_seconds);
        }
        let elapsed_seconds = self.before + progress.elapsed_seconds;
        self.end = elapsed_seconds;
        // What follows training repeats its last report.
        if self.reports.last().is_some_and(|last| last.step == progress.step && last.loss == progress.loss) {
            return;
        }
        self.reports.push(Progress { elapsed_seconds, ..progress });
    }

    /// The pairs of figures that both are known for, as `x` and `y` give them.
    pub(super) fn points(
        &self,
        x: impl Fn(&Progress) -> Option<f64>,
        y: impl Fn(&Progress) -> Option<f64>,
    ) -> Vec<(f64, f64)> {
        let finite = |value: f64| value.is_finite().then_some(value);
        self.reports.iter().filter_map(|report| Some((finite(x(report)?)?, finite(y(report)?)?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;

    fn report(attempt: u32, step: u64, elapsed_seconds: f64, psnr: Option<f64>) -> Event {
        let data = Progress { step, elapsed_seconds, psnr, ..Progress::default() };
        let data = serde_json::to_value(data).expect("JSON");
        Event { seq: 1, at: Timestamp::UNIX_EPOCH, kind: EventKind::Progress, attempt, data }
    }

    #[test]
    fn an_attempt_that_goes_on_continues_the_line_and_one_that_starts_over_begins_it_anew() {
        let mut history = History::default();
        for event in [report(1, 0, 1.0, None), report(1, 10, 5.0, Some(20.0)), report(1, 30, 9.0, Some(22.0))]
        {
            history.take(event);
        }
        history.take(report(2, 20, 0.5, Some(21.0)));
        history.take(report(2, 40, 4.5, Some(23.0)));
        let line =
            |history: &History| history.points(|report| Some(report.elapsed_seconds), |report| report.psnr);
        assert_eq!(line(&history), [(5.0, 20.0), (5.5, 21.0), (9.5, 23.0)]);
        history.take(report(3, 0, 1.0, Some(9.0)));
        assert_eq!(line(&history), [(1.0, 9.0)]);
        history.take(report(3, 0, 7.0, Some(9.0)));
        assert_eq!((line(&history).len(), history.end), (1, 7.0), "a repeated report only takes time");
    }

    #[test]
    fn what_is_no_report_is_passed_over() {
        let mut history = History::default();
        history.take(Event { kind: EventKind::State, ..report(1, 1, 1.0, Some(1.0)) });
        history.take(Event { data: serde_json::json!("odd"), ..report(1, 1, 1.0, Some(1.0)) });
        assert!(history.reports.is_empty());
    }
}
