//! Training curves, point by point.

use super::{Lease, StoreFuture};
use crate::domain::{JobId, Progress, SeriesPoint};

/// The part of a store that keeps training curves.
pub trait Series: Send + Sync + 'static {
    /// Adds points of an attempt, in order. A point replaces every one at a later step, left by an earlier attempt, and the one in
    /// its [bucket](crate::domain::series_bucket); a point without a loss, the first of an attempt, replaces none in its bucket.
    fn record<'a>(&'a self, lease: &'a Lease, points: &'a [Progress]) -> StoreFuture<'a, ()>;

    /// The points of a job by their steps; `None` if there is no such job.
    fn series(&self, job: JobId) -> StoreFuture<'_, Option<Vec<SeriesPoint>>>;
}
