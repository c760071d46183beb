//! Statistics.

use super::{
    Store,
    db::{Pool, Row, Sql, query},
    open::newest,
    rows,
};
use crate::{
    domain::{JobState, problem::TYPE_PREFIX},
    store::{AttemptCount, DeliveryState, StoreError, StoreFuture, StoreStats},
};

/// The phases of a job's `metrics.seconds`.
const PHASES: [&str; 4] = ["ingest", "train", "encode", "decode"];

/// On PostgreSQL, transactions add rows of changes instead of locking the totals of all; see [`FOLD`].
const TOTALS: Sql = Sql {
    sqlite: "SELECT name, label, value FROM totals",
    postgres: "
    SELECT 'jobs' AS name, states.label, CAST(SUM(states.value) AS bigint) AS value
    FROM project_totals CROSS JOIN LATERAL (VALUES
        ('queued', queued_jobs), ('running', running_jobs), ('succeeded', succeeded_jobs), ('failed', failed_jobs),
        ('cancelled', cancelled_jobs)) AS states (label, value)
    GROUP BY states.label
    UNION ALL
    SELECT name, label, CAST(SUM(value) AS bigint) FROM (
        SELECT name, label, value FROM totals UNION ALL SELECT name, label, value FROM total_changes) AS both_of_them
    GROUP BY name, label",
};
const COUNTERS: Sql = Sql {
    sqlite: "SELECT name, label, cause, value FROM counters ORDER BY name, label, cause",
    postgres: "
    SELECT name, label, cause, SUM(value) AS value FROM (
        SELECT name, label, cause, value FROM counters
        UNION ALL SELECT name, label, cause, value FROM counter_changes) AS both_of_them
    GROUP BY name, label, cause ORDER BY name, label, cause",
};
/// Adds the rows of changes to the totals and counters that they change, so that they stay few.
const FOLD: &str = "SELECT fold_changes()";
const OLDEST_QUEUED: &str = "SELECT min(created_at) AS oldest FROM jobs WHERE state = 'queued'";
const SPEED: Sql = Sql {
    sqlite: "SELECT total(json_extract(progress, '$.steps_per_second')) AS speed FROM jobs WHERE state = 'running'",
    postgres: "SELECT COALESCE(SUM(CAST(CAST(progress AS jsonb) ->> 'steps_per_second' AS double precision)), 0) AS speed
        FROM jobs WHERE state = 'running'",
};

/// Queries of each metrics scrape; their cost must not grow with the number of rows.
#[cfg(test)]
pub(super) const STATEMENTS: [Sql; 4] =
    [TOTALS, COUNTERS, Sql { sqlite: OLDEST_QUEUED, postgres: OLDEST_QUEUED }, SPEED];

impl Store {
    /// Current statistics.
    pub fn stats(&self) -> StoreFuture<'_, StoreStats> {
        self.call("stats").run(self.read(async move |tx| {
            let totals = query(TOTALS).all(&mut *tx, Total::read).await?;
            let total = |name: &str, label: &str| {
                totals
                    .iter()
                    .find(|total| (&*total.name, &*total.label) == (name, label))
                    .map_or(0, |total| total.value)
            };
            let counters = query(COUNTERS).all(&mut *tx, Counter::read).await?;
            let oldest = query(OLDEST_QUEUED).fetch_one(&mut *tx).await?;
            let counted = |name| counters.iter().filter(move |counter| counter.name == name);
            Ok(StoreStats {
                jobs: JobState::ALL.map(|state| (state, total("jobs", state.name()))).to_vec(),
                oldest_queued_at: rows::optional_instant(&oldest, "oldest")?,
                claims: counted("claims").map(|counter| integer(counter.value)).sum(),
                attempts: counted("attempts_ended").map(attempts_ended).collect::<Result<_, _>>()?,
                phase_seconds: PHASES
                    .map(|phase| {
                        let seconds = counted("phase_seconds").find(|counter| counter.label == phase);
                        (phase, seconds.map_or(0.0, |counter| counter.value))
                    })
                    .to_vec(),
                steps_per_second: query(SPEED).fetch_one(tx).await?.try_get("speed")?,
                blobs: total("blobs", ""),
                blob_bytes: total("blob_bytes", ""),
                deliveries: DeliveryState::ALL
                    .map(|state| (state, total("deliveries", state.name())))
                    .to_vec(),
            })
        }))
    }

    /// Whether the schema is the one that this program was built with; another program may have migrated it since.
    pub fn schema_is_current(&self) -> StoreFuture<'_, bool> {
        self.call("schema_is_current").run(async move { is_current(&self.readers).await })
    }

    /// Commits a small change, to check that the database can be written.
    pub fn probe(&self) -> StoreFuture<'_, ()> {
        self.call("probe").run(self.write(async move |tx, now| {
            query("INSERT INTO write_probe (id, at) VALUES (1, ?) ON CONFLICT (id) DO UPDATE SET at = excluded.at")
                .bind(rows::micros(now))
                .run(tx)
                .await
        }))
    }
}

impl Store {
    /// Keeps the rows of changes few on PostgreSQL.
    pub(super) async fn fold_changes(&self) -> Result<(), StoreError> {
        if matches!(self.writer, Pool::Postgres(_)) {
            query(FOLD).execute(&self.writer).await?;
        }
        Ok(())
    }
}

async fn is_current(pool: &Pool) -> Result<bool, StoreError> {
    let row = query(Sql {
        sqlite: "SELECT max(version) AS version, min(success) AS success FROM _sqlx_migrations",
        postgres: "SELECT max(version) AS version, bool_and(success) AS success FROM _sqlx_migrations",
    });
    let row = row.fetch_one(pool).await?;
    let version: Option<i64> = row.try_get("version")?;
    Ok(version == Some(newest(pool)) && row.try_get::<Option<bool>>("success")? != Some(false))
}

struct Total {
    name: String,
    label: String,
    value: u64,
}

impl Total {
    fn read(row: &Row) -> Result<Self, StoreError> {
        Ok(Self {
            name: row.try_get("name")?,
            label: row.try_get("label")?,
            value: rows::integer(row, "value")?,
        })
    }
}

struct Counter {
    name: String,
    label: String,
    cause: String,
    value: f64,
}

impl Counter {
    fn read(row: &Row) -> Result<Self, StoreError> {
        Ok(Self {
            name: row.try_get("name")?,
            label: row.try_get("label")?,
            cause: row.try_get("cause")?,
            value: row.try_get("value")?,
        })
    }
}

/// The value of a counter that counts by ones.
fn integer(value: f64) -> u64 {
    value as u64
}

fn attempts_ended(counter: &Counter) -> Result<AttemptCount, StoreError> {
    let cause = counter.cause.trim_start_matches(TYPE_PREFIX);
    Ok(AttemptCount {
        outcome: rows::parsed("outcome", &counter.label)?,
        cause: (!cause.is_empty()).then(|| cause.to_owned()),
        count: integer(counter.value),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sql::open::temporary_store;

    #[tokio::test]
    async fn a_schema_migrated_by_a_newer_program_is_not_current() {
        let (_folder, store) = temporary_store().await;
        assert!(store.schema_is_current().await.expect("an answer"));
        query("UPDATE _sqlx_migrations SET version = version + 1 WHERE version = (SELECT max(version) FROM _sqlx_migrations)")
            .execute(&store.writer)
            .await
            .expect("written");
        assert!(!store.schema_is_current().await.expect("an answer"));
    }
}
