//! Opens the database, and migrates its schema if that is wanted.
//!
//! A process that opens a database holds a lock meanwhile: the lock file beside SQLite's, or an advisory lock of PostgreSQL's. So if several
//! processes open a new database at once, one creates its tables, and none sees a schema that is partly migrated.

use std::{
    fmt,
    fs::{File, TryLockError},
    io,
    path::{Path, PathBuf},
    str::FromStr,
    sync::{Arc, OnceLock},
    time::Duration,
};

use serde::Serialize;
use sqlx::{
    Connection as _,
    pool::PoolOptions,
    postgres::{PgConnectOptions, PgPoolOptions},
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous},
};
use thiserror::Error;
use url::Url;

use super::{
    Store, TimeSource,
    db::{Pool, Sql, query},
    migrations,
};
use crate::{
    domain::Clock,
    store::{QueuePolicy, StoreError},
};

const READERS: u32 = 4;
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);

/// Connections of a process to PostgreSQL at most; idle ones are closed.
const POSTGRES_CONNECTIONS: u32 = 8;
const POSTGRES_IDLE: Duration = Duration::from_secs(60);
/// How long a request waits for a connection, also while the server is not there.
const POSTGRES_TIMEOUT: Duration = Duration::from_secs(5);

/// What to do with a schema that is older than this program's. A new database gets its tables unless the schema is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OlderSchema {
    Migrate,
    Refuse,
    /// Neither migrate it nor make the tables of a new database.
    Keep,
}

/// Versions of a schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct SchemaChange {
    /// The version that was found; `None` if the database was new.
    pub from: Option<i64>,
    /// The version now, which is this program's.
    pub to: i64,
}

/// Where the database is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DatabaseLocation {
    /// SQLite in a file.
    File(PathBuf),
    /// A PostgreSQL server.
    Postgres(PostgresUrl),
}

impl From<&Path> for DatabaseLocation {
    fn from(path: &Path) -> Self {
        Self::File(path.to_owned())
    }
}

impl From<&PathBuf> for DatabaseLocation {
    fn from(path: &PathBuf) -> Self {
        Self::File(path.clone())
    }
}

impl From<&DatabaseLocation> for DatabaseLocation {
    fn from(location: &DatabaseLocation) -> Self {
        location.clone()
    }
}

impl fmt::Display for DatabaseLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => path.display().fmt(f),
            Self::Postgres(url) => url.fmt(f),
        }
    }
}

/// The address of a database of a PostgreSQL server: `postgres://USER:PASSWORD@HOST:PORT/DATABASE`.
///
/// What is left out comes from the variables that `psql` reads (`PGPASSWORD`, `PGSSLMODE` and so on) and from `~/.pgpass`. Neither
/// [`fmt::Display`] nor [`fmt::Debug`] shows a password.
#[derive(Clone, PartialEq, Eq)]
pub struct PostgresUrl {
    url: String,
    time: TimeSource,
}

/// Why a text is no address of a PostgreSQL database. It does not repeat the text, which may hold a password.
#[derive(Debug, Error)]
#[error("not the address of a PostgreSQL database, as in postgres://USER@HOST/DATABASE: {0}")]
pub struct InvalidDatabaseUrl(String);

impl FromStr for PostgresUrl {
    type Err = InvalidDatabaseUrl;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if !["postgres://", "postgresql://"].iter().any(|scheme| text.starts_with(scheme)) {
            return Err(InvalidDatabaseUrl("it does not begin with postgres://".into()));
        }
        check_parts(text)?;
        let options =
            PgConnectOptions::from_str(text).map_err(|error| InvalidDatabaseUrl(error.to_string()))?;
        if options.get_database().is_none() {
            return Err(InvalidDatabaseUrl("it names no database".into()));
        }
        Ok(Self { url: text.to_owned(), time: TimeSource::Database })
    }
}

