//! Databases of earlier versions keep their content through migrations.
//!
//! `tests/schemas` has a database of every released schema, as `sqlite3 tcgs.db .dump` prints it. Released migrations never change:
//! a test compares their checksums.

use std::{collections::BTreeSet, fs, path::Path, sync::Arc};

use sqlx::{
    migrate::Migrator,
    sqlite::{SqliteConnectOptions, SqlitePoolOptions},
};
use tcgs::{
    domain::{DatasetId, EndpointId, JobId, JobState, KeyId, ProjectId, SystemClock, UploadId},
    store::{
        ArtifactKind, JobFilter, QueuePolicy, Store, Usage,
        migrations::{POSTGRES, SQLITE as ALL},
    },
};

use super::sqlite::totals::{Fixture, succeeded};
use crate::support::database::Database;

/// The same of PostgreSQL's migrations.
const POSTGRES_CHECKSUMS: &[(i64, &str)] = &[
    (1, "df44c65d81910eb09d8717a8c32ff6323d1458bc63ed903a4d7c2bee5882b834a738691bd1779492ca8343ce0bc6ccf7"),
    (2, "4e6c8ef62d6e56a998d730a56b2d320f917a353ab5520c76e7511f2b897e2303ac3464f9f37d38e7b57620543a4d3b15"),
    (3, "d847f5a8ada30246995cb4184c7205b4477ab0eb03380d0a3b9fc0b79f7c64daf7ceacb941c14b8442cf2a1a684afbbd"),
    (4, "97928cced02298763bc38780a333aaf889b4b7eadae8b2bb69b8759a504bc5efc7c3ef5cdcec71bf191c07e559e5fadd"),
    (5, "3a800540b6c6ccad1900a5637bc2e8d58bdb72d90dc4b2cf6112e2391c1f44cb239ed65085ec6919e66eff1d79a7cbfe"),
    (6, "c5d7d9d32ecc2eca3481f271c88d43747028539c16e2b73de5a5d05cd3c001cf9a99a494cbfae681451951bb67f7ee50"),
    (7, "e89b1a5f4c47f398448e513e81ddd81cd4c2bf61c20eda83a2b3bd250404811528654d9db33b9eb8daf3ffde7448bdb8"),
    (8, "8dde77c4742588042cec1009e4ba46c19156c6481d7f08e607f6fedc11a9d2230ec29d7712da80054563a4458401721e"),
    (9, "544fdaf513a02876d25b738883eac7e5fb148bc89af983d70e6b8a01d555d259ce29246f83b16335befbf19de5c35cde"),
    (10, "080e311beb81cc5481012f648f07de77d2b86f2d167d671d658f5425c6578cbfaa566d4b2847795602773ba96081b036"),
];

