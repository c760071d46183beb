//! What a query runs on: a pool or a transaction of either database.

use std::{future::Future, io, time::Duration};

use sqlx::{PgPool, Postgres, Sqlite, SqlitePool};
use tokio::time::timeout;

use super::{Query, Row};
use crate::store::StoreError;

/// Longest wait for PostgreSQL's answer. More than it waits for a lock (`lock_timeout`); a machine that is cut off never answers.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);

/// Begins a transaction of PostgreSQL to read in.
const ONE_SNAPSHOT: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY";

/// PostgreSQL's answer, if it comes in time.
async fn answered<T>(answer: impl Future<Output = Result<T, sqlx::Error>>) -> Result<T, sqlx::Error> {
    answered_within(ANSWER_TIMEOUT, answer).await
}

async fn answered_within<T>(
    limit: Duration,
    answer: impl Future<Output = Result<T, sqlx::Error>>,
) -> Result<T, sqlx::Error> {
    match timeout(limit, answer).await {
        Ok(answer) => answer,
        Err(late) => Err(sqlx::Error::Io(io::Error::new(io::ErrorKind::TimedOut, late))),
    }
}

/// Connections to a database.
#[derive(Debug, Clone)]
pub(in crate::store) enum Pool {
    Sqlite(SqlitePool),
    /// PostgreSQL.
    Postgres(PgPool),
}

/// A transaction. Dropping it rolls it back.
pub(in crate::store) enum Transaction {
    /// SQLite's.
    Sqlite(sqlx::Transaction<'static, Sqlite>),
    /// PostgreSQL's.
    Postgres(sqlx::Transaction<'static, Postgres>),
}

impl Pool {
    /// A transaction to read in, on one snapshot.
    pub(in crate::store) async fn begin(&self) -> Result<Transaction, sqlx::Error> {
        Ok(match self {
            Self::Sqlite(pool) => Transaction::Sqlite(pool.begin().await?),
            Self::Postgres(pool) => Transaction::Postgres(answered(pool.begin_with(ONE_SNAPSHOT)).await?),
        })
    }

    /// A transaction to write in. On SQLite it holds the write lock, so it never has to turn from reader into writer.
    pub(in crate::store) async fn begin_write(&self) -> Result<Transaction, sqlx::Error> {
        Ok(match self {
            Self::Sqlite(pool) => Transaction::Sqlite(pool.begin_with("BEGIN IMMEDIATE").await?),
            Self::Postgres(pool) => Transaction::Postgres(answered(pool.begin()).await?),
        })
    }

    /// Closes every connection.
    pub(in crate::store) async fn close(&self) {
        match self {
            Self::Sqlite(pool) => pool.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
    }
}

impl Transaction {
    /// Makes its changes last.
    pub(in crate::store) async fn commit(self) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(tx) => tx.commit().await,
            Self::Postgres(tx) => answered(tx.commit()).await,
        }
    }

    /// Whether it is PostgreSQL's, where others write at the same time.
    pub(in crate::store) fn is_postgres(&self) -> bool {
        matches!(self, Self::Postgres(_))
    }
}

/// Where a query runs.
pub(in crate::store) enum Target<'a> {
    /// On a connection of its own.
    Pool(&'a Pool),
    Transaction(&'a mut Transaction),
}

impl<'a> From<&'a Pool> for Target<'a> {
    fn from(pool: &'a Pool) -> Self {
        Self::Pool(pool)
    }
}

impl<'a> From<&'a mut Transaction> for Target<'a> {
    fn from(tx: &'a mut Transaction) -> Self {
        Self::Transaction(tx)
    }
}

impl Query {
    /// Every row of the answer.
    pub(in crate::store) async fn fetch_all(
        self,
        on: impl Into<Target<'_>>,
    ) -> Result<Vec<Row>, sqlx::Error> {
        on.into().rows(self).await
    }

    /// The first row of the answer, if it has one.
    pub(in crate::store) async fn fetch_optional(
        self,
        on: impl Into<Target<'_>>,
    ) -> Result<Option<Row>, sqlx::Error> {
        Ok(on.into().rows(self).await?.into_iter().next())
    }

    /// The first row of the answer, which must have one.
    pub(in crate::store) async fn fetch_one(self, on: impl Into<Target<'_>>) -> Result<Row, sqlx::Error> {
        self.fetch_optional(on).await?.ok_or(sqlx::Error::RowNotFound)
    }

    /// Every row of the answer, as `read` reads it.
    pub(in crate::store) async fn all<T>(
        self,
        on: impl Into<Target<'_>>,
        read: impl Fn(&Row) -> Result<T, StoreError>,
    ) -> Result<Vec<T>, StoreError> {
        self.fetch_all(on).await?.iter().map(read).collect()
    }

    /// The first row of the answer as `read` reads it, if it has one.
    pub(in crate::store) async fn optional<T>(
        self,
        on: impl Into<Target<'_>>,
        read: impl Fn(&Row) -> Result<T, StoreError>,
    ) -> Result<Option<T>, StoreError> {
        self.fetch_optional(on).await?.as_ref().map(read).transpose()
    }

    /// Runs the statement.
    pub(in crate::store) async fn run(self, on: impl Into<Target<'_>>) -> Result<(), StoreError> {
        self.execute(on).await?;
        Ok(())
    }

    /// Runs the statement, and returns how many rows it changed.
    pub(in crate::store) async fn execute(self, on: impl Into<Target<'_>>) -> Result<u64, sqlx::Error> {
        on.into().changed(self).await
    }
}

impl Target<'_> {
    /// Every row of the query's answer.
    async fn rows(self, query: Query) -> Result<Vec<Row>, sqlx::Error> {
        Ok(match self {
            Self::Pool(Pool::Sqlite(pool)) => sqlite(query.sqlite().fetch_all(pool).await?),
            Self::Pool(Pool::Postgres(pool)) => postgres(answered(query.postgres().fetch_all(pool)).await?),
            Self::Transaction(Transaction::Sqlite(tx)) => sqlite(query.sqlite().fetch_all(&mut **tx).await?),
            Self::Transaction(Transaction::Postgres(tx)) => {
                postgres(answered(query.postgres().fetch_all(&mut **tx)).await?)
            }
        })
    }

    /// How many rows the query changed.
    async fn changed(self, query: Query) -> Result<u64, sqlx::Error> {
        Ok(match self {
            Self::Pool(Pool::Sqlite(pool)) => query.sqlite().execute(pool).await?.rows_affected(),
            Self::Pool(Pool::Postgres(pool)) => {
                answered(query.postgres().execute(pool)).await?.rows_affected()
            }
            Self::Transaction(Transaction::Sqlite(tx)) => {
                query.sqlite().execute(&mut **tx).await?.rows_affected()
            }
            Self::Transaction(Transaction::Postgres(tx)) => {
                answered(query.postgres().execute(&mut **tx)).await?.rows_affected()
            }
        })
    }
}

fn sqlite(rows: Vec<sqlx::sqlite::SqliteRow>) -> Vec<Row> {
    rows.into_iter().map(Row::Sqlite).collect()
}

fn postgres(rows: Vec<sqlx::postgres::PgRow>) -> Vec<Row> {
    rows.into_iter().map(Row::Postgres).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_server_that_never_answers_is_given_up() {
        let answer = std::future::pending::<Result<(), _>>();
        let error = answered_within(Duration::from_millis(1), answer).await.expect_err("no answer");
        assert!(StoreError::from(error).is_transient());
    }
}
