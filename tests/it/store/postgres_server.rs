//! What a PostgreSQL server does that a file does not: it tells of changes, goes away and comes back, and plans by statistics.

use std::{sync::Arc, time::Duration};

use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{Digest, JobId, JobState, ManualClock, SystemClock, TrainOptions},
    store::{BlobRef, Blobs, ChangeKind, DatabaseLocation, JobFilter, NewJob, Outcome, QueuePolicy, Store},
    worker,
};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::support::{
    contract::Coverage,
    database::Database,
    eventually::{eventually, within},
    fakes::FakeRunner,
    faults::Failing,
    postgres::Cluster,
    server::{Server, Setup, quick_policy, quick_worker},
};

fn new_job(number: u128, dataset: BlobRef) -> NewJob {
    NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset)
}

fn dataset() -> BlobRef {
    BlobRef { digest: Digest::of(b"dataset"), bytes: 7 }
}

async fn database() -> Option<Database> {
    Database::for_module("postgres").await
}

async fn open(database: &Database) -> Store {
    database.open(Arc::new(SystemClock), QueuePolicy::default()).await
}

#[tokio::test]
async fn listeners_are_told_of_jobs_and_events_and_connect_again() {
    let Some(database) = database().await else { return };
    let (listening, telling) = (open(&database).await, open(&database).await);
    let mut queue = listening.changes(ChangeKind::Queue);
    let mut events = listening.changes(ChangeKind::Events);
    let connected = async |queue: &tcgs::store::Changes| {
        eventually("it listens", async || queue.is_live()).await;
    };
    connected(&queue).await;
    // What it says of its own beginning.
    within("a first word", queue.wait()).await;
    within("a first word", events.wait()).await;
    telling.create_job(new_job(1, dataset())).await.expect("created");
    within("word of a job", queue.wait()).await;
    within("word of its event", events.wait()).await;
    let claim = telling.claim("worker").await.expect("a claim").expect("a job");
    within("word of its events", events.wait()).await;

    let Database::Postgres(postgres) = &database else { panic!("PostgreSQL") };
    postgres.disconnect_all().await;
    within("word of the loss", queue.wait()).await;
    connected(&queue).await;
    queue.wait().await;
    let released = async || telling.finish(&claim.lease, Outcome::Released).await.is_ok();
    eventually("the other store is connected again", released).await;
    within("word of a job that is queued again", queue.wait()).await;
}

/// Nothing is told at all while the listener believes that it would be.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_found_by_asking_if_its_notification_is_lost() {
    let Some(database) = database().await else { return };
    for trigger in ["jobs_added_told", "jobs_changed_told"] {
        database.run(&format!("DROP TRIGGER {trigger} ON jobs")).await;
    }
    database.run("DROP TRIGGER events_told ON events").await;
    let store = open(&database).await;
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a blob store");
    let stop = CancellationToken::new();
    let runner = Arc::new(FakeRunner::default());
    let config = quick_worker("w");
    let working = tokio::spawn(worker::serve(store.clone(), blobs.clone(), runner, config, stop.clone()));
    let changes = store.changes(ChangeKind::Queue);
    eventually("it listens", async || changes.is_live()).await;
    let archive = blobs.put(bytes::Bytes::from_static(b"succeed")).await.expect("published");
    let id = open(&database).await.create_job(new_job(1, archive)).await.expect("created").job.id;
    eventually("the job is done", async || {
        store.job(id).await.expect("read").expect("known").job.state == JobState::Succeeded
    })
    .await;
    stop.cancel();
    within("the worker ends", working).await.expect("joined").expect("a clean end");
}

/// The database's clock decides, whatever a machine's shows.
#[tokio::test]
async fn times_are_the_databases() {
    let Some(database) = database().await else { return };
    let Database::Postgres(postgres) = &database else { panic!("PostgreSQL") };
    let location = DatabaseLocation::Postgres(postgres.url());
    let wrong = Arc::new(ManualClock::new("1999-12-31T23:59:59Z".parse().expect("an instant")));
    let store = Store::open(&location, wrong.clone(), QueuePolicy::default()).await.expect("a database");
    let record = store.create_job(new_job(1, dataset())).await.expect("created");
    let told: i64 = database.number("SELECT CAST(extract(epoch FROM now()) * 1000000 AS bigint)").await;
    let apart = told - record.job.created_at.as_microsecond();
    assert!((0..300_000_000).contains(&apart), "{apart} microseconds");
    // A lease ends by what a process observes, not by any wall clock.
    let claim = store.claim("worker").await.expect("a claim").expect("a job");
    wrong.set_by(SignedDuration::from_hours(1000));
    assert_eq!(store.claim("other").await.expect("a claim"), None);
    store.heartbeat(&claim.lease).await.expect("it holds");
    wrong.advance(SignedDuration::from_secs(61));
    assert_eq!(store.claim("other").await.expect("a claim").expect("the job").lease.attempt, 2);
}