/// SHA-384 of every migration, by version. A new migration gets a line here, and a line never changes. There was no version 8.
const CHECKSUMS: &[(i64, &str)] = &[
    (1, "60e652c7ddc7596bd55c2bb65dc6c1613a536cac773a1959fac183bfb3c3969d82e9d4502167c5e41cb48f1b6bec9f23"),
    (2, "3f5f8814d83c7880ee8d84f166d6becec54a8116e4fb29e181f17d8975ec4287e94b9e9602d2de281f0ed9f1cfab23e5"),
    (3, "e9c00975df3a32f1adc1e29ce24719b0f869ee53217bec43c429b4e2428185bc57ec586214a5c983c1ae795feff98818"),
    (4, "84f5349ac4febc170184f3b1b06b3768d2dac804c5f4c771606ee9df3503c32b6187444a757be96a654cea6b5e3b3d7c"),
    (5, "7a0a1de5f54b195fe2c4596f700b62338ba3b8f9ad39eca4a11f8b6379cedd9d61c863ef394954f709b274750636a00f"),
    (6, "16103169be6bdc1733f342f8de90636c1cfae8e9f74b776c19300d73ea391f3ea70b8f9a14878e171fe0c73b97a21c8d"),
    (7, "e89cab99f5074576a03004babce6555eb46567db49a11efd7599d2341f2c8dc1d7125a97d80dd5bd4c5cad429cbd7f79"),
    (9, "399fde53492e205f23d37fb40236ba92e168aabf6a8b9ebdea3d50b23d299e91dd7b27d7bf79c2a404cb644160005c43"),
    (10, "79a4b9b44124b28ae5b541376d6614ea1ca02b700b84a5ac97969e2cc0c023d5750ee1456384b37eb91921feebc47ed8"),
    (11, "518911bc1d79279eefdde277723a526ff4b12362dd3269c5858f087eb78fd1273d83c36b11ed22df6bdd66487c461c01"),
    (12, "b2f8d0138018ba745ee7ff809072c17d7cfb9b1743ff6ba75e67fc1e335658b0f04feba3bc246bae2cf95eaf4af4dade"),
    (13, "fbb2290e7ad1cfeaa6010d06250ea051d9667e6285c3ed58cd9535df6aea968819330eb4dd3f04e227b442e93b306cf3"),
    (14, "e2ffec4ff61382a7ad7573314bf4f7ac3a08e24e77ec577122faffaf013e7a43439f90d5cce13ecfd04a351e9e059695"),
    (15, "65c38600bc09f7925eaac217cafef701fa191e55aea527ab540ffc1dcff4700f62212a9b75eb383e202e073ff5a3fd07"),
    (16, "1f73ec4250716451beb63b22c9ac3ab7fcb29c270b0419b9f2f2863757af78bfe68a24362d05c489174f494f6367678f"),
    (17, "2efafa9b351c9ff1303a2d3993c2a9ed857b9b7eb2e1636758c7e92ad97be5f9fdf4900bfaad382ff2db32d8506030e2"),
    (18, "b7ab0b48d4baab35b999112af709958cadd5947225004c34135895cddaeb493564b531ff9226597311b14bf830eb1a9a"),
    (19, "90f0e5372335e600b889fe8524b1c0b6f0b99fa155288147a960c4af6ae583b5e6c728a50c5395cea7f4077bd6e111d6"),
    (20, "0d93cacd4a55e9c777fca79594287073c2152328f0c17bff985c77a798aa5cdb7843910c8a938ce47e9bd0639a5f6941"),
    (21, "7877354d72605715705932c4fe9afa8b8ddc0607b6fde1875acc5ff961a6ace65ec6d657f943af117d6d35a0cf3031e4"),
    (22, "30f01823c0feb800aadd97ec72346c949c0cf4561200cf8280b84ef08deb74eba81140c5796d94d2cdaeef7a1cf51764"),
    (23, "41c8484129fed6be80a6e4a1402c103139179e92563484c90061784c57cb0ec9ed9a6a08410e058bee2c7cb50fbd9855"),
    (24, "747bafe67375530799012dd410052bcafb778addb435505fc434078c5333206c4a8ec38352ca20f5a30fe26cfd1c33b5"),
    (25, "d2f704ef5a3678f88b806a8446b531a912a5ff93bfcf19de7ea4ec036f985836ff48d32d3c04f26384dd272ac51acb6b"),
    (26, "9af9c4b6d4e2378554b51bc210914c676b891878d46fd33c181955abd7d17e533dc4a21c2067d5963bec517ae632500d"),
];

/// Versions whose databases are in `tests/schemas`. A schema is added once a program with it is released.
const DUMPED: &[i64] = &[1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15];

fn folder() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/schemas"))
}

/// Makes a database as a program of that version left it.
async fn restore(path: &Path, version: i64) {
    let dump = fs::read_to_string(folder().join(format!("{version:04}.sql"))).expect("a dump");
    // A dump lists tables by name, so a row may come before the one that it refers to.
    let options = SqliteConnectOptions::new().filename(path).create_if_missing(true).foreign_keys(false);
    let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await.expect("a database");
    sqlx::raw_sql(sqlx::AssertSqlSafe(dump)).execute(&pool).await.expect("the dump runs");
    pool.close().await;
}

async fn open(path: &Path) -> Store {
    Store::open(path, Arc::new(SystemClock), QueuePolicy::default()).await.expect("opens")
}

/// An identity of the dumps; jobs, keys and the rest count through one row of numbers.
fn id<T: std::str::FromStr>(number: u32) -> T {
    let text = format!("01890a5d-ac96-774b-bcce-b3020{number:07}");
    text.parse().ok().expect("an id")
}

const FINISHED_JOB: &str = "01890a5d-ac96-774b-bcce-b302099a8057";
const KEY: u32 = 1;
const SCENE: u32 = 2;
const QUEUED_JOB: u32 = 3;
const UPLOAD: u32 = 4;
const ENDPOINT: u32 = 5;

