//! [`Overview`] on SQLite.

use std::collections::BTreeMap;

use sqlx::{Row as _, SqliteConnection, migrate::Migrator};

use super::{SqliteStore, rows};
use crate::{
    domain::{JobState, problem::TYPE_PREFIX},
    store::{Answer, AttemptCount, DeliveryState, Figures, Overview, StoreError},
};

/// The phases of a job's `metrics.seconds`.
const PHASES: [&str; 4] = ["ingest", "train", "encode", "decode"];

impl Overview for SqliteStore {
    fn figures(&self) -> Answer<'_, Figures> {
        Box::pin(async move {
            // One snapshot, so that the figures fit together.
            let mut tx = self.readers.begin().await?;
            let blobs = sqlx::query("SELECT count(*) AS count, coalesce(sum(bytes), 0) AS bytes FROM blobs")
                .fetch_one(&mut *tx)
                .await?;
            let attempts = attempts(&mut tx).await?;
            Ok(Figures {
                jobs: jobs(&mut tx).await?,
                oldest_queued_at: oldest_queued_at(&mut tx).await?,
                claims: count(&mut tx, "SELECT count(*) AS count FROM attempts").await?,
                attempts,
                phase_seconds: phase_seconds(&mut tx).await?,
                steps_per_second: steps_per_second(&mut tx).await?,
                blobs: rows::unsigned(&blobs, "count")?,
                blob_bytes: rows::unsigned(&blobs, "bytes")?,
                deliveries: deliveries(&mut tx).await?,
            })
        })
    }

    fn schema_is_current(&self) -> Answer<'_, bool> {
        Box::pin(async move { is_current(&mut *self.readers.acquire().await?, &super::MIGRATIONS).await })
    }
}

async fn is_current(connection: &mut SqliteConnection, known: &Migrator) -> Result<bool, StoreError> {
    let row = sqlx::query("SELECT max(version) AS version, min(success) AS success FROM _sqlx_migrations")
        .fetch_one(connection)
        .await?;
    let newest = known.iter().map(|migration| migration.version).max();
    let version: Option<i64> = row.try_get("version")?;
    Ok(version == newest && row.try_get::<Option<bool>, _>("success")? != Some(false))
}

async fn count(connection: &mut SqliteConnection, query: &'static str) -> Result<u64, StoreError> {
    rows::unsigned(&sqlx::query(query).fetch_one(connection).await?, "count")
}

async fn jobs(connection: &mut SqliteConnection) -> Result<Vec<(JobState, u64)>, StoreError> {
    let found = by_state(connection, "SELECT state, count(*) AS count FROM jobs GROUP BY state").await?;
    let of = |name| found.get(name).copied().unwrap_or(0);
    Ok(JobState::ALL.map(|state| (state, of(state.name()))).to_vec())
}

async fn deliveries(connection: &mut SqliteConnection) -> Result<Vec<(DeliveryState, u64)>, StoreError> {
    let query = "SELECT state, count(*) AS count FROM webhook_deliveries GROUP BY state";
    let found = by_state(connection, query).await?;
    let of = |name| found.get(name).copied().unwrap_or(0);
    Ok(DeliveryState::ALL.map(|state| (state, of(state.name()))).to_vec())
}

async fn by_state(
    connection: &mut SqliteConnection,
    query: &'static str,
) -> Result<BTreeMap<String, u64>, StoreError> {
    let rows = sqlx::query(query).fetch_all(connection).await?;
    rows.iter().map(|row| Ok((row.try_get("state")?, rows::unsigned(row, "count")?))).collect()
}

async fn oldest_queued_at(connection: &mut SqliteConnection) -> Result<Option<jiff::Timestamp>, StoreError> {
    let row = sqlx::query("SELECT min(created_at) AS oldest FROM jobs WHERE state = 'queued'")
        .fetch_one(connection)
        .await?;
    rows::optional_instant(&row, "oldest")
}

async fn attempts(connection: &mut SqliteConnection) -> Result<Vec<AttemptCount>, StoreError> {
    let rows = sqlx::query(
        "SELECT outcome, json_extract(cause, '$.type') AS cause, count(*) AS count FROM attempts
         WHERE outcome IS NOT NULL GROUP BY 1, 2 ORDER BY 1, 2",
    )
    .fetch_all(connection)
    .await?;
    rows.iter()
        .map(|row| {
            let cause: Option<String> = row.try_get("cause")?;
            let cause = cause.map(|kind| kind.trim_start_matches(TYPE_PREFIX).to_owned());
            Ok(AttemptCount { outcome: rows::outcome(row)?, cause, count: rows::unsigned(row, "count")? })
        })
        .collect()
}

async fn phase_seconds(connection: &mut SqliteConnection) -> Result<Vec<(&'static str, f64)>, StoreError> {
    let row = sqlx::query(
        "SELECT total(json_extract(metrics, '$.seconds.ingest')) AS ingest,
             total(json_extract(metrics, '$.seconds.train')) AS train,
             total(json_extract(metrics, '$.seconds.encode')) AS encode,
             total(json_extract(metrics, '$.seconds.decode')) AS decode
         FROM jobs WHERE metrics IS NOT NULL",
    )
    .fetch_one(connection)
    .await?;
    PHASES.into_iter().map(|phase| Ok((phase, row.try_get(phase)?))).collect()
}

async fn steps_per_second(connection: &mut SqliteConnection) -> Result<f64, StoreError> {
    let row = sqlx::query(
        "SELECT total(json_extract(progress, '$.steps_per_second')) AS speed FROM jobs WHERE state = 'running'",
    )
    .fetch_one(connection)
    .await?;
    Ok(row.try_get("speed")?)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{domain::SystemClock, store::QueuePolicy};

    #[tokio::test]
    async fn a_database_that_a_newer_program_has_brought_further_is_not_current() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("queue.sqlite");
        let store = SqliteStore::open(&path, Arc::new(SystemClock), QueuePolicy::default()).await;
        let store = store.expect("a database");
        assert!(store.schema_is_current().await.expect("an answer"));
        sqlx::query("UPDATE _sqlx_migrations SET version = version + 1 WHERE version = (SELECT max(version) FROM _sqlx_migrations)")
            .execute(&store.writer)
            .await
            .expect("written");
        assert!(!store.schema_is_current().await.expect("an answer"));
    }
}
