//! Statistics in SQLite.

use sqlx::{FromRow, Row as _, SqliteConnection, migrate::Migrator};

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

/// Queries of each metrics scrape; their cost must not grow with the number of rows.
#[cfg(test)]
pub(super) const STATEMENTS: [&str; 4] = [TOTALS, COUNTERS, OLDEST_QUEUED, SPEED];

impl Overview for SqliteStore {
    fn stats(&self) -> StoreFuture<'_, StoreStats> {
        Box::pin(self.read(async move |tx| {
            let totals: Vec<Total> = sqlx::query_as(TOTALS).fetch_all(&mut *tx).await?;
            let total = |name: &str, label: &str| {
                totals
                    .iter()
                    .find(|total| (&*total.name, &*total.label) == (name, label))
                    .map_or(0, |total| total.value)
            };
            let counters: Vec<Counter> = sqlx::query_as(COUNTERS).fetch_all(&mut *tx).await?;
            let oldest = sqlx::query(OLDEST_QUEUED).fetch_one(&mut *tx).await?;
            let counted = |name| counters.iter().filter(move |counter| counter.name == name);
            Ok(StoreStats {
                jobs: JobState::ALL.map(|state| (state, total("jobs", state.name()))).to_vec(),
                oldest_queued_at: rows::optional_instant(&oldest, "oldest")?,
                claims: counted("claims").map(|counter| whole(counter.value)).sum(),
                attempts: counted("attempts_ended").map(attempts_ended).collect::<Result<_, _>>()?,
                phase_seconds: PHASES
                    .map(|phase| {
                        let seconds = counted("phase_seconds").find(|counter| counter.label == phase);
                        (phase, seconds.map_or(0.0, |counter| counter.value))
                    })
                    .to_vec(),
                steps_per_second: sqlx::query(SPEED).fetch_one(tx).await?.try_get("speed")?,
                blobs: total("blobs", ""),
                blob_bytes: total("blob_bytes", ""),
                deliveries: DeliveryState::ALL
                    .map(|state| (state, total("deliveries", state.name())))
                    .to_vec(),
            })
        }))
    }

    fn schema_is_current(&self) -> StoreFuture<'_, bool> {
        Box::pin(async move { is_current(&mut *self.readers.acquire().await?, &MIGRATIONS).await })
    }

    fn probe(&self) -> StoreFuture<'_, ()> {
        Box::pin(self.write(async move |tx, now| {
            sqlx::query("INSERT INTO write_probe (id, at) VALUES (1, ?) ON CONFLICT (id) DO UPDATE SET at = excluded.at")
                .bind(rows::micros(now))
                .execute(tx)
                .await?;
            Ok(())
        }))
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

#[derive(FromRow)]
struct Total {
    name: String,
    label: String,
    #[sqlx(try_from = "i64")]
    value: u64,
}

#[derive(FromRow)]
struct Counter {
    name: String,
    label: String,
    cause: String,
    value: f64,
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sqlite::open::temporary_store;

    #[tokio::test]
    async fn a_schema_migrated_by_a_newer_program_is_not_current() {
        let (_folder, store) = temporary_store().await;
        assert!(store.schema_is_current().await.expect("an answer"));
        sqlx::query("UPDATE _sqlx_migrations SET version = version + 1 WHERE version = (SELECT max(version) FROM _sqlx_migrations)")
            .execute(&store.writer)
            .await
            .expect("written");
        assert!(!store.schema_is_current().await.expect("an answer"));
    }
}