/// Parameters that the driver knows; it would log the values of others, and go on without what they ask for.
const PARAMETERS: [&str; 17] = [
    "sslmode",
    "ssl-mode",
    "sslrootcert",
    "ssl-root-cert",
    "ssl-ca",
    "sslcert",
    "ssl-cert",
    "sslkey",
    "ssl-key",
    "statement-cache-capacity",
    "host",
    "hostaddr",
    "port",
    "dbname",
    "user",
    "password",
    "options",
];

/// Refuses what the driver would read otherwise than it is meant, so that no part of a password becomes part of a name that is shown.
fn check_parts(text: &str) -> Result<(), InvalidDatabaseUrl> {
    let error = |error: String| Err(InvalidDatabaseUrl(error));
    let Ok(url) = Url::parse(text) else { return Ok(()) };
    if url.path().contains('@')
        || url.query().is_some_and(|query| query.contains('@'))
        || url.fragment().is_some()
    {
        return error("write @, /, ? and # of a user's name or password as %40, %2F, %3F and %23".into());
    }
    match url.query_pairs().find(|(key, _)| !PARAMETERS.contains(&&**key)) {
        Some((key, _)) => error(format!("it has the unknown parameter {key}")),
        None => Ok(()),
    }
}

impl PostgresUrl {
    /// The same, with times of the store's clock instead of the database's, for tests.
    #[must_use]
    pub fn with_process_clock(self) -> Self {
        Self { time: TimeSource::Process, ..self }
    }

    /// The whole address, with a password if it has one.
    #[must_use]
    pub fn expose(&self) -> &str {
        &self.url
    }

    fn options(&self) -> Result<PgConnectOptions, sqlx::Error> {
        let options = PgConnectOptions::from_str(&self.url)?;
        Ok(options.application_name("tcgs").options([
            ("default_transaction_isolation", "read committed"),
            // A client that is gone in the middle of a transaction must not hold its locks for long.
            ("idle_in_transaction_session_timeout", "30s"),
            ("lock_timeout", "10s"),
            ("jit", "off"),
        ]))
    }
}

impl fmt::Display for PostgresUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Ok(options) = PgConnectOptions::from_str(&self.url) else { return f.write_str("postgres://") };
        let (user, database) = (options.get_username(), options.get_database().unwrap_or_default());
        match options.get_socket() {
            Some(socket) => write!(f, "postgres://{user}@{}/{database}", socket.display()),
            None => write!(f, "postgres://{user}@{}:{}/{database}", options.get_host(), options.get_port()),
        }
    }
}

impl fmt::Debug for PostgresUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PostgresUrl({self})")
    }
}

impl Store {
    /// Opens the database, creates SQLite's file if there is none, and migrates the schema.
    ///
    /// # Errors
    /// [`StoreError::Open`], [`StoreError::Migrate`] or [`StoreError::SchemaNewer`].
    pub async fn open(
        location: impl Into<DatabaseLocation>,
        clock: Arc<dyn Clock>,
        policy: QueuePolicy,
    ) -> Result<Self, StoreError> {
        Ok(open(&location.into(), clock, policy, OlderSchema::Migrate).await?.0)
    }

    /// Opens the database without migrating its schema; creates SQLite's file if there is none, and the tables of an empty database.
    ///
    /// # Errors
    /// [`StoreError::Open`], [`StoreError::Migrate`], [`StoreError::SchemaOlder`] or [`StoreError::SchemaNewer`].
    pub async fn open_current(
        location: impl Into<DatabaseLocation>,
        clock: Arc<dyn Clock>,
        policy: QueuePolicy,
    ) -> Result<Self, StoreError> {
        Ok(open(&location.into(), clock, policy, OlderSchema::Refuse).await?.0)
    }

