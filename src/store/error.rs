//! Errors of the store.

use thiserror::Error;

use super::{
    PriorRequest,
    disk_full::{is_disk_full, result_code, sql_state},
};
use crate::domain::{DatasetId, JobId, Preparation, ProjectId};

/// An error of the store.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The job is not running the attempt that the worker was given: it was reclaimed, ended or cancelled.
    #[error("attempt {attempt} no longer holds job {job}")]
    LeaseLost {
        job: JobId,
        /// The attempt that the worker was given.
        attempt: u32,
    },
    /// The `Idempotency-Key` was used before; nothing was written.
    #[error("the Idempotency-Key was used before, for {}", .0.resource)]
    IdempotencyKeyUsed(Box<PriorRequest>),
    /// Over the project's quota.
    #[error(
        "over the quota of {quota} bytes: {used} are stored or reserved for uploads, and {requested} more are needed"
    )]
    QuotaExceeded {
        /// Bytes to be added, at least.
        requested: u64,
        /// Bytes stored or reserved.
        used: u64,
        quota: u64,
    },
    /// The project has its maximum of active jobs.
    #[error("{active} jobs are queued or running, the maximum for this project")]
    TooManyJobs {
        /// How many are queued or running.
        active: u32,
    },
    /// The project has its maximum of open uploads.
    #[error("{open} uploads are open, the maximum for a project")]
    TooManyUploads {
        /// How many are open.
        open: u32,
    },
    /// A higher priority than the project's jobs may have.
    #[error("priority {requested} is above {max}, the maximum for jobs of this project")]
    PriorityTooHigh {
        /// The requested priority.
        requested: i32,
        /// The maximum.
        max: i32,
    },
    /// Workers live, and none of them can prepare a new job's dataset.
    #[error("no worker can prepare the dataset: it needs {needs:?}, and they can do at most {best:?}")]
    NoWorker {
        /// The preparation that the dataset needs.
        needs: Preparation,
        /// The most that a worker can do.
        best: Preparation,
    },
    /// There is no such project for a new key.
    #[error("there is no project {0}")]
    NoProject(ProjectId),
    /// The dataset of a new job does not exist any more.
    #[error("there is no scene {0}")]
    NoDataset(DatasetId),
    /// A stored value cannot be read back.
    #[error("the stored {what} is unreadable: {error}")]
    Corrupt {
        /// Table and column.
        what: &'static str,
        error: String,
    },
    /// The database does not open.
    #[error("the database {path} does not open")]
    Open {
        /// Where it is.
        path: String,
        #[source]
        source: sqlx::Error,
    },
    /// The schema is older than this program's, and was not to be migrated.
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
    /// The schema is newer than this program's.
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
    /// The database's blobs are files of its data folder, and a bucket was named.
    #[error(
        "the files of this database are in its data folder, not in a bucket: leave --blobs out, or move them with 'tcgs backup' and \
         'tcgs restore --blobs'"
    )]
    BlobsInFolder,
    /// The database's blobs are in a bucket, and none was named.
    #[error("the files of this database are in a bucket: name it with --blobs s3://BUCKET")]
    BlobsInBucket,
    /// The schema cannot be migrated.
    #[error("the database schema cannot be migrated")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// What only SQLite can do.
    #[error("a {0} of a PostgreSQL database is made with pg_dump")]
    NotInPostgres(&'static str),
    /// A statement failed.
    #[error("a database statement failed")]
    Database(#[from] sqlx::Error),
}

impl StoreError {
    /// An error of a database that does not answer.
    #[cfg(test)]
    pub(crate) fn of_a_silent_database() -> Self {
        Self::Database(sqlx::Error::PoolTimedOut)
    }

    /// Whether the disk is full. Nothing was written, and the same call may succeed once there is space.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        is_disk_full(self)
    }

    /// Whether it is certain that nothing was written: the store refused, or had no room. Of a commit whose answer is lost or late nobody
    /// knows; it may still be made after the error.
    #[must_use]
    pub fn has_written_nothing(&self) -> bool {
        match self {
            Self::LeaseLost { .. }
            | Self::IdempotencyKeyUsed(_)
            | Self::QuotaExceeded { .. }
            | Self::TooManyJobs { .. }
            | Self::TooManyUploads { .. }
            | Self::PriorityTooHigh { .. }
            | Self::NoWorker { .. }
            | Self::NoProject(_)
            | Self::NoDataset(_) => true,
            error => error.is_disk_full(),
        }
    }

    /// Whether the same call may succeed a moment later: the database was busy, out of connections, not to be reached, or its file could not
    /// be read or written, or PostgreSQL undid the transaction for the sake of another. False for a full disk ([`StoreError::is_disk_full`]), since somebody has to make space first.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        let StoreError::Database(error) = self else { return false };
        match error {
            sqlx::Error::PoolTimedOut | sqlx::Error::Io(_) | sqlx::Error::WorkerCrashed => {
                !self.is_disk_full()
            }
            error if let Some(state) = sql_state(error) => {
                TRANSIENT_STATES.iter().any(|class| state.starts_with(class))
            }
            error => result_code(error).is_some_and(|code| {
                matches!(code & 0xff, BUSY | LOCKED | IOERR | CANTOPEN) && !self.is_disk_full()
            }),
        }
    }
}

