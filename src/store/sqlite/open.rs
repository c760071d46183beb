//! Opens the database, and migrates its schema if that is wanted.
//!
//! A process that opens a database holds the lock file beside it meanwhile. So if several processes open a new database at once, one
//! creates its tables, and none sees a schema that is partly migrated.

use std::{
    fs::{File, TryLockError},
    io,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use serde::Serialize;
use sqlx::{
    Connection as _, Row as _, SqliteConnection, SqlitePool,
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous},
};

use super::SqliteStore;
use crate::{
    domain::Clock,
    store::{QueuePolicy, StoreError},
};

/// Every change of the schema, in order.
pub(super) static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("migrations/sqlite");

const READERS: u32 = 4;
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);

/// What to do with a schema that is older than this program's. A new database gets its tables in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OlderSchema {
    Migrate,
    Refuse,
}

/// Versions of a schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct SchemaChange {
    /// The version that was found; `None` if the database was new.
    pub from: Option<i64>,
    /// The version now, which is this program's.
    pub to: i64,
}

impl SqliteStore {
    /// Opens the database at `path`, creates it if there is none, and migrates its schema.
    ///
    /// # Errors
    /// [`StoreError::Open`], [`StoreError::Migrate`] or [`StoreError::SchemaNewer`].
    pub async fn open(path: &Path, clock: Arc<dyn Clock>, policy: QueuePolicy) -> Result<Self, StoreError> {
        Ok(open(path, clock, policy, OlderSchema::Migrate).await?.0)
    }

    /// Opens the database at `path` without migrating its schema; creates the database if there is none.
    ///
    /// # Errors
    /// [`StoreError::Open`], [`StoreError::Migrate`], [`StoreError::SchemaOlder`] or [`StoreError::SchemaNewer`].
    pub async fn open_current(
        path: &Path,
        clock: Arc<dyn Clock>,
        policy: QueuePolicy,
    ) -> Result<Self, StoreError> {
        Ok(open(path, clock, policy, OlderSchema::Refuse).await?.0)
    }

    /// As [`SqliteStore::open`]; also returns the schema's versions before and after.
    ///
    /// # Errors
    /// As [`SqliteStore::open`].
    pub async fn migrate(
        path: &Path,
        clock: Arc<dyn Clock>,
        policy: QueuePolicy,
    ) -> Result<(Self, SchemaChange), StoreError> {
        open(path, clock, policy, OlderSchema::Migrate).await
    }
}

async fn open(
    path: &Path,
    clock: Arc<dyn Clock>,
    policy: QueuePolicy,
    older: OlderSchema,
) -> Result<(SqliteStore, SchemaChange), StoreError> {
    let open_error = |source| StoreError::Open { path: path.display().to_string(), source };
    let _lock = lock_beside(path).await.map_err(|fault| open_error(sqlx::Error::Io(fault)))?;
    let options = SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .busy_timeout(BUSY_TIMEOUT)
        .foreign_keys(true);
    let writer = pool(1).connect_with(options.clone()).await.map_err(open_error)?;
    let change = match migrate_schema(path, &writer, older).await {
        Ok(change) => change,
        Err(error) => {
            writer.close().await;
            return Err(error);
        }
    };
    let readers = options.read_only(true).create_if_missing(false);
    let readers = pool(READERS).connect_with(readers).await.map_err(open_error)?;
    Ok((SqliteStore { writer, readers, clock, policy, leases: std::sync::Mutex::default() }, change))
}

async fn migrate_schema(
    path: &Path,
    writer: &SqlitePool,
    older: OlderSchema,
) -> Result<SchemaChange, StoreError> {
    let found = version(&mut *writer.acquire().await?).await?;
    let needed = MIGRATIONS.iter().map(|migration| migration.version).max().unwrap_or_default();
    match found {
        Some(found) if found > needed => {
            return Err(StoreError::SchemaNewer { path: path.display().to_string(), found, needed });
        }
        Some(found) if found < needed && older == OlderSchema::Refuse => {
            return Err(StoreError::SchemaOlder { path: path.display().to_string(), found, needed });
        }
        // Even if there is nothing to do: it compares the applied migrations with the known ones.
        _ => MIGRATIONS.run(writer).await?,
    }
    Ok(SchemaChange { from: found, to: needed })
}

/// The version of the schema; `None` for a new database.
async fn version(connection: &mut SqliteConnection) -> Result<Option<i64>, StoreError> {
    let known = sqlx::query("SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = '_sqlx_migrations'");
    if known.fetch_optional(&mut *connection).await?.is_none() {
        return Ok(None);
    }
    let row =
        sqlx::query("SELECT max(version) AS version FROM _sqlx_migrations").fetch_one(connection).await?;
    Ok(row.try_get("version")?)
}