    /// As [`Store::open`]; also returns the schema's versions before and after.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub async fn migrate(
        location: impl Into<DatabaseLocation>,
        clock: Arc<dyn Clock>,
        policy: QueuePolicy,
    ) -> Result<(Self, SchemaChange), StoreError> {
        let (store, from) = open(&location.into(), clock, policy, OlderSchema::Migrate).await?;
        let to = newest(&store.writer);
        Ok((store, SchemaChange { from, to }))
    }

    /// Whether the database has keys, valid or not. Its schema stays as it is, also if it is older or has no tables yet.
    ///
    /// # Errors
    /// [`StoreError::Open`] or [`StoreError::SchemaNewer`].
    pub async fn has_keys_in(
        location: impl Into<DatabaseLocation>,
        clock: Arc<dyn Clock>,
    ) -> Result<bool, StoreError> {
        let (store, _) = open(&location.into(), clock, QueuePolicy::default(), OlderSchema::Keep).await?;
        let has_keys = match has_table(&store.readers, "keys").await {
            Ok(true) => store.has_keys().await,
            Ok(false) => Ok(false),
            Err(error) => Err(error),
        };
        store.close().await;
        has_keys
    }
}

/// A store, and the version of the schema that was found; `None` if the database was new.
async fn open(
    location: &DatabaseLocation,
    clock: Arc<dyn Clock>,
    policy: QueuePolicy,
    older: OlderSchema,
) -> Result<(Store, Option<i64>), StoreError> {
    let (writer, readers, time, found) = match location {
        DatabaseLocation::File(path) => {
            let (writer, readers, found) = open_sqlite(path, location, older).await?;
            (writer, readers, TimeSource::Process, found)
        }
        DatabaseLocation::Postgres(url) => {
            let (pool, found) = open_postgres(url, location, older).await?;
            (pool.clone(), pool, url.time, found)
        }
    };
    let (leases, listener, faults) = (Arc::default(), Arc::new(OnceLock::new()), None);
    Ok((Store { writer, readers, clock, time, policy, leases, listener, faults }, found))
}

fn open_error(location: &DatabaseLocation) -> impl Fn(sqlx::Error) -> StoreError {
    move |source| StoreError::Open { path: location.to_string(), source }
}

async fn open_sqlite(
    path: &Path,
    location: &DatabaseLocation,
    older: OlderSchema,
) -> Result<(Pool, Pool, Option<i64>), StoreError> {
    let open_error = open_error(location);
    let _lock = lock_beside(path).await.map_err(|error| open_error(sqlx::Error::Io(error)))?;
    let options = SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .busy_timeout(BUSY_TIMEOUT)
        .foreign_keys(true);
    let writer = sqlite_writer().connect_with(options.clone()).await.map_err(&open_error)?;
    let found = migrate_or_close(location, &Pool::Sqlite(writer.clone()), older).await?;
    let readers = options.read_only(true).create_if_missing(false);
    let readers = sqlite_pool(READERS).connect_with(readers).await.map_err(&open_error)?;
    Ok((Pool::Sqlite(writer), Pool::Sqlite(readers), found))
}

async fn open_postgres(
    url: &PostgresUrl,
    location: &DatabaseLocation,
    older: OlderSchema,
) -> Result<(Pool, Option<i64>), StoreError> {
    let open_error = open_error(location);
    let pool: PoolOptions<_> = PgPoolOptions::new()
        .max_connections(POSTGRES_CONNECTIONS)
        .acquire_timeout(POSTGRES_TIMEOUT)
        .idle_timeout(POSTGRES_IDLE);
    let options = url.options().map_err(&open_error)?;
    let pool = Pool::Postgres(pool.connect_with(options).await.map_err(&open_error)?);
    let found = migrate_or_close(location, &pool, older).await?;
    Ok((pool, found))
}

async fn migrate_or_close(
    location: &DatabaseLocation,
    pool: &Pool,
    older: OlderSchema,
) -> Result<Option<i64>, StoreError> {
    let found = migrate_schema(location, pool, older).await;
    if found.is_err() {
        pool.close().await;
    }
    found
}

