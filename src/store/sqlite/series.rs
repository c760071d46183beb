//! Series of points.

use sqlx::SqliteConnection;

use super::{SqliteStore, queue::held, rows};
use crate::{
    domain::{JobId, Progress, SeriesPoint, series_bucket},
    store::{Lease, Series, StoreError, StoreFuture},
};

impl Series for SqliteStore {
    fn record<'a>(&'a self, lease: &'a Lease, points: &'a [Progress]) -> StoreFuture<'a, ()> {
        Box::pin(async move {
            let (mut tx, _) = self.begin().await?;
            held(&mut tx, lease).await?;
            let mut reached = u64::MAX;
            for point in points {
                if point.step <= reached {
                    forget_after(&mut tx, lease.job, point.step).await?;
                }
                reached = point.step;
                add(&mut tx, lease, point).await?;
            }
            tx.commit().await?;
            Ok(())
        })
    }

    fn series(&self, job: JobId) -> StoreFuture<'_, Option<Vec<SeriesPoint>>> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            let known = sqlx::query("SELECT 1 FROM jobs WHERE id = ?").bind(job.to_string());
            if known.fetch_optional(&mut *tx).await?.is_none() {
                return Ok(None);
            }
            let rows = sqlx::query("SELECT * FROM series WHERE job_id = ? ORDER BY step")
                .bind(job.to_string())
                .fetch_all(&mut *tx)
                .await?;
            rows.iter().map(rows::point).collect::<Result<_, _>>().map(Some)
        })
    }
}

async fn forget_after(connection: &mut SqliteConnection, job: JobId, step: u64) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM series WHERE job_id = ? AND step > ?")
        .bind(job.to_string())
        .bind(rows::signed(step))
        .execute(connection)
        .await?;
    Ok(())
}

async fn add(connection: &mut SqliteConnection, lease: &Lease, point: &Progress) -> Result<(), StoreError> {
    let finite = |value: Option<f64>| value.filter(|value| value.is_finite());
    sqlx::query(
        "INSERT INTO series (job_id, bucket, attempt, step, seconds, loss, psnr, anchors, gaussians, bytes)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
         ON CONFLICT DO UPDATE SET attempt = excluded.attempt, step = excluded.step, seconds = excluded.seconds,
             loss = excluded.loss, psnr = excluded.psnr, anchors = excluded.anchors, gaussians = excluded.gaussians,
             bytes = excluded.bytes
         WHERE excluded.loss IS NOT NULL",
    )
    .bind(lease.job.to_string())
    .bind(series_bucket(point))
    .bind(lease.attempt)
    .bind(rows::signed(point.step))
    .bind(finite(Some(point.elapsed_seconds)).unwrap_or_default())
    .bind(finite(point.loss))
    .bind(finite(point.psnr))
    .bind(rows::signed(point.anchors))
    .bind(rows::signed(point.gaussians))
    .bind(point.bytes.map(rows::signed))
    .execute(connection)
    .await?;
    Ok(())
}