/// Versions and checksums of migrations, which are as stated.
fn checked(migrations: &Migrator, checksums: &[(i64, &str)]) -> Vec<(i64, String)> {
    let found: Vec<(i64, String)> = migrations
        .iter()
        .map(|migration| {
            let hex = migration.checksum.iter().map(|byte| format!("{byte:02x}")).collect();
            (migration.version, hex)
        })
        .collect();
    for (version, checksum) in &found {
        let stated = checksums.iter().find(|(stated, _)| stated == version).map(|(_, sum)| *sum);
        assert_eq!(stated, Some(checksum.as_str()), "a new migration's line is ({version}, \"{checksum}\"),");
    }
    assert_eq!(found.len(), checksums.len(), "a migration is gone");
    found
}

#[test]
fn released_migrations_are_never_edited() {
    checked(&POSTGRES, POSTGRES_CHECKSUMS);
    let found = checked(&ALL, CHECKSUMS);
    let newest = DUMPED.iter().max().expect("dumps");
    let past = found.iter().map(|(version, _)| *version).filter(|version| version <= newest);
    assert_eq!(past.collect::<Vec<_>>(), DUMPED, "a schema between others has no dump");
    let names = fs::read_dir(folder()).expect("a folder").map(|entry| entry.expect("an entry").file_name());
    let names: BTreeSet<_> = names.map(|name| name.into_string().expect("UTF-8")).collect();
    assert_eq!(names, DUMPED.iter().map(|version| format!("{version:04}.sql")).collect());
}

#[tokio::test]
async fn databases_of_every_earlier_schema_keep_their_content_through_migrations() {
    for version in DUMPED.iter().copied() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.sqlite");
        restore(&path, version).await;
        let store = open(&path).await;
        assert_finished_job(&store, version).await;
        assert_queued_job(&store, version).await;
        assert_later_tables(&store, version).await;
        store.close().await;
        // Once more: an update that was made is not made again.
        open(&path).await.close().await;
    }
}

async fn assert_finished_job(store: &Store, version: i64) {
    let id = FINISHED_JOB.parse().expect("an id");
    let record = store.job(id).await.expect("reads").unwrap_or_else(|| panic!("lost from version {version}"));
    assert_eq!(record.job.state, JobState::Succeeded, "version {version}");
    assert_eq!(record.job.metrics.as_ref().expect("figures").test.psnr, Some(30.5), "version {version}");
    assert_eq!(record.dataset.bytes, 1000, "version {version}");
    assert_eq!((record.project, record.key), (ProjectId::DEFAULT, None), "version {version}");
    let scenes: Vec<_> = record.scenes().collect();
    assert_eq!(scenes.len(), 1, "version {version}");
    assert_eq!(ArtifactKind::Scene(scenes[0].format).name(), "tcgs", "version {version}");
    assert_eq!((scenes[0].lambda, scenes[0].blob.bytes), (None, 77), "version {version}");
    let events = store.events(id, 0, 10).await.expect("reads").expect("the job is there");
    assert_eq!(events.len(), 1, "version {version}");
    let attempts = store.attempts(id).await.expect("reads");
    assert_eq!((attempts.len(), &*attempts[0].worker), (1, "a worker"), "version {version}");
}

/// Queued jobs are still queued.
async fn assert_queued_job(store: &Store, version: i64) {
    let claim = store.claim("test").await.expect("a claim").expect("the job that waited");
    assert_eq!(claim.lease.job, id(QUEUED_JOB), "version {version}");
}

