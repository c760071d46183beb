//! The guide's way to upgrade and back, from the data folder of an earlier version. On the real program.

use std::{
    borrow::Cow,
    fs,
    net::TcpListener,
    path::{Path, PathBuf},
};

use serde_json::{Value, json};
use sqlx::{
    ConnectOptions as _, Connection as _, PgConnection, Row as _,
    migrate::Migrator,
    sqlite::{SqliteConnectOptions, SqliteConnection},
};
use tcgs::{domain::Digest, store::migrations::POSTGRES};

use crate::support::{
    postgres::Cluster,
    program::{self, answers, tcgs},
    service::Service,
    tree::text,
};

/// The earlier version's schema, as `tests/schemas` has it.
const EARLIER: i64 = 15;
const FINISHED_JOB: &str = "/v1/jobs/01890a5d-ac96-774b-bcce-b302099a8057";

async fn database(folder: &Path) -> SqliteConnection {
    let options = SqliteConnectOptions::new().filename(folder.join("tcgs.sqlite")).create_if_missing(true);
    options.foreign_keys(false).connect().await.expect("a database")
}

async fn version(folder: &Path) -> i64 {
    let mut database = database(folder).await;
    let row = sqlx::query("SELECT max(version) FROM _sqlx_migrations").fetch_one(&mut database).await;
    row.expect("a schema").get(0)
}

/// A data folder as the earlier version left it. The dump's files were never anybody's, so each gets content of its length, and its digest.
async fn earlier_folder(folder: &Path) {
    fs::create_dir_all(folder).expect("made");
    let mut dump = text(&format!("tests/schemas/{EARLIER:04}.sql"));
    let rows: Vec<String> = dump
        .lines()
        .filter_map(|line| line.strip_prefix("INSERT INTO blobs VALUES('"))
        .map(Into::into)
        .collect();
    assert!(rows.len() >= 7, "{rows:?}");
    for (number, row) in rows.iter().enumerate() {
        let (digest, rest) = row.split_once("',").expect("a digest");
        let bytes: usize = rest.split(',').next().expect("a length").parse().expect("a number");
        let content: Vec<u8> = (0..bytes).map(|place| (place * 7 + number) as u8).collect();
        let own = Digest::of(&content).to_string();
        dump = dump.replace(digest, &own);
        let file = folder.join("blobs/sha256").join(&own[..2]).join(&own[2..4]).join(&own);
        fs::create_dir_all(file.parent().expect("a folder")).expect("made");
        fs::write(file, content).expect("written");
    }
    sqlx::raw_sql(sqlx::AssertSqlSafe(dump))
        .execute(&mut database(folder).await)
        .await
        .expect("the dump runs");
}

/// Every file below a folder, with its content.
fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.push((path.clone(), fs::read(path).expect("read")));
        }
    }
    found.sort();
    found
}