fn pool(connections: u32) -> SqlitePoolOptions {
    SqlitePoolOptions::new().max_connections(connections).acquire_timeout(ACQUIRE_TIMEOUT).after_release(
        |connection, _| {
            Box::pin(async move {
                // Waits for the rollback that a transaction sends when it is dropped.
                connection.ping().await?;
                // SQLite rolls back by itself on a full disk and on I/O errors. The rollback that follows then fails, and sqlx counts
                // the transaction as open for good: every later one on this connection would be refused.
                let is_usable = !connection.is_in_transaction();
                if !is_usable {
                    tracing::debug!(
                        "replacing a database connection whose last transaction did not end cleanly"
                    );
                }
                Ok(is_usable)
            })
        },
    )
}

/// The lock of the database at `path`, released when the file is closed.
async fn lock_beside(path: &Path) -> io::Result<File> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let path = PathBuf::from(name);
    let locked = tokio::task::spawn_blocking(move || {
        let file = File::options().create(true).truncate(false).write(true).open(&path)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                tracing::info!(path = %path.display(), "waiting for another process that is opening the database");
                file.lock()?;
            }
            Err(TryLockError::Error(fault)) => return Err(fault),
        }
        Ok(file)
    });
    locked.await.map_err(io::Error::other)?
}

/// A new database in a temporary folder.
#[cfg(test)]
pub(super) async fn temporary_store() -> (tempfile::TempDir, SqliteStore) {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(crate::domain::SystemClock);
    let store = SqliteStore::open(&folder.path().join("tcgs.sqlite"), clock, QueuePolicy::default()).await;
    (folder, store.expect("a database"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::SystemClock, store::Overview as _};

    async fn set_version(store: &SqliteStore, by: &str) {
        let update = format!(
            "UPDATE _sqlx_migrations SET version = version {by} WHERE version = (SELECT max(version) FROM _sqlx_migrations)"
        );
        sqlx::query(sqlx::AssertSqlSafe(update)).execute(&store.writer).await.expect("written");
    }

    #[tokio::test]
    async fn an_older_or_newer_schema_is_refused_with_advice() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.sqlite");
        let clock = || Arc::new(SystemClock);
        let open = || SqliteStore::open_current(&path, clock(), QueuePolicy::default());
        let store = open().await.expect("a new database gets its tables");
        assert!(store.schema_is_current().await.expect("an answer"));
        sqlx::query(
            "DELETE FROM _sqlx_migrations WHERE version = (SELECT max(version) FROM _sqlx_migrations)",
        )
        .execute(&store.writer)
        .await
        .expect("written");
        let fault = open().await.err().expect("refused").to_string();
        assert!(fault.contains("older") && fault.contains("tcgs migrate"), "{fault}");
        store.close().await;

        let path = folder.path().join("newer.sqlite");
        let store = SqliteStore::open(&path, clock(), QueuePolicy::default()).await.expect("opens");
        set_version(&store, "+ 1").await;
        for opened in [
            SqliteStore::open_current(&path, clock(), QueuePolicy::default()).await,
            SqliteStore::open(&path, clock(), QueuePolicy::default()).await,
        ] {
            let fault = opened.err().expect("refused").to_string();
            assert!(fault.contains("newer"), "{fault}");
        }
        store.close().await;
    }

    #[tokio::test]
    async fn a_connection_whose_transaction_sqlite_ended_by_itself_is_replaced() {
        let (_folder, store) = temporary_store().await;
        for _ in 0..3 {
            let mut tx = store.writer.begin_with("BEGIN IMMEDIATE").await.expect("a transaction");
            // As SQLite itself does on a full disk, behind sqlx.
            sqlx::raw_sql("ROLLBACK").execute(&mut *tx).await.expect("rolled back");
            drop(tx);
        }
        store.probe().await.expect("the next one begins");
    }

    /// As SQLite numbers `synchronous`: 0 is OFF, 1 NORMAL, 2 FULL.
    const FULL: i64 = 2;

    #[tokio::test]
    async fn every_connection_keeps_what_it_commits_through_a_power_cut() {
        let (_folder, store) = temporary_store().await;
        let (synchronous,): (i64,) =
            sqlx::query_as("PRAGMA synchronous").fetch_one(&store.writer).await.expect("an answer");
        assert_eq!(synchronous, FULL);
        let (journal,): (String,) =
            sqlx::query_as("PRAGMA journal_mode").fetch_one(&store.writer).await.expect("an answer");
        assert_eq!(journal, "wal");
    }
}
