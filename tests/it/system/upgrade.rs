//! What an earlier version left in a data folder and in a PostgreSQL database goes on under this one. `scripts/upgrade_fixture.sh` made
//! `tests/upgrade` with that version's program.

use std::{
    fs::{self, File},
    io,
    path::Path,
};

use serde_json::Value;
use sqlx::{Connection as _, PgConnection};
use zip::ZipArchive;

use crate::support::{
    postgres::Cluster,
    program,
    service::Service,
    tree::{root, text},
};

/// Unpacks a data folder, as the cut left it.
fn unpack(name: &str, folder: &Path) {
    let archive = File::open(root().join("tests/upgrade").join(name)).expect("the fixture");
    let mut archive = ZipArchive::new(archive).expect("a zip");
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).expect("an entry");
        let path = folder.join(entry.enclosed_name().expect("a place in the folder"));
        if entry.is_dir() {
            fs::create_dir_all(path).expect("made");
        } else {
            io::copy(&mut entry, &mut File::create(path).expect("made")).expect("unpacked");
        }
    }
}

/// Reads and decodes the file of a finished job.
async fn file(service: &Service, job: &str) {
    let answer = service.get(&format!("{job}/artifact")).await.expect(200);
    tcgs::codec::decode(&answer.body, &tcgs::codec::DecodeLimits::default()).expect("a file");
}

/// All three jobs end well: one had ended, one goes on from its checkpoint, one begins.
async fn goes_on(service: Service) {
    let listed = service.get("/v1/jobs").await.expect(200).json();
    let jobs: Vec<&Value> = listed["jobs"].as_array().expect("jobs").iter().rev().collect();
    assert_eq!(jobs.len(), 3, "{listed:#}");
    let path = |job: &Value| format!("/v1/jobs/{}", job["id"].as_str().expect("an id"));
    let [finished, running, queued] = [0, 1, 2].map(|index| path(jobs[index]));

    assert_eq!(jobs[0]["state"], "succeeded");
    let before = jobs[0]["metrics"]["bytes"]["total"].as_u64();
    assert!(before.is_some_and(|bytes| bytes > 1000), "{:#}", jobs[0]);
    file(&service, &finished).await;
    service.get(&format!("{finished}/report")).await.expect(200);
    service.get(&format!("{finished}/view?frame=images/view_06.png&width=16&height=16")).await.expect(200);

    let resumed = service.succeeded(&running).await;
    assert_eq!(resumed["attempt"], 2, "{resumed:#}");
    assert!(service.log().contains("resuming from step"), "{}", service.log());
    service.succeeded(&queued).await;
    for job in [&running, &queued] {
        file(&service, job).await;
    }
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_data_folder_of_an_earlier_version_goes_on() {
    let data = tempfile::tempdir().expect("a folder");
    unpack("data.zip", data.path());
    goes_on(Service::start(data.path()).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_postgresql_database_of_an_earlier_version_goes_on() {
    let Some(cluster) = Cluster::shared() else { return };
    let database = cluster.empty_database().await;
    let url = database.url();
    let mut connection = PgConnection::connect(url.expose()).await.expect("a connection");
    // Commands of psql are not SQL.
    let dump = text("tests/upgrade/postgres.sql");
    let dump: String = dump.split_inclusive('\n').filter(|line| !line.starts_with('\\')).collect();
    sqlx::raw_sql(sqlx::AssertSqlSafe(dump)).execute(&mut connection).await.expect("the dump runs");
    connection.close().await.expect("closed");

    let data = tempfile::tempdir().expect("a folder");
    unpack("shared.zip", data.path());
    let mut migrate = program::command();
    migrate.arg("migrate").env("TCGS_DATABASE", url.expose()).arg("--data").arg(data.path());
    assert!(migrate.status().expect("the binary runs").success());
    let environment = [("TCGS_DATABASE", url.expose().to_owned())];
    goes_on(Service::start_in(data.path(), std::iter::empty::<&str>(), &environment).await).await;
}