/// The arguments with the data folder.
fn at<'a>(data: &'a Path, arguments: &[&'a str]) -> Vec<&'a str> {
    [arguments, &["--data", data.to_str().expect("UTF-8")]].concat()
}

fn fails_with(arguments: &[&str], status: i32, word: &str) {
    let output = tcgs(arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {said}");
    assert!(said.contains(word), "{arguments:?}: {said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upgrade_keeps_everything_and_the_backup_before_it_leads_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let [data, backup, restored, other] =
        ["data", "backup", "restored", "other"].map(|name| folder.path().join(name));
    earlier_folder(&data).await;

    // The backup of before the upgrade, as the earlier program made it: its files, its database, and the note.
    earlier_folder(&backup).await;
    let blobs = files(&backup.join("blobs"));
    let bytes: usize = blobs.iter().map(|(_, content)| content.len()).sum();
    // The dump has a file that nothing refers to, which a backup leaves out.
    let note = |blobs: usize, bytes: usize| json!({ "taken_at": "2026-11-22T00:00:00Z", "version": "0.0.1", "blobs": blobs, "bytes": bytes });
    fs::write(backup.join("backup.json"), note(blobs.len(), bytes).to_string()).expect("written");

    // The new program leaves the older schema alone until it is told to migrate, also for a backup.
    let to = other.to_str().expect("UTF-8");
    for arguments in [&["backup", to][..], &["fsck"], &["keys", "list"]] {
        fails_with(&at(&data, arguments), 4, "older");
    }
    assert_eq!(version(&data).await, EARLIER);

    // The upgrade, by the service's start.
    let service = Service::start_with(&data, ["--workers", "0", "--without-keys"]).await;
    let job = service.get(FINISHED_JOB).await.expect(200).json();
    assert_eq!((&job["state"], &job["metrics"]["test"]["psnr"]), (&json!("succeeded"), &json!(30.5)));
    service.stop().await;
    let now = version(&data).await;
    assert!(now > EARLIER);
    let sound = |data: &Path| {
        let report = answers(at(data, &["fsck", "--json"]));
        let nothing = Value::Array(Vec::new());
        assert_eq!(
            (&report["missing"], &report["damaged"], &report["database"]),
            (&nothing, &nothing, &nothing)
        );
    };
    sound(&data);

    // The new program restores the older backup too, up to date. The backup itself stays what the earlier program reads.
    let before = files(&backup);
    let from = backup.to_str().expect("UTF-8");
    answers(at(&restored, &["restore", from, "--json"]));
    assert_eq!(version(&restored).await, now);
    sound(&restored);
    assert!(files(&backup) == before, "a restoration changes no file of the backup");
    assert_eq!(version(&backup).await, EARLIER);

    // The way back without a backup is refused: a program meets a schema of a later one, also in a backup, and changes nothing.
    for folder in [&data, &backup] {
        let later = "INSERT INTO _sqlx_migrations SELECT version + 1000, 'later', installed_on, success, checksum, execution_time
                     FROM _sqlx_migrations ORDER BY version DESC LIMIT 1";
        sqlx::query(later).execute(&mut database(folder).await).await.expect("written");
    }
    fs::remove_dir_all(&other).ok();
    for arguments in
        [&["serve", "--listen", "127.0.0.1:0"][..], &["worker"], &["migrate"], &["backup", to], &["fsck"]]
    {
        fails_with(&at(&data, arguments), 4, "newer");
    }
    fs::remove_dir_all(&other).ok();
    fails_with(&at(&other, &["restore", from]), 4, "newer");
    assert!(!other.join("tcgs.sqlite").exists(), "what is not restored has no database");
    assert_eq!(version(&data).await, now + 1000);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_cannot_start_changes_no_schema_and_makes_no_key() {
    let folder = tempfile::tempdir().expect("a folder");
    let [with_keys, without_keys, key] =
        ["with keys", "without keys", "first.key"].map(|name| folder.path().join(name));
    earlier_folder(&with_keys).await;
    // Of a time when there were no keys.
    fs::create_dir(&without_keys).expect("made");
    let dump = sqlx::AssertSqlSafe(text("tests/schemas/0001.sql"));
    sqlx::raw_sql(dump).execute(&mut database(&without_keys).await).await.expect("the dump runs");

    let running = TcpListener::bind("127.0.0.1:0").expect("a port");
    let taken = running.local_addr().expect("bound").to_string();
    let first_key = ["--bootstrap-admin-key-file", key.to_str().expect("UTF-8")];
    let free = ["--listen", "127.0.0.1:0"];
    for (data, earlier) in [(&with_keys, EARLIER), (&without_keys, 1)] {
        for (flags, named) in [
            (&["--listen", &*taken][..], "another program listens on"),
            (&[&free[..], &["--adapter", "there is none"]].concat(), "there is none"),
        ] {
            let serve = ["serve", "--workers", "0"];
            fails_with(&at(data, &[&serve, flags, &first_key].concat()), 4, named);
            assert_eq!(version(data).await, earlier, "{named}");
            assert!(!key.exists(), "{named}");
        }
    }
    fs::write(&key, "not a key").expect("written");
    let arguments = [&["serve", "--workers", "0"], &free[..], &first_key].concat();
    fails_with(&at(&without_keys, &arguments), 2, "holds no key");
    assert_eq!(version(&without_keys).await, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_schema_of_postgresql_changes_by_migrate_alone_and_a_newer_one_is_refused() {
    let Some(cluster) = Cluster::shared() else { return };
    let server = cluster.empty_database().await;
    let newest = POSTGRES.iter().map(|migration| migration.version).max().expect("there are some");
    let known = POSTGRES.iter().filter(|migration| migration.version < newest).cloned().collect();
    let earlier = Migrator { migrations: Cow::Owned(known), ..Migrator::DEFAULT };
    let url = server.url();
    let mut connection = PgConnection::connect(url.expose()).await.expect("a connection");
    earlier.run(&mut connection).await.expect("the schema of that time");
    let folder = tempfile::tempdir().expect("a folder");
    let run = |arguments: &[&str]| {
        let mut command = program::command();
        command.args(arguments).env("TCGS_DATABASE", url.expose()).arg("--data").arg(folder.path());
        let output = command.output().expect("the binary runs");
        let said = [output.stdout, output.stderr].concat();
        (output.status.code(), String::from_utf8_lossy(&said).into_owned())
    };
    let (status, said) = run(&["keys", "list"]);
    assert!(status == Some(4) && said.contains("older") && said.contains("tcgs migrate"), "{said}");
    let (status, said) = run(&["migrate", "--json"]);
    assert_eq!(status, Some(0), "{said}");
    let change: Value = serde_json::from_str(&said).expect("one JSON document");
    assert_eq!(change, json!({ "from": newest - 1, "to": newest }));
    assert_eq!(run(&["keys", "list"]).0, Some(0));
    let later = "UPDATE _sqlx_migrations SET version = version + 1 WHERE version = $1";
    sqlx::query(later).bind(newest).execute(&mut connection).await.expect("written");
    for arguments in [&["keys", "list"][..], &["migrate"], &["serve", "--listen", "127.0.0.1:0"]] {
        let (status, said) = run(arguments);
        assert!(status == Some(4) && said.contains("newer"), "{arguments:?}: {said}");
    }
}
