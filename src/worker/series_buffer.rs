//! Buffers the points of a training curve between the run's thread and the store.
//!
//! A run may report many times between two reports of its worker, which sends only the latest progress. The buffer keeps one point for
//! each bucket of the run, so that a run of seconds has a curve too.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::domain::{Phase, Progress, series_bucket};

/// Buffered points, at most [`SERIES_POINTS`](crate::domain::SERIES_POINTS) of a run; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct SeriesBuffer(Arc<Mutex<Vec<Progress>>>);

impl SeriesBuffer {
    /// Adds a report of training; replaces the one before if that is in the same bucket.
    pub(super) fn add(&self, phase: Phase, progress: &Progress) {
        if phase != Phase::Train {
            return;
        }
        let mut waiting = self.lock();
        if waiting.last().is_some_and(|last| series_bucket(last) == series_bucket(progress)) {
            waiting.pop();
        }
        waiting.push(progress.clone());
    }

    /// Removes and returns all points.
    pub(super) fn take(&self) -> Vec<Progress> {
        std::mem::take(&mut *self.lock())
    }

    /// Puts back points that could not be stored, before those added since.
    pub(super) fn put_back(&self, points: Vec<Progress>) {
        self.lock().splice(..0, points);
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Progress>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bucket_keeps_its_latest_report() {
        let points = SeriesBuffer::default();
        let report = |step| Progress { step, total: 10_000, ..Progress::default() };
        for step in 1..=10_000 {
            points.add(Phase::Train, &report(step));
        }
        points.add(Phase::Encode, &report(10_000));
        let taken = points.take();
        assert_eq!(taken.len(), 1000);
        assert_eq!((taken[0].step, taken[999].step), (10, 10_000));
        assert!(points.take().is_empty());
        points.add(Phase::Train, &report(20));
        points.put_back(taken);
        assert_eq!(points.take().last().map(|last| last.step), Some(20));
    }
}
