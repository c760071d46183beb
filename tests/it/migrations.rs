//! Databases of earlier versions: what they hold is there after an update.

use std::{borrow::Cow, path::Path, sync::Arc};

use sqlx::{
    SqlitePool,
    migrate::Migrator,
    sqlite::{SqliteConnectOptions, SqlitePoolOptions},
};
use tcgs::{
    domain::{JobState, SystemClock},
    store::{ArtifactKind, Exports as _, QueuePolicy, SqliteStore, Store},
};

static ALL: Migrator = sqlx::migrate!("migrations/sqlite");

/// A database as it was after `version`.
async fn database(path: &Path, version: i64) -> SqlitePool {
    let options = SqliteConnectOptions::new().filename(path).create_if_missing(true).foreign_keys(true);
    let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await.expect("a database");
    let known = ALL.iter().filter(|migration| migration.version <= version).cloned().collect();
    let migrator = Migrator { migrations: Cow::Owned(known), ..Migrator::DEFAULT };
    migrator.run(&pool).await.expect("the schema of that time");
    pool
}

/// Figures as the first version wrote them.
const METRICS: &str = r#"{
    "test": {"psnr": 30.5, "ssim": 0.97, "lpips": null, "views": 3}, "train": {"psnr": 31.0, "ssim": 0.98, "lpips": null, "views": 9},
    "bytes": {"total": 77, "positions": 1, "networks": 2, "planes": 0, "masks": 3, "features": 4, "scalings": 5, "offsets": 6,
        "container": 56},
    "seconds": {"ingest": 1.0, "train": 60.0, "encode": 0.5, "decode": 0.1}, "steps": 400, "steps_per_second": 6.5,
    "anchors": 10, "gaussians": 20, "psnr_before_quantisation": 30.6, "adapter": "llvmpipe", "background": "black",
    "decode_sha256": "cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"
}"#;

const JOB: &str = "01890a5d-ac96-774b-bcce-b302099a8057";

async fn open(path: &Path) -> SqliteStore {
    SqliteStore::open(path, Arc::new(SystemClock), QueuePolicy::default()).await.expect("opens")
}

#[tokio::test]
async fn jobs_and_files_of_every_earlier_schema_are_there_after_an_update() {
    let versions: Vec<i64> = ALL.iter().map(|migration| migration.version).collect();
    assert_eq!(versions.first(), Some(&1));
    for version in versions {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.sqlite");
        let old = database(&path, version).await;
        let (dataset, file) = ("a".repeat(64), "b".repeat(64));
        for (digest, bytes) in [(&dataset, 1000), (&file, 77)] {
            sqlx::query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, ?, 5)")
                .bind(digest)
                .bind(bytes)
                .execute(&old)
                .await
                .expect("a blob");
        }
        sqlx::query(
            "INSERT INTO jobs (id, dataset, options, state, phase, progress, metrics, priority, run_after, attempt, charged, max_attempts,
                 last_seq, created_at, started_at, finished_at)
             VALUES (?, ?, '{}', 'succeeded', 'done', '{}', ?, 0, 5, 1, 1, 3, 1, 5, 6, 7)",
        )
        .bind(JOB)
        .bind(&dataset)
        .bind(METRICS)
        .execute(&old)
        .await
        .expect("a job");
        sqlx::query(
            "INSERT INTO events (job_id, seq, at, kind, attempt, data) VALUES (?, 1, 5, 'state', 0, '{\"state\":\"queued\"}')",
        )
        .bind(JOB)
        .execute(&old)
        .await
        .expect("an event");
        let place = if version >= 3 { ("place, ", "0, ") } else { ("", "") };
        let insert = format!(
            "INSERT INTO artifacts (job_id, kind, {}digest, attempt) VALUES ('{JOB}', 'tcgs', {}'{file}', 1)",
            place.0, place.1
        );
        sqlx::query(sqlx::AssertSqlSafe(insert)).execute(&old).await.expect("an artifact");
        old.close().await;

        let store = open(&path).await;
        let id = JOB.parse().expect("an id");
        let record =
            store.job(id).await.expect("reads").unwrap_or_else(|| panic!("lost from version {version}"));
        assert_eq!(record.job.state, JobState::Succeeded, "version {version}");
        assert_eq!(record.job.metrics.as_ref().expect("figures").test.psnr, Some(30.5), "version {version}");
        assert_eq!(record.dataset.bytes, 1000, "version {version}");
        assert_eq!(record.owner, None, "version {version}");
        let scenes: Vec<_> = record.scenes().collect();
        assert_eq!(scenes.len(), 1, "version {version}");
        assert_eq!(ArtifactKind::Scene(scenes[0].format).name(), "tcgs", "version {version}");
        assert_eq!((scenes[0].lambda, scenes[0].blob.bytes), (None, 77), "version {version}");
        let events = store.events(id, 0, 10).await.expect("reads").expect("the job is there");
        assert_eq!(events.len(), 1, "version {version}");
        store.close().await;
        // Once more: an update that was made is not made again.
        open(&path).await.close().await;
    }
}

#[tokio::test]
async fn exports_that_were_kept_as_spz_are_of_version_3_after_an_update() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tcgs.sqlite");
    let old = database(&path, 10).await;
    let (dataset, ply, spz) = ("a".repeat(64), "b".repeat(64), "c".repeat(64));
    for digest in [&dataset, &ply, &spz] {
        let insert = sqlx::query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, 9, 5)");
        insert.bind(digest).execute(&old).await.expect("a blob");
    }
    let job = "INSERT INTO jobs (id, dataset, options, state, phase, progress, metrics, priority, run_after, attempt, charged,
            max_attempts, last_seq, created_at, started_at, finished_at)
        VALUES (?, ?, '{}', 'succeeded', 'done', '{}', ?, 0, 5, 1, 1, 3, 0, 5, 6, 7)";
    sqlx::query(job).bind(JOB).bind(&dataset).bind(METRICS).execute(&old).await.expect("a job");
    for (format, digest, likeness) in [("ply", &ply, Some(40.5)), ("spz", &spz, None)] {
        let insert = "INSERT INTO exports (job_id, source, format, digest, gaussians, sh_degree, created_at, likeness_psnr, likeness_views)
            VALUES (?, ?, ?, ?, 7, 3, 5, ?, ?)";
        let insert = sqlx::query(insert).bind(JOB).bind(&dataset).bind(format).bind(digest);
        insert.bind(likeness).bind(likeness.map(|_| 2)).execute(&old).await.expect("an export");
    }
    old.close().await;
    let store = open(&path).await;
    let exports = store.exports(JOB.parse().expect("an id")).await.expect("reads");
    let kept: Vec<_> =
        exports.iter().map(|export| (export.format.name(), export.blob.digest.to_string())).collect();
    assert_eq!(kept, [("ply", ply), ("spz3", spz)]);
    assert_eq!(exports[0].likeness.map(|likeness| (likeness.psnr, likeness.views)), Some((40.5, 2)));
    assert_eq!((exports[1].likeness, exports[1].gaussians), (None, 7));
    store.close().await;
}
