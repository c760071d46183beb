//! The parts of a worker that every attempt uses.

use std::sync::Arc;

use super::WorkerConfig;
use crate::{
    pipeline::RunJob,
    store::{Blobs, Store},
};

/// The parts of a worker that every attempt uses.
pub(super) struct WorkerDeps {
    pub(super) store: Store,
    pub(super) blobs: Blobs,
    pub(super) runner: Arc<dyn RunJob>,
    pub(super) config: WorkerConfig,
}
