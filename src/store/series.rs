//! How training goes, point by point.

use super::{Lease, StoreFuture};
use crate::domain::{JobId, Progress, SeriesPoint};

/// The part of the store that keeps series.
pub trait Series: Send + Sync + 'static {
    /// Adds points of an attempt, in their order. A point takes the place of every one at a later step, which an earlier
    /// attempt left, and of the one in its [bucket](crate::domain::series_bucket); one without a loss, which an attempt
    /// begins with, takes no one's place.
    fn record<'a>(&'a self, lease: &'a Lease, points: &'a [Progress]) -> StoreFuture<'a, ()>;

    /// The points of a job by their steps; `None` if there is no such job.
    fn series(&self, job: JobId) -> StoreFuture<'_, Option<Vec<SeriesPoint>>>;
}