/// Content that only later schemas have.
async fn assert_later_tables(store: &Store, version: i64) {
    let finished = FINISHED_JOB.parse().expect("an id");
    if version >= 4 {
        let key = store.key(id(KEY)).await.expect("reads").expect("the key is there");
        assert_eq!((&*key.name, key.scopes.len()), ("a key", 2), "version {version}");
        let scene = store.dataset(id(SCENE)).await.expect("reads").expect("the scene is there");
        assert_eq!((scene.project, scene.summary.train), (key.project_id, 9), "version {version}");
        let project =
            store.project(key.project_id).await.expect("reads").expect("the key's project is there");
        assert_eq!((project.id.0, &*project.name), (key.id.0, "a key"), "version {version}");
        let job = store.job(id(QUEUED_JOB)).await.expect("reads").expect("the job is there");
        assert_eq!((job.project, job.key), (key.project_id, Some(key.id)), "version {version}");
        assert_eq!(job.dataset_id, Some(id(SCENE)), "version {version}");
    }
    if version >= 5 {
        let upload = store.upload(id(UPLOAD)).await.expect("reads").expect("the upload is there");
        assert_eq!((upload.length, upload.received), (100, 40), "version {version}");
    }
    if version >= 6 {
        let exports = store.exports(finished).await.expect("reads");
        assert_eq!((exports.len(), exports[0].gaussians), (1, 20), "version {version}");
        let fidelity = exports[0].fidelity.map(|fidelity| (fidelity.psnr, fidelity.views));
        assert_eq!(fidelity, (version >= 10).then_some((41.25, 3)), "version {version}");
    }
    if version >= 7 {
        let series = store.series(finished).await.expect("reads").expect("the job is there");
        assert_eq!((series.len(), series[0].step), (1, 400), "version {version}");
        let endpoint = store.endpoint(id(ENDPOINT)).await.expect("reads").expect("the endpoint is there");
        assert_eq!(endpoint.url, "https://example.com/hook", "version {version}");
    }
}

#[tokio::test]
async fn exports_stored_as_spz_are_of_version_3_after_the_migration() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tcgs.sqlite");
    restore(&path, 10).await;
    let options = SqliteConnectOptions::new().filename(&path);
    let old = SqlitePoolOptions::new().max_connections(1).connect_with(options).await.expect("a database");
    let (source, spz) = ("b".repeat(64), "c".repeat(64));
    let blob = sqlx::query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, 9, 5)").bind(&spz);
    blob.execute(&old).await.expect("a blob");
    let export = "INSERT INTO exports (job_id, source, format, digest, gaussians, sh_degree, created_at) VALUES (?, ?, 'spz', ?, 7, 3, 9)";
    let export = sqlx::query(export).bind(FINISHED_JOB).bind(&source).bind(&spz);
    export.execute(&old).await.expect("an export");
    old.close().await;

    let store = open(&path).await;
    let exports = store.exports(FINISHED_JOB.parse().expect("an id")).await.expect("reads");
    let kept: Vec<_> = exports.iter().map(|export| (export.format.name(), export.gaussians)).collect();
    assert_eq!(kept, [("ply", 20), ("spz3", 7)]);
    assert_eq!(exports[0].fidelity.map(|fidelity| (fidelity.psnr, fidelity.views)), Some((41.25, 3)));
    assert_eq!(exports[1].fidelity, None);
    store.close().await;
}

/// The dump of version 15 has a tenant with a scene, an upload, an endpoint and jobs in every state, a revoked key, an administrator, and
/// jobs that were made without a key. The program of that version made them.
#[tokio::test]
async fn a_key_of_before_projects_keeps_everything_in_a_project_of_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tcgs.sqlite");
    restore(&path, 15).await;
    let store = open(&path).await;
    let project = ProjectId(id::<KeyId>(101).0);
    let record = store.project(project).await.expect("reads").expect("the tenant's project");
    assert_eq!((&*record.name, record.limits.quota_bytes), ("a tenant", Some(1 << 30)));
    assert_eq!((record.limits.max_active_jobs, record.limits.max_priority), (Some(9), Some(5)));
    let key = store.key(id(101)).await.expect("reads").expect("the tenant's key");
    assert_eq!((key.project_id, key.requests_per_minute.map(u32::from)), (project, Some(90)));
    assert!(store.key(id(102)).await.expect("reads").is_some_and(|key| key.revoked_at.is_some()));

    let jobs = store
        .jobs(&JobFilter { project: Some(project), ..JobFilter::default() }, None, 9)
        .await
        .expect("reads");
    let states: Vec<_> = jobs.iter().map(|record| (record.job.id, record.job.state)).collect();
    let expected = [
        (124, JobState::Queued),
        (123, JobState::Running),
        (122, JobState::Cancelled),
        (121, JobState::Failed),
        (120, JobState::Succeeded),
    ];
    assert_eq!(states, expected.map(|(number, state)| (id::<JobId>(number), state)));
    assert!(jobs.iter().all(|record| record.key == Some(key.id) && record.metadata.is_empty()));
    assert_eq!((jobs[0].queue_position, jobs[4].artifacts.len()), (Some(1), 2));
    let own = store.datasets(Some(project), None, 9).await.expect("reads");
    assert_eq!(own.iter().map(|scene| scene.id).collect::<Vec<_>>(), [id::<DatasetId>(110)]);
    let upload = store.upload(id::<UploadId>(111)).await.expect("reads").expect("the upload");
    assert_eq!((upload.project, upload.received), (project, 300));
    let endpoint = store.endpoint(id::<EndpointId>(112)).await.expect("reads").expect("the endpoint");
    assert_eq!(endpoint.project, project);
    assert!(store.prior_request(project, "scene").await.is_ok());
    assert_eq!(
        store.usage(project).await.expect("reads"),
        Usage { stored: 5000 + 800 + 90 + 60, reserved: 700 }
    );
    let of_nobody = store.job(id(125)).await.expect("reads").expect("the job without a key");
    assert_eq!((of_nobody.project, of_nobody.key), (ProjectId::DEFAULT, None));
    let worked = store.project_usage(Some(project), None, 1).await.expect("reads").remove(0).worker_seconds;
    assert!(worked >= 100.0, "90 s of the first job, 10 s of the second, and the third runs: {worked}");

    // The running job goes on: its worker ends it as it would have.
    let lease = tcgs::store::Lease { job: id(123), attempt: 1, worker: "worker 1".into() };
    store.heartbeat(&lease).await.expect("still held");
    store.close().await;
}

