//! What can go wrong in the job table.

use thiserror::Error;

use super::{PriorRequest, is_disk_full};
use crate::domain::{JobId, SceneId};

/// A fault of the job table.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The job is not running the attempt that the worker was given: it was reclaimed, ended or cancelled.
    #[error("attempt {attempt} no longer holds job {job}")]
    LeaseLost {
        /// The job.
        job: JobId,
        /// The attempt that the worker was given.
        attempt: u32,
    },
    /// A request with the same `Idempotency-Key` made something before; nothing was written.
    #[error("the Idempotency-Key was used before, for {}", .0.resource)]
    IdempotencyKeyUsed(Box<PriorRequest>),
    /// More than the owner has room for.
    #[error(
        "over the quota of {quota} bytes: {used} are stored or kept for uploads, and there has to be room for {asked} more"
    )]
    QuotaExceeded {
        /// What was to be added, at least.
        asked: u64,
        /// What is stored or reserved.
        used: u64,
        /// How much may be.
        quota: u64,
    },
    /// More jobs than the owner may have at a time.
    #[error("{active} jobs are queued or running, which is all that the key may have at a time")]
    TooManyJobs {
        /// How many there are.
        active: u32,
    },
    /// A higher priority than the owner's jobs may have.
    #[error("priority {asked} is above {most}, the highest that jobs of this key may have")]
    PriorityTooHigh {
        /// What was wished for.
        asked: i32,
        /// What there may be.
        most: i32,
    },
    /// The scene that a job was to be made of is deleted.
    #[error("there is no scene {0}")]
    NoScene(SceneId),
    /// A stored value cannot be read back.
    #[error("the stored {what} is unreadable: {fault}")]
    Corrupt {
        /// Table and column.
        what: &'static str,
        /// Why.
        fault: String,
    },
    /// The database does not open.
    #[error("the database {path} does not open")]
    Open {
        /// Where it is.
        path: String,
        /// Why.
        #[source]
        source: sqlx::Error,
    },
    /// The schema is older than this program, and was not to be changed.
    #[error(
        "the schema of {path} has version {found}, older than this program's {needed}: stop the service that uses it, then run \
         'tcgs migrate' or start 'tcgs serve' of this version"
    )]
    SchemaOlder {
        /// The database.
        path: String,
        /// Its version.
        found: i64,
        /// The program's.
        needed: i64,
    },
    /// The schema is newer than this program.
    #[error(
        "the schema of {path} has version {found}, newer than this program's {needed}: use the version of tcgs that changed it, or a \
         later one"
    )]
    SchemaNewer {
        /// The database.
        path: String,
        /// Its version.
        found: i64,
        /// The program's.
        needed: i64,
    },
    /// The schema cannot be brought to this version.
    #[error("the database schema cannot be brought up to date")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// A statement failed.
    #[error("the database refused a statement")]
    Database(#[from] sqlx::Error),
}

impl StoreError {
    /// Whether there is no room left for the database. Nothing was written, and the same call may succeed once there is room.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        is_disk_full(self)
    }

    /// Whether the same call may succeed a moment later: the database was busy, out of connections, or its file could not be read or
    /// written. A full disk ([`StoreError::is_disk_full`]) is told apart, since somebody has to make room first.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        let StoreError::Database(error) = self else { return false };
        match error {
            sqlx::Error::PoolTimedOut | sqlx::Error::Io(_) | sqlx::Error::WorkerCrashed => {
                !self.is_disk_full()
            }
            error => result_code(error).is_some_and(|code| {
                matches!(code & 0xff, BUSY | LOCKED | IOERR | CANTOPEN) && !self.is_disk_full()
            }),
        }
    }
}

/// SQLite's primary result codes, in the low byte of extended ones.
const BUSY: u32 = 5;
const LOCKED: u32 = 6;
const IOERR: u32 = 10;
const CANTOPEN: u32 = 14;

/// SQLite's extended result code.
pub(super) fn result_code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.code()?.parse().ok()
}
