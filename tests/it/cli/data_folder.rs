//! The data folder of a service: who brings its schema up to date, and who may read it. On the real program.

use std::{borrow::Cow, path::Path, process::Stdio};

use sqlx::{
    ConnectOptions as _, Row as _,
    migrate::Migrator,
    sqlite::{SqliteConnectOptions, SqliteConnection},
};
use tcgs::store::migrations::SQLITE as ALL;

use crate::support::{
    program::{self, answers, succeeds, tcgs},
    service::Service,
};

fn newest() -> i64 {
    ALL.iter().map(|migration| migration.version).max().expect("there are some")
}

async fn database(data: &Path) -> SqliteConnection {
    let path = data.join("tcgs.sqlite");
    SqliteConnectOptions::new().filename(path).create_if_missing(true).connect().await.expect("a database")
}

async fn version(data: &Path) -> i64 {
    let row =
        sqlx::query("SELECT max(version) FROM _sqlx_migrations").fetch_one(&mut database(data).await).await;
    row.expect("a schema").get(0)
}

/// The arguments with the data folder.
fn at<'a>(data: &'a Path, arguments: &[&'a str]) -> Vec<&'a str> {
    [arguments, &["--data", data.to_str().expect("UTF-8")]].concat()
}

#[test]
fn eight_processes_that_open_a_fresh_folder_at_once_all_succeed() {
    for _ in 0..3 {
        let folder = tempfile::tempdir().expect("a folder");
        let data = folder.path().join("data");
        let begin = |number: usize| {
            let key = &["keys", "create", "--name", "first"];
            let arguments: &[&str] = if number.is_multiple_of(2) { key } else { &["migrate"] };
            let mut command = program::command();
            command.args(at(&data, arguments)).stdout(Stdio::piped()).stderr(Stdio::piped());
            command.spawn().expect("the binary runs")
        };
        let all: Vec<_> = (0..8).map(begin).collect();
        for (number, child) in all.into_iter().enumerate() {
            let output = child.wait_with_output().expect("ended");
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(0), "process {number}: {said}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_the_service_and_migrate_change_an_older_schema() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path();
    let old = newest() - 1;
    let known = ALL.iter().filter(|migration| migration.version <= old).cloned().collect();
    let migrator = Migrator { migrations: Cow::Owned(known), ..Migrator::DEFAULT };
    migrator.run(&mut database(data).await).await.expect("the schema of that time");

    for arguments in [&["keys", "list"][..], &["worker"]] {
        let output = tcgs(at(data, arguments));
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(4), "{arguments:?}: {said}");
        assert!(said.contains("older") && said.contains("tcgs migrate"), "{arguments:?}: {said}");
        assert_eq!(version(data).await, old, "{arguments:?}");
    }
    let change = answers(at(data, &["migrate", "--json"]));
    assert_eq!(change, serde_json::json!({ "from": old, "to": newest() }));
    assert!(succeeds(at(data, &["migrate"])).contains("already"));
    succeeds(at(data, &["keys", "list"]));

    sqlx::query("UPDATE _sqlx_migrations SET version = version + 1 WHERE version = ?")
        .bind(newest())
        .execute(&mut database(data).await)
        .await
        .expect("written");
    for arguments in [&["keys", "list"][..], &["worker"], &["migrate"], &["serve", "--listen", "127.0.0.1:0"]]
    {
        let output = tcgs(at(data, arguments));
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(4), "{arguments:?}: {said}");
        assert!(said.contains("newer"), "{arguments:?}: {said}");
    }
    assert_eq!(version(data).await, newest() + 1);
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_service_keeps_is_its_users_alone() {
    use std::{
        fs::{Permissions, read_dir, set_permissions, symlink_metadata, write},
        os::unix::fs::PermissionsExt as _,
        path::PathBuf,
    };

    use crate::support::dataset;

    fn everything(path: &Path, found: &mut Vec<(PathBuf, u32)>) {
        let metadata = symlink_metadata(path).expect("there");
        found.push((path.to_owned(), metadata.permissions().mode() & 0o7777));
        if metadata.is_dir() {
            read_dir(path)
                .expect("a folder")
                .for_each(|entry| everything(&entry.expect("an entry").path(), found));
        }
    }
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path().join("data");
    let expect_private = || {
        let mut found = Vec::new();
        everything(&data, &mut found);
        assert!(found.len() > 8, "{found:?}");
        for (path, mode) in found {
            let wanted = if path.is_dir() { 0o700 } else { 0o600 };
            assert_eq!(mode, wanted, "{}: {mode:o}", path.display());
        }
    };
    let start = || Service::start_with(&data, ["--workers", "0"]);
    let service = start().await;
    service.upload("", dataset::zip()).await.expect(201);
    expect_private();
    assert!(!service.log().contains("others had access"), "{}", service.log());
    service.stop().await;

    let outside = folder.path().join("outside");
    write(&outside, "not of the folder").expect("written");
    set_permissions(&outside, Permissions::from_mode(0o644)).expect("set");
    std::os::unix::fs::symlink(&outside, data.join("link")).expect("linked");
    let mut found = Vec::new();
    everything(&data, &mut found);
    for (path, mode) in found.into_iter().filter(|(path, _)| !path.is_symlink()) {
        let wide = if path.is_dir() { 0o755 } else { 0o644 };
        assert_ne!(mode, wide);
        set_permissions(&path, Permissions::from_mode(wide)).expect("set");
    }
    let service = start().await;
    std::fs::remove_file(data.join("link")).expect("removed");
    expect_private();
    let mode = outside.metadata().expect("there").permissions().mode();
    assert_eq!(mode & 0o777, 0o644, "what a link leads to is not the folder's");
    let log = service.log();
    assert!(log.contains("others had access (0755)") && log.contains("others had access (0644)"), "{log}");
    service.stop().await;
}
