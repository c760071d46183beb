//! The processes that run jobs, as the database knows them.

use std::time::Duration;

use crate::domain::Preparation;

/// How long a worker counts as alive after it was last announced.
pub const WORKER_LIFE: Duration = Duration::from_secs(60);

/// A worker that asks for a job.
#[derive(Debug, Clone, Copy)]
pub struct Claimant<'a> {
    /// Its identity.
    pub id: &'a str,
    /// The preparation that it can do.
    pub can: Preparation,
}

/// A worker that trains alone.
impl<'a> From<&'a str> for Claimant<'a> {
    fn from(id: &'a str) -> Self {
        Self { id, can: Preparation::None }
    }
}

impl<'a> From<&'a String> for Claimant<'a> {
    fn from(id: &'a String) -> Self {
        id.as_str().into()
    }
}