async fn migrate_schema(
    location: &DatabaseLocation,
    pool: &Pool,
    older: OlderSchema,
) -> Result<Option<i64>, StoreError> {
    let found = version(pool).await?;
    let needed = newest(pool);
    match found {
        Some(found) if found > needed => {
            return Err(StoreError::SchemaNewer { path: location.to_string(), found, needed });
        }
        Some(found) if found < needed && older == OlderSchema::Refuse => {
            return Err(StoreError::SchemaOlder { path: location.to_string(), found, needed });
        }
        _ if older == OlderSchema::Keep => return Ok(found),
        _ => {}
    }
    // Even if there is nothing to do: it compares the applied migrations with the known ones.
    match pool {
        Pool::Sqlite(pool) => migrations::SQLITE.run(pool).await?,
        Pool::Postgres(pool) => migrations::POSTGRES.run(pool).await?,
    }
    Ok(found)
}

/// The version of this program's schema for a database.
pub(super) fn newest(pool: &Pool) -> i64 {
    let migrations = match pool {
        Pool::Sqlite(_) => &migrations::SQLITE,
        Pool::Postgres(_) => &migrations::POSTGRES,
    };
    migrations.iter().map(|migration| migration.version).max().unwrap_or_default()
}

async fn has_table(pool: &Pool, name: &str) -> Result<bool, StoreError> {
    let known = query(Sql {
        sqlite: "SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = ?",
        postgres: "SELECT 1 FROM pg_class WHERE oid = to_regclass(?)",
    });
    Ok(known.bind(name).fetch_optional(pool).await?.is_some())
}

/// The version of the schema; `None` for a new database.
async fn version(pool: &Pool) -> Result<Option<i64>, StoreError> {
    if !has_table(pool, "_sqlx_migrations").await? {
        return Ok(None);
    }
    let row = query("SELECT max(version) AS version FROM _sqlx_migrations").fetch_one(pool).await?;
    Ok(row.try_get("version")?)
}

/// The pool of the connection that writes. Where SQLite cannot open the write-ahead log to write in, for a moment in which the disk refuses
/// that, it opens it to read and says nothing: such a connection would refuse every transaction for good, so none comes into use.
fn sqlite_writer() -> SqlitePoolOptions {
    sqlite_pool(1).after_connect(|connection, _| {
        Box::pin(async move { connection.begin_with("BEGIN IMMEDIATE").await?.rollback().await })
    })
}

fn sqlite_pool(connections: u32) -> SqlitePoolOptions {
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
            Err(TryLockError::Error(error)) => return Err(error),
        }
        Ok(file)
    });
    locked.await.map_err(io::Error::other)?
}