/// States of PostgreSQL (its manual, appendix A) after which the same call may succeed, by class or whole: connection exceptions; a reference
/// to what another transaction has deleted, which the same call then finds to be gone; a server that is being replaced and only reads;
/// serialization failures and deadlocks; too many connections, but not a full disk; locks not available in time; a server that stops, starts
/// or recovers.
const TRANSIENT_STATES: [&str; 11] =
    ["08", "23503", "25006", "25P03", "40", "53200", "53300", "55P03", "57014", "57P", "58030"];

/// SQLite's primary result codes, in the low byte of extended ones.
const BUSY: u32 = 5;
const LOCKED: u32 = 6;
const IOERR: u32 = 10;
const CANTOPEN: u32 = 14;

#[cfg(test)]
mod tests {
    use std::{io, time::Duration};

    use sqlx::{ConnectOptions as _, SqliteConnection, sqlite::SqliteConnectOptions};

    use super::*;
    use crate::store::BlobError;

    async fn run(on: &mut SqliteConnection, statement: &'static str) -> Result<(), StoreError> {
        sqlx::raw_sql(statement).execute(on).await?;
        Ok(())
    }

    #[tokio::test]
    async fn a_busy_database_may_answer_later_and_a_full_one_has_written_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let options = SqliteConnectOptions::new().filename(folder.path().join("database"));
        let options = options.create_if_missing(true).busy_timeout(Duration::ZERO);
        let mut one = options.connect().await.expect("a connection");
        let mut other = options.connect().await.expect("a connection");
        run(&mut one, "PRAGMA journal_mode = WAL; CREATE TABLE numbers (number)").await.expect("made");

        run(&mut one, "BEGIN IMMEDIATE").await.expect("begun");
        let busy = run(&mut other, "BEGIN IMMEDIATE").await.expect_err("one writes at a time");
        run(&mut one, "ROLLBACK; BEGIN; SELECT * FROM numbers").await.expect("read");
        run(&mut other, "INSERT INTO numbers VALUES (1)").await.expect("written");
        // SQLITE_BUSY_SNAPSHOT, an extended code.
        let outdated =
            run(&mut one, "INSERT INTO numbers VALUES (2)").await.expect_err("it has read an older state");
        for error in [busy, outdated] {
            assert!(
                error.is_transient() && !error.is_disk_full() && !error.has_written_nothing(),
                "{error:?}"
            );
            let of_blobs = BlobError::from(error);
            assert!(of_blobs.is_transient() && !of_blobs.is_disk_full(), "{of_blobs:?}");
        }

        // As small as it can be.
        run(&mut other, "PRAGMA max_page_count = 1").await.expect("set");
        let full =
            run(&mut other, "INSERT INTO numbers VALUES (zeroblob(1000000))").await.expect_err("no room");
        let no_space = StoreError::Database(io::Error::from(io::ErrorKind::StorageFull).into());
        for error in [full, no_space] {
            assert!(
                error.is_disk_full() && error.has_written_nothing() && !error.is_transient(),
                "{error:?}"
            );
            let of_blobs = BlobError::from(error);
            assert!(of_blobs.is_disk_full() && !of_blobs.is_transient(), "{of_blobs:?}");
        }

        let wrong = run(&mut other, "INSERT INTO letters VALUES (1)").await.expect_err("no such table");
        let unknown = StoreError::Database(io::Error::from(io::ErrorKind::TimedOut).into());
        assert!(!wrong.is_transient() && unknown.is_transient());
        for error in [wrong, unknown] {
            assert!(!error.is_disk_full() && !error.has_written_nothing(), "{error:?}");
        }
        let refused = StoreError::TooManyJobs { active: 1 };
        assert!(refused.has_written_nothing() && !refused.is_transient());
        assert!(!BlobError::OtherDatabase.is_transient());
    }
}
