//! A history of jobs, written beside the store: making it through the store would take hours.

use std::path::Path;

use sqlx::{
    Connection as _, SqliteConnection,
    sqlite::{SqliteConnectOptions, SqliteSynchronous},
};
use tcgs::domain::{Digest, JobId, KeyId, Progress, TrainOptions};
use uuid::Uuid;

/// Datasets that the jobs are of.
const DATASETS: usize = 100;
const METRICS: &str = r#"{
    "test": {"psnr": 30.5, "ssim": 0.97, "lpips": null, "views": 3}, "train": {"psnr": 31.0, "ssim": 0.98, "lpips": null, "views": 9},
    "bytes": {"total": 77, "positions": 1, "networks": 2, "planes": 0, "masks": 3, "features": 4, "scalings": 5, "offsets": 6,
        "container": 56},
    "seconds": {"ingest": 1.0, "train": 60.0, "encode": 0.5, "decode": 0.1}, "steps": 400, "steps_per_second": 6.5,
    "anchors": 10, "gaussians": 20, "psnr_before_quantisation": 30.6, "adapter": "llvmpipe", "background": "black",
    "decode_sha256": "cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"
}"#;

/// Adds the keys and the jobs of the first of them.
pub(crate) async fn write(path: &Path, busy: KeyId, quiet: KeyId, jobs: usize) {
    // What a crash would lose can be made again.
    let options = SqliteConnectOptions::new().filename(path).synchronous(SqliteSynchronous::Off);
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let mut tx = database.begin().await.unwrap();
    for key in [busy, quiet] {
        sqlx::query(
            "INSERT INTO keys (id, name, prefix, hash, scopes, created_at) VALUES (?1, 'k', 'p', ?1, '', 0)",
        )
        .bind(key.to_string())
        .execute(&mut *tx)
        .await
        .unwrap();
    }
    let cameras = blob(&mut tx, "cameras").await;
    let mut datasets = Vec::with_capacity(DATASETS);
    for number in 0..DATASETS {
        datasets.push(blob(&mut tx, &format!("dataset {number}")).await);
    }
    for number in 0..jobs {
        let job = JobId(Uuid::from_u128(number as u128 + 1)).to_string();
        sqlx::query(
            "INSERT INTO jobs (id, owner, dataset, options, state, phase, progress, metrics, priority, run_after, attempt, charged,
                 max_attempts, last_seq, created_at, started_at, finished_at)
             VALUES (?1, ?2, ?3, ?4, 'succeeded', 'done', ?5, ?6, 0, 0, 1, 1, 3, 0, ?7, ?7, ?7)",
        )
        .bind(&job)
        .bind(busy.to_string())
        .bind(&datasets[number % DATASETS])
        .bind(serde_json::to_string(&TrainOptions::default()).unwrap())
        .bind(serde_json::to_string(&Progress::default()).unwrap())
        .bind(METRICS)
        .bind(number as i64)
        .execute(&mut *tx)
        .await
        .unwrap();
        sqlx::query(
            "INSERT INTO attempts (job_id, number, worker, started_at, ended_at, outcome) VALUES (?, 1, 'w', 1, 2, 'succeeded')",
        )
        .bind(&job)
        .execute(&mut *tx)
        .await
        .unwrap();
        let file = blob(&mut tx, &format!("file {number}")).await;
        for (kind, digest) in [("tcgs", &file), ("cameras", &cameras)] {
            sqlx::query(
                "INSERT INTO artifacts (job_id, kind, place, digest, attempt) VALUES (?, ?, 0, ?, 1)",
            )
            .bind(&job)
            .bind(kind)
            .bind(digest)
            .execute(&mut *tx)
            .await
            .unwrap();
        }
    }
    tx.commit().await.unwrap();
    database.close().await.unwrap();
}

async fn blob(database: &mut SqliteConnection, content: &str) -> String {
    let digest = Digest::of(content.as_bytes()).to_string();
    sqlx::query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, 1000, 0)")
        .bind(&digest)
        .execute(database)
        .await
        .unwrap();
    digest
}
