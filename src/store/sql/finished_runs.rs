//! Figures of finished jobs.

use super::{
    Store,
    db::{Row, Sql, query},
    rows,
};
use crate::{
    domain::{ModelKind, Preset},
    store::{FinishedRun, RUNS_LOOKED_AT, StoreError, StoreFuture},
};

/// Of the newest jobs, so that the cost is bounded however many there are. Figures are taken out here: metrics list every view.
const FINISHED_RUNS: Sql = Sql {
    sqlite: "
    SELECT json_extract(metrics, '$.adapter') AS adapter,
        CAST(json_extract(metrics, '$.view_pixels') AS INTEGER) AS view_pixels,
        CAST(json_extract(metrics, '$.steps_per_second') AS REAL) AS speed,
        CAST(json_extract(metrics, '$.seconds.train') AS REAL) AS train_seconds,
        attempt, started_at, finished_at,
        photographs IS NOT NULL OR COALESCE(json_array_length(options, '$.rd_curve'), 0) > 0 AS is_more
    FROM (SELECT state, options, metrics, attempt, started_at, finished_at, photographs FROM jobs
        ORDER BY created_at DESC, id DESC LIMIT ?) AS newest
    WHERE state = 'succeeded' AND json_extract(metrics, '$.view_pixels') IS NOT NULL
        AND json_extract(options, '$.model') = ? AND json_extract(options, '$.preset') = ?",
    postgres: "
    SELECT CAST(metrics AS jsonb) ->> 'adapter' AS adapter,
        CAST(CAST(metrics AS jsonb) ->> 'view_pixels' AS bigint) AS view_pixels,
        CAST(CAST(metrics AS jsonb) ->> 'steps_per_second' AS double precision) AS speed,
        CAST(CAST(metrics AS jsonb) #>> '{seconds,train}' AS double precision) AS train_seconds,
        CAST(attempt AS bigint) AS attempt, started_at, finished_at,
        photographs IS NOT NULL OR COALESCE(jsonb_array_length(CAST(options AS jsonb) -> 'rd_curve'), 0) > 0 AS is_more
    FROM (SELECT state, options, metrics, attempt, started_at, finished_at, photographs FROM jobs
        ORDER BY created_at DESC, id DESC LIMIT ?) AS newest
    WHERE state = 'succeeded' AND CAST(metrics AS jsonb) ->> 'view_pixels' IS NOT NULL
        AND CAST(options AS jsonb) ->> 'model' = ? AND CAST(options AS jsonb) ->> 'preset' = ?",
};

impl Store {
    /// The succeeded ones of the newest jobs, of all projects, that trained this model by this preset; newest first.
    pub fn finished_runs(&self, model: ModelKind, preset: Preset) -> StoreFuture<'_, Vec<FinishedRun>> {
        self.call("finished_runs").run(self.read(async move |tx| {
            let runs = query(FINISHED_RUNS).bind(i64::from(RUNS_LOOKED_AT));
            runs.bind(model.name()).bind(preset.name()).all(tx, read).await
        }))
    }
}

fn read(row: &Row) -> Result<FinishedRun, StoreError> {
    let attempts: u32 = rows::integer(row, "attempt")?;
    let took = rows::optional_instant(row, "started_at")?.zip(rows::optional_instant(row, "finished_at")?);
    let trained: f64 = row.try_get("train_seconds")?;
    // A search for cameras, or the other files of a curve, which few jobs have.
    let is_more: bool = row.try_get("is_more")?;
    let other =
        took.map(|(started, finished)| (finished.duration_since(started).as_secs_f64() - trained).max(0.0));
    Ok(FinishedRun {
        adapter: row.try_get("adapter")?,
        view_pixels: rows::integer(row, "view_pixels")?,
        steps_per_second: row.try_get("speed")?,
        other_seconds: other.filter(|_| attempts == 1 && !is_more),
    })
}
