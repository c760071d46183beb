//! Training curves.

use super::{
    Store,
    db::{Transaction, query, values},
    job_exists,
    queue::leased_job,
    rows,
};
use crate::{
    domain::{JobId, Progress, SeriesPoint, series_bucket},
    store::{Lease, StoreError, StoreFuture},
};

impl Store {
    /// Adds points of an attempt, in order. A point replaces every one at a later step, left by an earlier attempt, and the one in
    /// its [bucket](crate::domain::series_bucket); a point without a loss, the first of an attempt, replaces none in its bucket.
    pub fn record<'a>(&'a self, lease: &'a Lease, points: &'a [Progress]) -> StoreFuture<'a, ()> {
        self.call("record").run(self.write(async move |tx, _| {
            leased_job(tx, lease).await?;
            let mut reached = u64::MAX;
            for point in points {
                if point.step <= reached {
                    delete_after(tx, lease.job, point.step).await?;
                }
                reached = point.step;
                insert(tx, lease, point).await?;
            }
            Ok(())
        }))
    }

    /// The points of a job by their steps; `None` if there is no such job.
    pub fn series(&self, job: JobId) -> StoreFuture<'_, Option<Vec<SeriesPoint>>> {
        self.call("series").run(self.read(async move |tx| {
            if !job_exists(tx, job).await? {
                return Ok(None);
            }
            let points = query("SELECT * FROM series WHERE job_id = ? ORDER BY step").bind(job.to_string());
            points.all(tx, rows::point).await.map(Some)
        }))
    }
}

async fn delete_after(connection: &mut Transaction, job: JobId, step: u64) -> Result<(), StoreError> {
    query("DELETE FROM series WHERE job_id = ? AND step > ?")
        .bind_all(values![job.to_string(), rows::signed(step)])
        .run(connection)
        .await
}

async fn insert(connection: &mut Transaction, lease: &Lease, point: &Progress) -> Result<(), StoreError> {
    let finite = |value: Option<f64>| value.filter(|value| value.is_finite());
    query(
        "INSERT INTO series (job_id, bucket, attempt, step, seconds, loss, psnr, ssim, anchors, gaussians, bytes)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
         ON CONFLICT (job_id, bucket) DO UPDATE SET attempt = excluded.attempt, step = excluded.step, seconds = excluded.seconds,
             loss = excluded.loss, psnr = excluded.psnr, ssim = excluded.ssim, anchors = excluded.anchors, gaussians = excluded.gaussians,
             bytes = excluded.bytes
         WHERE excluded.loss IS NOT NULL",
    )
    .bind_all(values![lease.job.to_string(), series_bucket(point), lease.attempt, rows::signed(point.step)])
    .bind_all(values![finite(Some(point.elapsed_seconds)).unwrap_or_default(), finite(point.loss)])
    .bind_all(values![finite(point.psnr), finite(point.ssim), rows::signed(point.anchors)])
    .bind_all(values![rows::signed(point.gaussians), point.bytes.map(rows::signed)])
    .run(connection)
    .await
}
