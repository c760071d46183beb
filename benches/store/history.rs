//! A history of jobs, written beside the store: making it through the store would take hours.

use std::path::Path;

use sqlx::{
    Connection as _, SqliteConnection,
    sqlite::{SqliteConnectOptions, SqliteSynchronous},
};
use tcgs::domain::{Progress, ProjectId, TrainOptions};

const METRICS: &str = r#"{
    "test": {"psnr": 30.5, "ssim": 0.97, "lpips": null, "views": 3}, "train": {"psnr": 31.0, "ssim": 0.98, "lpips": null, "views": 9},
    "bytes": {"total": 77, "positions": 1, "networks": 2, "planes": 0, "masks": 3, "features": 4, "scalings": 5, "offsets": 6,
        "container": 56},
    "seconds": {"ingest": 1.0, "train": 60.0, "encode": 0.5, "decode": 0.1}, "steps": 400, "steps_per_second": 6.5,
    "anchors": 10, "gaussians": 20, "psnr_before_quantisation": 30.6, "adapter": "llvmpipe", "background": "black",
    "decode_sha256": "cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"
}"#;

/// Two projects, 100 datasets, a list of cameras that all jobs share, and of the first project `?1` jobs with a file each.
const STATEMENTS: [&str; 5] = [
    "INSERT INTO projects (id, name, created_at) SELECT value, 'a project', 0 FROM json_each(json_array(?2, ?3))",
    "WITH RECURSIVE numbers (n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM numbers WHERE n < ?1 + 100)
     INSERT INTO blobs (digest, bytes, created_at) SELECT printf('%064x', n), 1000, 0 FROM numbers",
    "WITH RECURSIVE numbers (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM numbers WHERE n < ?1)
     INSERT INTO jobs (id, project, dataset, options, state, phase, progress, metrics, priority, run_after, attempt, charged, max_attempts,
         last_seq, created_at, started_at, finished_at)
     SELECT printf('00000000-0000-7000-8000-%012x', n), ?2, printf('%064x', 1 + n % 100), ?4, 'succeeded', 'done', ?5, ?6, 0, 0, 1, 1, 3,
         0, n, n, n
     FROM numbers",
    "INSERT INTO attempts (job_id, number, worker, started_at, ended_at, outcome) SELECT id, 1, 'w', 1, 2, 'succeeded' FROM jobs",
    "INSERT INTO artifacts (job_id, kind, place, digest, attempt)
     SELECT id, 'tcgs', 0, printf('%064x', 100 + created_at), 1 FROM jobs
     UNION ALL SELECT id, 'cameras', 0, printf('%064x', 0), 1 FROM jobs",
];

/// Adds the projects and the jobs of the first of them.
pub(crate) async fn write(path: &Path, busy: ProjectId, quiet: ProjectId, jobs: usize) {
    // What a crash would lose can be made again.
    let options = SqliteConnectOptions::new().filename(path).synchronous(SqliteSynchronous::Off);
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let mut tx = database.begin().await.unwrap();
    for statement in STATEMENTS {
        sqlx::query(statement)
            .bind(i64::try_from(jobs).unwrap())
            .bind(busy.to_string())
            .bind(quiet.to_string())
            .bind(serde_json::to_string(&TrainOptions::default()).unwrap())
            .bind(serde_json::to_string(&Progress::default()).unwrap())
            .bind(METRICS)
            .execute(&mut *tx)
            .await
            .unwrap();
    }
    tx.commit().await.unwrap();
    database.close().await.unwrap();
}
