//! [`Overview`] on SQLite.

use sqlx::{Row as _, SqliteConnection, migrate::Migrator};

use super::{SqliteStore, open::MIGRATIONS, rows};
use crate::{
    domain::{JobState, problem::TYPE_PREFIX},
    store::{AttemptCount, DeliveryState, Overview, StoreError, StoreFuture, StoreStats},
};

/// The phases of a job's `metrics.seconds`.
const PHASES: [&str; 4] = ["ingest", "train", "encode", "decode"];

const TOTALS: &str = "SELECT name, label, value FROM totals";
const COUNTERS: &str = "SELECT name, label, cause, value FROM counters ORDER BY name, label, cause";
const OLDEST_QUEUED: &str = "SELECT min(created_at) AS oldest FROM jobs WHERE state = 'queued'";
const SPEED: &str =
    "SELECT total(json_extract(progress, '$.steps_per_second')) AS speed FROM jobs WHERE state = 'running'";

/// What each scrape asks; it must not grow with what is stored.
#[cfg(test)]
pub(super) const STATEMENTS: [&str; 4] = [TOTALS, COUNTERS, OLDEST_QUEUED, SPEED];

impl Overview for SqliteStore {
    fn stats(&self) -> StoreFuture<'_, StoreStats> {
        Box::pin(async move {
            // One snapshot, so that the figures fit together.
            let mut tx = self.readers.begin().await?;
            let totals = totals(&mut tx).await?;
            let total = |name: &str, label: &str| {
                totals
                    .iter()
                    .find(|total| (&*total.name, &*total.label) == (name, label))
                    .map_or(0, |total| total.value)
            };
            let counters = counters(&mut tx).await?;
            let counted = |name| counters.iter().filter(move |counter| counter.name == name);
            Ok(StoreStats {
                jobs: JobState::ALL.map(|state| (state, total("jobs", state.name()))).to_vec(),
                oldest_queued_at: oldest_queued_at(&mut tx).await?,
                claims: counted("claims").map(|counter| whole(counter.value)).sum(),
                attempts: counted("attempts_ended").map(attempts_ended).collect::<Result<_, _>>()?,
                phase_seconds: PHASES
                    .map(|phase| {
                        let seconds = counted("phase_seconds").find(|counter| counter.label == phase);
                        (phase, seconds.map_or(0.0, |counter| counter.value))
                    })
                    .to_vec(),
                steps_per_second: steps_per_second(&mut tx).await?,
                blobs: total("blobs", ""),
                blob_bytes: total("blob_bytes", ""),
                deliveries: DeliveryState::ALL
                    .map(|state| (state, total("deliveries", state.name())))
                    .to_vec(),
            })
        })
    }

    fn schema_is_current(&self) -> StoreFuture<'_, bool> {
        Box::pin(async move { is_current(&mut *self.readers.acquire().await?, &MIGRATIONS).await })
    }

    fn probe(&self) -> StoreFuture<'_, ()> {
        Box::pin(async move {
            let (mut tx, now) = self.begin().await?;
            sqlx::query("INSERT INTO write_probe (id, at) VALUES (1, ?) ON CONFLICT (id) DO UPDATE SET at = excluded.at")
                .bind(rows::micros(now))
                .execute(&mut *tx)
                .await?;
            tx.commit().await?;
            Ok(())
        })
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

/// A row of `totals`.
struct Total {
    name: String,
    label: String,
    value: u64,
}

async fn totals(connection: &mut SqliteConnection) -> Result<Vec<Total>, StoreError> {
    let rows = sqlx::query(TOTALS).fetch_all(connection).await?;
    rows.iter()
        .map(|row| {
            let value = rows::unsigned(row, "value")?;
            Ok(Total { name: row.try_get("name")?, label: row.try_get("label")?, value })
        })
        .collect()
}

/// A row of `counters`.
struct Counter {
    name: String,
    label: String,
    cause: String,
    value: f64,
}

async fn counters(connection: &mut SqliteConnection) -> Result<Vec<Counter>, StoreError> {
    let rows = sqlx::query(COUNTERS).fetch_all(connection).await?;
    rows.iter()
        .map(|row| {
            Ok(Counter {
                name: row.try_get("name")?,
                label: row.try_get("label")?,
                cause: row.try_get("cause")?,
                value: row.try_get("value")?,
            })
        })
        .collect()
}

/// The value of a counter that counts by ones.
fn whole(value: f64) -> u64 {
    value as u64
}

fn attempts_ended(counter: &Counter) -> Result<AttemptCount, StoreError> {
    let cause = counter.cause.trim_start_matches(TYPE_PREFIX);
    Ok(AttemptCount {
        outcome: rows::outcome_named(&counter.label)?,
        cause: (!cause.is_empty()).then(|| cause.to_owned()),
        count: whole(counter.value),
    })
}

async fn oldest_queued_at(connection: &mut SqliteConnection) -> Result<Option<jiff::Timestamp>, StoreError> {
    let row = sqlx::query(OLDEST_QUEUED).fetch_one(connection).await?;
    rows::optional_instant(&row, "oldest")
}

async fn steps_per_second(connection: &mut SqliteConnection) -> Result<f64, StoreError> {
    Ok(sqlx::query(SPEED).fetch_one(connection).await?.try_get("speed")?)
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
