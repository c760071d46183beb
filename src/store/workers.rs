//! The processes that run jobs, as the database knows them.

use std::time::Duration;

/// How long a worker counts as alive after it was last announced.
pub const WORKER_LIFE: Duration = Duration::from_secs(60);