/// A new database in a temporary folder.
#[cfg(test)]
pub(super) async fn temporary_store() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().expect("a folder");
    let clock = Arc::new(crate::domain::SystemClock);
    let store = Store::open(&folder.path().join("tcgs.sqlite"), clock, QueuePolicy::default()).await;
    (folder, store.expect("a database"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::{Scope, SystemClock, SystemRandom},
        store::{KeyRequest, NewKey},
    };

    fn sqlite(store: &Store) -> &sqlx::SqlitePool {
        let Pool::Sqlite(pool) = &store.writer else { panic!("SQLite") };
        pool
    }

    async fn set_version(store: &Store, by: &str) {
        let update = format!(
            "UPDATE _sqlx_migrations SET version = version {by} WHERE version = (SELECT max(version) FROM _sqlx_migrations)"
        );
        sqlx::query(sqlx::AssertSqlSafe(update)).execute(sqlite(store)).await.expect("written");
    }

    async fn forget_newest_version(store: &Store) {
        sqlx::query(
            "DELETE FROM _sqlx_migrations WHERE version = (SELECT max(version) FROM _sqlx_migrations)",
        )
        .execute(sqlite(store))
        .await
        .expect("written");
    }

    #[tokio::test]
    async fn an_older_or_newer_schema_is_refused_with_advice() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.sqlite");
        let clock = || Arc::new(SystemClock);
        let open = || Store::open_current(&path, clock(), QueuePolicy::default());
        let store = open().await.expect("a new database gets its tables");
        assert!(store.schema_is_current().await.expect("an answer"));
        forget_newest_version(&store).await;
        let error = open().await.err().expect("refused").to_string();
        assert!(error.contains("older") && error.contains("tcgs migrate"), "{error}");
        store.close().await;

        let path = folder.path().join("newer.sqlite");
        let store = Store::open(&path, clock(), QueuePolicy::default()).await.expect("opens");
        set_version(&store, "+ 1").await;
        for opened in [
            Store::open_current(&path, clock(), QueuePolicy::default()).await,
            Store::open(&path, clock(), QueuePolicy::default()).await,
        ] {
            let error = opened.err().expect("refused").to_string();
            assert!(error.contains("newer"), "{error}");
        }
        store.close().await;
    }

    #[tokio::test]
    async fn whether_there_are_keys_is_read_without_changing_the_schema() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.sqlite");
        let clock = || Arc::new(SystemClock);
        let has_keys = || Store::has_keys_in(&path, clock());
        let open = || Store::open(&path, clock(), QueuePolicy::default());
        assert!(!has_keys().await.expect("an answer"));
        assert!(!has_keys().await.expect("an answer"), "it has made no tables");
        let (store, change) =
            Store::migrate(&path, clock(), QueuePolicy::default()).await.expect("a new database");
        assert_eq!(change, SchemaChange { from: None, to: newest(&store.writer) });
        store.close().await;
        assert!(!has_keys().await.expect("an answer"));

        let store = open().await.expect("opens");
        let request = KeyRequest { name: "a key", scopes: &[Scope::Read], ..KeyRequest::default() };
        let (key, _) = NewKey::generate(&SystemRandom, SystemClock.now(), request).expect("a key");
        let key = store.create_key(key).await.expect("made");
        store.revoke_key(key.id).await.expect("revoked");
        assert!(has_keys().await.expect("an answer"), "it counts although it is revoked");
        forget_newest_version(&store).await;
        let old = version(&store.readers).await.expect("read");
        assert!(has_keys().await.expect("an answer"));
        assert_eq!(version(&store.readers).await.expect("read"), old);
        store.close().await;
    }

    #[tokio::test]
    async fn a_connection_whose_transaction_sqlite_ended_by_itself_is_replaced() {
        let (_folder, store) = temporary_store().await;
        for _ in 0..3 {
            let mut tx = sqlite(&store).begin_with("BEGIN IMMEDIATE").await.expect("a transaction");
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
            sqlx::query_as("PRAGMA synchronous").fetch_one(sqlite(&store)).await.expect("an answer");
        assert_eq!(synchronous, FULL);
        let (journal,): (String,) =
            sqlx::query_as("PRAGMA journal_mode").fetch_one(sqlite(&store)).await.expect("an answer");
        assert_eq!(journal, "wal");
    }

    #[test]
    fn an_address_is_checked_and_its_password_is_not_shown() {
        let url: PostgresUrl = "postgres://ann:s3cret@db.example:6432/tcgs".parse().expect("an address");
        assert_eq!(url.to_string(), "postgres://ann@db.example:6432/tcgs");
        assert!(!format!("{url:?}").contains("s3cret") && url.expose().contains("s3cret"));
        let socket: PostgresUrl = "postgres://ann@%2Frun%2Fpg/tcgs".parse().expect("an address");
        assert_eq!(socket.to_string(), "postgres://ann@/run/pg/tcgs");
        for wrong in [
            "mysql://ann:s3cret@host/x",
            "tcgs.sqlite",
            "postgres://ann:s3cret@host",
            "postgres://ann:s3cret@host:port/x",
            "postgres://ann:p/s3cret@host/x",
            "postgres://ann:1/s3cret@host/x",
            "postgres://ann:1?s3cret@host/x",
            "postgres://ann:1#s3cret@host/x",
            "postgres://ann@host/x?passwd=s3cret",
        ] {
            let error = wrong.parse::<PostgresUrl>().expect_err(wrong).to_string();
            assert!(error.contains("postgres://USER@HOST/DATABASE") && !error.contains("s3cret"), "{error}");
        }
    }
}