/// A replica whose clock is wrong promises and keeps the same times as any other.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn deadlines_and_expiries_are_of_the_databases_time() {
    let Some(database) = database().await else { return };
    let Database::Postgres(postgres) = &database else { panic!("PostgreSQL") };
    for wrong in ["1999-12-31T23:59:59Z", "2099-12-31T23:59:59Z"] {
        let setup = Setup {
            database: Some(DatabaseLocation::Postgres(postgres.url())),
            clock: Arc::new(ManualClock::new(wrong.parse().expect("an instant"))),
            worker: false,
            ..Setup::default()
        };
        let server = Server::start_with(&Coverage::default(), setup).await;
        let job = server.upload("?deadline_s=3600", "succeed").await.expect(201).json();
        let instant = |name: &str| job[name].as_str().expect("a text").parse::<Timestamp>().expect("a time");
        let apart = instant("deadline_at").duration_since(instant("created_at"));
        assert!((3500..=3600).contains(&apart.as_secs()), "{apart:?}");
        let begin = server.send("POST", "/v1/uploads", |request| {
            request.header("tus-resumable", "1.0.0").header("upload-length", 9)
        });
        let upload = begin.await.expect(201).header("location").to_owned();
        server.store.expire_uploads(Timestamp::MIN).await.expect("a database");
        server.send("HEAD", &upload, |request| request.header("tus-resumable", "1.0.0")).await.expect(200);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_gone_is_503_and_everything_goes_on_once_it_is_back() {
    let Some(cluster) = Cluster::own() else { return };
    let database = cluster.database().await;
    let setup = Setup {
        database: Some(DatabaseLocation::Postgres(database.url())),
        policy: quick_policy(),
        ..Setup::default()
    };
    let server = Server::start_with(&Coverage::default(), setup).await;
    let job = server.upload("", "succeed").await.expect(201).json();
    let job = format!("/v1/jobs/{}", job["id"].as_str().expect("an id"));
    let state = async || server.get(&job).await.json()["state"].clone();
    eventually("the job is done", async || state().await == "succeeded").await;

    server.faults.set(Some(Failing::Stopped));
    cluster.stop();
    for path in ["/v1/jobs", &job] {
        let answer = server.get(path).await.expect(503);
        assert!(!answer.header("retry-after").is_empty());
        assert_eq!(answer.json()["type"], "urn:tcgs:problem:busy");
    }
    server.upload("", "succeed").await.expect(503);
    // What was found last is told again for a while.
    eventually("it is not ready", async || server.get("/readyz").await.status == 503).await;
    server.get("/healthz").await.expect(200);

    cluster.restart();
    server.faults.set(None);
    eventually("it is ready again", async || server.get("/readyz").await.status == 200).await;
    server.get(&job).await.expect(200);
    let next = server.upload("", "succeed").await.expect(201).json();
    let next = format!("/v1/jobs/{}", next["id"].as_str().expect("an id"));
    eventually("the worker goes on", async || server.get(&next).await.json()["state"] == "succeeded").await;
}

/// The server counts the times that it reads the table whole.
#[tokio::test]
async fn no_statement_reads_a_whole_table_at_100_000_jobs() {
    let Some(database) = database().await else { return };
    database
        .run(
            "INSERT INTO projects (id, name, created_at)
             SELECT '10000000-0000-0000-0000-' || lpad(number::text, 12, '0'), 'a project', 0 FROM generate_series(1, 50) AS number",
        )
        .await;
    database
        .run(&format!("INSERT INTO blobs (digest, bytes, created_at) VALUES ('{}', 7, 0)", dataset().digest))
        .await;
    // Each of a hundred jobs. If all had the same, any row would be one that refers to it.
    database
        .run("INSERT INTO blobs (digest, bytes, created_at) SELECT lpad(number::text, 64, '0'), 7, 0 FROM generate_series(0, 999) AS number")
        .await;
    // One transaction of 100 000 changes of the same totals would take minutes; they are summed afterwards.
    database.run("ALTER TABLE jobs DISABLE TRIGGER USER").await;
    database
        .run(&format!(
            "INSERT INTO jobs (id, project, name, dataset, options, state, phase, progress, priority, run_after, max_attempts, created_at, finished_at)
             SELECT '20000000-0000-0000-0000-' || lpad(number::text, 12, '0'),
                 '10000000-0000-0000-0000-' || lpad((1 + number % 50)::text, 12, '0'), 'job ' || number % 1000, lpad((number % 1000)::text, 64, '0'),
                 '{{}}', CASE WHEN number % 2 = 0 THEN 'queued' ELSE 'succeeded' END, CASE WHEN number % 2 = 0 THEN 'queued' ELSE 'done' END,
                 '{}', number % 5, 0, 3, number, CASE WHEN number % 2 = 1 THEN number END
             FROM generate_series(1, 100000) AS number",
            serde_json::to_string(&tcgs::domain::Progress::default()).expect("JSON"),
        ))
        .await;
    database.run("ALTER TABLE jobs ENABLE TRIGGER USER").await;
    database
        .run(
            "UPDATE project_totals SET queued_jobs = (SELECT count(*) FROM jobs
                 WHERE jobs.project = project_totals.project AND state = 'queued'),
                 succeeded_jobs = (SELECT count(*) FROM jobs WHERE jobs.project = project_totals.project AND state = 'succeeded')",
        )
        .await;
    database
        .run(
            "INSERT INTO project_blobs (project, digest, uses, kind)
             SELECT project, dataset, count(*), 'dataset' FROM jobs GROUP BY 1, 2",
        )
        .await;
    database.run("ANALYZE").await;
    let scans = async || {
        // Statistics are those of connections that have ended.
        let scans = "SELECT CAST(COALESCE(sum(seq_scan), 0) AS bigint) FROM pg_stat_user_tables
            WHERE relname = 'jobs'";
        tokio::time::sleep(Duration::from_secs(2)).await;
        database.number(scans).await
    };
    let before = scans().await;
    let store = open(&database).await;
    let project = "10000000-0000-0000-0000-000000000007".parse().expect("an id");
    for round in 0..8 {
        let created =
            store.create_job(NewJob { project, ..new_job(round, dataset()) }).await.expect("created");
        assert!(created.queue_position.expect("queued") >= 1);
        let claim = store.claim("worker").await.expect("a claim").expect("a job");
        store.heartbeat(&claim.lease).await.expect("renewed");
        store.finish(&claim.lease, Outcome::Released).await.expect("released");
        for filter in [
            JobFilter::default(),
            JobFilter { project: Some(project), ..JobFilter::default() },
            JobFilter { project: Some(project), states: vec![JobState::Queued], ..JobFilter::default() },
            JobFilter { project: Some(project), name: Some("job 6".into()), ..JobFilter::default() },
        ] {
            assert!(!store.jobs(&filter, None, 20).await.expect("read").is_empty());
        }
        store.fail_expired().await.expect("looked");
        store.expire_leases().await.expect("looked");
        store.expire_worker("another", tcgs::store::WorkerDeath::Alone).await.expect("looked");
        store.stats().await.expect("read");
        store.project_usage(Some(project), None, 1).await.expect("read");
        store.newest_events(&[created.job.id]).await.expect("read");
        store.forget_blobs(&[dataset().digest]).await.expect("looked");
        store.cancel(created.job.id).await.expect("cancelled");
        store.delete_job(created.job.id, None).await.expect("deleted");
        // Every second of the 100 000 ended long ago.
        let day = Duration::from_secs(24 * 3600);
        let removed = store.remove_ended_jobs(day, None).await.expect("removed");
        let further = store.remove_ended_jobs(day, removed.next).await.expect("removed");
        assert_eq!((removed.count, further.count), (10, 10));
        store.remove_expired_records(Some(day)).await.expect("looked");
    }
    store.close().await;
    let after = scans().await;
    assert_eq!(
        after - before,
        0,
        "tables were read whole: {:?}",
        database
            .rows("SELECT relname, seq_scan FROM pg_stat_user_tables WHERE seq_scan > 0 ORDER BY 1", 2)
            .await
    );
}

/// Rows of changes are added up when garbage is collected, and the sums stay the same.
#[tokio::test]
async fn changes_of_totals_are_folded_into_them() {
    let Some(database) = database().await else { return };
    let store = open(&database).await;
    for number in 0..5 {
        store.create_job(new_job(number, dataset())).await.expect("created");
        let claim = store.claim("worker").await.expect("a claim").expect("a job");
        store.finish(&claim.lease, Outcome::Cancelled).await.expect("ended");
    }
    let before = store.stats().await.expect("read");
    assert_eq!((before.claims, before.blobs, before.blob_bytes), (5, 1, 7));
    let changes = "SELECT (SELECT count(*) FROM total_changes) + (SELECT count(*) FROM counter_changes)";
    assert!(database.number(changes).await > 5);
    for _ in 0..2 {
        store.expire_uploads(jiff::Timestamp::UNIX_EPOCH).await.expect("collected");
        assert_eq!(database.number(changes).await, 0);
        assert_eq!(store.stats().await.expect("read"), before);
    }
}
