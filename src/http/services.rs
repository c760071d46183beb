//! The services that the handlers use. They are passed in, so that tests can replace them and layers stay separate.

use std::sync::Arc;

use bytes::Bytes;
use tokio::runtime::Handle;
use uuid::{NoContext, Uuid};

use super::problem::ProblemResponse;
use crate::{
    domain::{Clock, Digest, Problem, RandomSource, Workers},
    engine::SceneEngine,
    store::{Blobs, Store},
};

/// The services that the handlers use.
#[derive(Clone)]
pub struct Services {
    /// Jobs and events.
    pub store: Store,
    /// Datasets and results.
    pub blobs: Blobs,
    pub clock: Arc<dyn Clock>,
    pub entropy: Arc<dyn RandomSource>,
    /// Checks, views and exports.
    pub engine: Arc<dyn SceneEngine>,
    /// The worker processes.
    pub workers: Arc<dyn Workers>,
}

impl Services {
    /// The content of a blob; blocks.
    pub(super) fn read(&self, runtime: &Handle, digest: Digest) -> Result<Bytes, Problem> {
        read_blob(&self.blobs, runtime, digest)
    }

    /// A UUID of version 7 whose time is the service's clock, so that ids sort in the order of creation.
    pub(super) fn new_uuid(&self) -> Uuid {
        let now = self.clock.now();
        let seconds = u64::try_from(now.as_second()).unwrap_or(0);
        let nanoseconds = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
        Uuid::new_v7(uuid::Timestamp::from_unix(NoContext, seconds, nanoseconds))
    }
}

/// The content of a blob; blocks on `runtime`.
pub(super) fn read_blob(blobs: &Blobs, runtime: &Handle, digest: Digest) -> Result<Bytes, Problem> {
    runtime.block_on(blobs.read(digest)).map_err(|error| ProblemResponse::from(error).into_problem())
}
