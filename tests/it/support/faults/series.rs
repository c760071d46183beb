//! Series that fail when told to.

use tcgs::{
    domain::{JobId, Progress, SeriesPoint},
    store::{Lease, Series, StoreFuture},
};

use super::FaultStore;

impl Series for FaultStore {
    fn record<'a>(&'a self, lease: &'a Lease, points: &'a [Progress]) -> StoreFuture<'a, ()> {
        self.guard(self.inner.record(lease, points))
    }
    fn series(&self, job: JobId) -> StoreFuture<'_, Option<Vec<SeriesPoint>>> {
        self.guard(self.inner.series(job))
    }
}
