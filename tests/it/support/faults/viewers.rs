//! Viewers, with faults.

use tcgs::store::{StoreFuture, ViewerRecord, Viewers};

use super::FaultStore;

impl Viewers for FaultStore {
    fn announce_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()> {
        self.guard(self.inner.announce_viewer(viewer))
    }
    fn live_viewers(&self) -> StoreFuture<'_, Vec<ViewerRecord>> {
        self.guard(self.inner.live_viewers())
    }
    fn withdraw_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()> {
        self.guard(self.inner.withdraw_viewer(viewer))
    }
}