/// Schemas from before the totals, before projects, and of the latest release before them, with rows in every table.
#[tokio::test]
async fn a_migrated_database_gets_its_totals_by_counting() {
    for version in [4, 7, 10, 11, 15] {
        let folder = tempfile::tempdir().expect("a folder");
        restore(&folder.path().join("tcgs.db"), version).await;
        let mut fixture = Fixture::open(Database::Sqlite(folder)).await;
        fixture.check(&format!("the migration of {version}")).await;
        let claim = fixture.store.claim("worker").await.expect("an answer").expect("a job");
        fixture.store.finish(&claim.lease, succeeded("a file")).await.expect("ended");
        fixture.check(&format!("a change after the migration of {version}")).await;
        assert!(fixture.seen.claims > 0);
    }
}

/// Columns that SQLite's schema keeps from its past and nothing reads.
const PAST: [&str; 6] = [
    "keys.max_bytes",
    "keys.max_active_jobs",
    "keys.max_priority",
    "scenes.owner",
    "uploads.owner",
    "webhook_endpoints.owner",
];

/// What PostgreSQL has beyond it.
const OF_POSTGRES: [&str; 7] = [
    "counter_changes.cause",
    "counter_changes.label",
    "counter_changes.name",
    "counter_changes.value",
    "total_changes.label",
    "total_changes.name",
    "total_changes.value",
];

#[tokio::test]
async fn both_schemas_have_the_same_tables_columns_and_indexes() {
    let Some(postgres) = Database::for_module("postgres").await else { return };
    let sqlite = Database::sqlite();
    open(match &sqlite.location() {
        tcgs::store::DatabaseLocation::File(path) => path,
        location => panic!("{location}"),
    })
    .await
    .close()
    .await;
    let names = async |database: &Database, query: &str| -> BTreeSet<String> {
        database.rows(query, 1).await.into_iter().map(|row| row[0].clone()).collect()
    };
    let mut columns = names(
        &sqlite,
        "SELECT tables.name || '.' || columns.name FROM sqlite_schema AS tables, pragma_table_info(tables.name) AS columns
         WHERE tables.type = 'table' AND tables.name NOT LIKE 'sqlite_%' AND tables.name <> '_sqlx_migrations'",
    )
    .await;
    columns.retain(|column| !PAST.contains(&column.as_str()));
    columns.extend(OF_POSTGRES.map(str::to_owned));
    let found = names(
        &postgres,
        "SELECT CAST(table_name || '.' || column_name AS text) FROM information_schema.columns
         WHERE table_schema = 'public' AND table_name <> '_sqlx_migrations'",
    )
    .await;
    assert_eq!(found, columns);
    let indexes =
        names(&sqlite, "SELECT name FROM sqlite_schema WHERE type = 'index' AND name NOT LIKE 'sqlite_%'")
            .await;
    let found = names(
        &postgres,
        "SELECT CAST(indexname AS text) FROM pg_indexes WHERE schemaname = 'public' AND indexname NOT LIKE '%_pkey'
             AND indexname NOT LIKE '%_key'",
    )
    .await;
    assert_eq!(found, indexes);
}
