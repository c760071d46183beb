//! Databases for tests of the store: files of SQLite, and databases of a PostgreSQL server that the tests start for themselves.

use std::{path::PathBuf, sync::Arc};

use sqlx::{Connection as _, PgConnection, Row as _, SqliteConnection};
use tcgs::{
    domain::Clock,
    store::{DATABASE, DatabaseLocation, QueuePolicy, Store},
};
use tempfile::TempDir;

use super::postgres::{Cluster, PostgresDatabase};

/// A database of its own for one test, gone with it.
pub enum Database {
    /// SQLite in a folder.
    Sqlite(TempDir),
    /// SQLite in the data folder of a service.
    DataFolder(PathBuf),
    /// A database of the server of this process.
    Postgres(PostgresDatabase),
}

impl Database {
    /// SQLite.
    pub fn sqlite() -> Self {
        Self::Sqlite(tempfile::tempdir().expect("a folder"))
    }

    /// The database that tests of the module with this path are for: PostgreSQL in a module `postgres`, else SQLite. Says that the test is
    /// skipped, and returns `None`, where there is no PostgreSQL.
    pub async fn for_module(path: &str) -> Option<Self> {
        if !path.split("::").any(|part| part == "postgres") {
            return Some(Self::sqlite());
        }
        Some(Self::Postgres(Cluster::shared()?.database().await))
    }

    /// Where it is.
    pub fn location(&self) -> DatabaseLocation {
        match self {
            Self::Sqlite(_) | Self::DataFolder(_) => DatabaseLocation::File(self.file()),
            Self::Postgres(database) => DatabaseLocation::Postgres(database.url().with_process_clock()),
        }
    }

    /// A store over it, as another process would open it.
    pub async fn open(&self, clock: Arc<dyn Clock>, policy: QueuePolicy) -> Store {
        Store::open(self.location(), clock, policy).await.expect("a database")
    }

    /// Whether it is PostgreSQL.
    pub fn is_postgres(&self) -> bool {
        matches!(self, Self::Postgres(_))
    }

    /// Runs a statement that changes rows.
    pub async fn run(&self, statement: &str) {
        let statement = sqlx::AssertSqlSafe(statement.to_owned());
        match self {
            Self::Sqlite(_) | Self::DataFolder(_) => {
                sqlx::query(statement).execute(&mut sqlite(self.file()).await).await.expect("changed");
            }
            Self::Postgres(database) => {
                sqlx::query(statement).execute(&mut postgres(database).await).await.expect("changed");
            }
        }
    }

    /// Rows with the first `columns` columns of a query, each an integer or a text.
    pub async fn rows(&self, statement: &str, columns: usize) -> Vec<Vec<String>> {
        let statement = sqlx::AssertSqlSafe(statement.to_owned());
        match self {
            Self::Sqlite(_) | Self::DataFolder(_) => {
                let rows =
                    sqlx::query(statement).fetch_all(&mut sqlite(self.file()).await).await.expect("read");
                let cell = |row: &sqlx::sqlite::SqliteRow, at: usize| {
                    row.try_get::<i64, _>(at).map_or_else(|_| row.get(at), |number| number.to_string())
                };
                rows.iter().map(|row| (0..columns).map(|at| cell(row, at)).collect()).collect()
            }
            Self::Postgres(database) => {
                let rows =
                    sqlx::query(statement).fetch_all(&mut postgres(database).await).await.expect("read");
                let cell = |row: &sqlx::postgres::PgRow, at: usize| {
                    row.try_get::<i64, _>(at).map_or_else(|_| row.get(at), |number| number.to_string())
                };
                rows.iter().map(|row| (0..columns).map(|at| cell(row, at)).collect()).collect()
            }
        }
    }

    /// SQLite's file.
    fn file(&self) -> PathBuf {
        match self {
            Self::Sqlite(folder) => folder.path().join("tcgs.db"),
            Self::DataFolder(folder) => folder.join(DATABASE),
            Self::Postgres(_) => panic!("PostgreSQL is no file"),
        }
    }

    /// The only integer of a query.
    pub async fn number(&self, statement: &str) -> i64 {
        self.rows(statement, 1).await[0][0].parse().expect("a number")
    }
}

async fn sqlite(file: PathBuf) -> SqliteConnection {
    SqliteConnection::connect(&format!("sqlite://{}", file.display())).await.expect("a connection")
}

async fn postgres(database: &PostgresDatabase) -> PgConnection {
    PgConnection::connect(database.url().expose()).await.expect("a connection")
}
