//! Backups of a service that runs, their restoration, and the check of a data folder. On the real program.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use serde_json::Value;
use tcgs::domain::{Clock as _, SystemClock};

use crate::support::{
    dataset,
    program::{answers, succeeds, tcgs},
    service::Service,
};

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// The path of a blob in a folder.
fn blob(folder: &Path, digest: &str) -> PathBuf {
    folder.join("blobs/sha256").join(&digest[..2]).join(&digest[2..4]).join(digest)
}

/// A zip with other content than [`dataset::zip`].
fn another_dataset(number: usize) -> Vec<u8> {
    dataset::padded_zip(number)
}

async fn job(service: &Service, zip: Vec<u8>) -> (String, String) {
    let made = service.upload("?name=kept", zip).await.expect(201);
    let digest = made.json()["dataset"]["sha256"].as_str().expect("a digest").to_owned();
    (made.header("location").to_owned(), digest)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_of_a_running_service_is_restored_as_it_was() {
    let folder = tempfile::tempdir().expect("a folder");
    let [data, backup, copied, restored] =
        ["data", "backup", "copied", "restored"].map(|name| folder.path().join(name));
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    let (kept, digest) = job(&service, dataset::zip()).await;
    let (deleted, _) = job(&service, another_dataset(1)).await;
    service.send("POST", &format!("{deleted}/cancel"), |request| request).await.expect(200);
    service.send("DELETE", &deleted, |request| request).await.expect(204);
    let begun = service.send("POST", "/v1/uploads", |request| {
        request.header("tus-resumable", "1.0.0").header("upload-length", 9)
    });
    let upload = begun.await.expect(201).header("location").to_owned();

    // Others write meanwhile.
    let wanted = [text(&backup).to_owned(), text(&data).to_owned()];
    let running = tokio::task::spawn_blocking(move || {
        answers(["backup", wanted[0].as_str(), "--data", wanted[1].as_str(), "--json"])
    });
    let mut number = 2;
    while !running.is_finished() {
        job(&service, another_dataset(number)).await;
        number += 1;
    }
    let note = running.await.expect("ended");
    assert!(note["blobs"].as_u64().is_some_and(|blobs| blobs >= 1), "{note}");
    succeeds(["backup", text(&copied), "--data", text(&data), "--copy"]);
    let found = answers(["fsck", "--data", text(&data), "--json"]);
    assert_eq!((&found["missing"], &found["damaged"]), (&Value::Array(vec![]), &Value::Array(vec![])));
    service.stop().await;

    let same = answers(["restore", text(&backup), "--data", text(&restored), "--json"]);
    assert_eq!(same, note);
    let report = answers(["fsck", "--data", text(&restored), "--json"]);
    assert_eq!((&report["blobs"], &report["bytes"]), (&note["blobs"], &note["bytes"]));
    let service = Service::start_with(&restored, ["--workers", "0"]).await;
    let shown = service.get(&kept).await.expect(200).json();
    assert_eq!((&shown["state"], &shown["name"]), (&"queued".into(), &"kept".into()));
    service.get(&deleted).await.expect_problem(404, "job-not-found");
    let part = service.send("HEAD", &upload, |request| request.header("tus-resumable", "1.0.0"));
    assert_eq!(part.await.status, 410, "uploads that were open are over");
    job(&service, another_dataset(200)).await;
    service.stop().await;
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    service.get(&kept).await.expect(200);
    service.stop().await;

    // What is no backup, or a damaged one, is not restored.
    let again = tcgs(["restore", text(&backup), "--data", text(&restored)]);
    assert_eq!(again.status.code(), Some(3), "the folder is not empty");
    let onto = tcgs(["backup", text(&backup), "--data", text(&data)]);
    assert_eq!(onto.status.code(), Some(3), "there is a backup already");
    let fresh = folder.path().join("fresh");
    let mut bytes = fs::read(blob(&copied, &digest)).expect("the blob is copied");
    bytes[0] ^= 1;
    fs::write(blob(&copied, &digest), bytes).expect("written");
    let damaged = tcgs(["restore", text(&copied), "--data", text(&fresh)]);
    let shown = String::from_utf8_lossy(&damaged.stderr).into_owned();
    assert_eq!(damaged.status.code(), Some(1), "{shown}");
    assert!(shown.contains(&digest) && shown.contains("damaged"), "{shown}");
    assert!(!fresh.join("tcgs.sqlite").exists(), "a folder that is not restored has no database");
    fs::remove_file(blob(&backup, &digest)).expect("removed");
    let fresh = folder.path().join("fresh2");
    let missing = tcgs(["restore", text(&backup), "--data", text(&fresh)]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&missing.stderr).contains("missing"));
    fs::remove_file(backup.join("backup.json")).expect("removed");
    let fresh = folder.path().join("fresh3");
    let incomplete = tcgs(["restore", text(&backup), "--data", text(&fresh)]);
    assert_eq!(incomplete.status.code(), Some(3));
    let no_bucket = tcgs(["restore", text(&copied), "--data", text(&fresh), "--take-over-bucket"]);
    assert_eq!(no_bucket.status.code(), Some(2), "it takes over a bucket, and none is named");
    let nothing = tcgs(["backup", text(&folder.path().join("x")), "--data", text(&folder.path().join("y"))]);
    assert_eq!(nothing.status.code(), Some(3), "there is no service's data");
    assert!(blob(&data, &digest).exists(), "the backup's files are its own");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_check_names_what_is_missing_damaged_and_left_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path().join("data");
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    let mut digests = Vec::new();
    for zip in [dataset::zip(), another_dataset(1), another_dataset(2)] {
        digests.push(job(&service, zip).await.1);
    }
    service.stop().await;
    let check = |more: &[&str]| {
        let output = tcgs([&["fsck", "--data", text(&data), "--json"][..], more].concat());
        let report: Value = serde_json::from_slice(&output.stdout).expect("one JSON document");
        (output.status.code(), report)
    };
    let (status, report) = check(&[]);
    assert_eq!((status, &report["blobs"], &report["orphans"]), (Some(0), &3.into(), &Value::Array(vec![])));

    fs::remove_file(blob(&data, &digests[0])).expect("removed");
    let mut bytes = fs::read(blob(&data, &digests[1])).expect("read");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(blob(&data, &digests[1]), bytes).expect("written");
    let orphans = ["a", "b"].map(|digit| digit.repeat(64));
    for orphan in &orphans {
        fs::create_dir_all(blob(&data, orphan).parent().expect("a folder")).expect("made");
        fs::write(blob(&data, orphan), "left over").expect("written");
    }
    // The other one may just have been published.
    let file = File::options().write(true).open(blob(&data, &orphans[0])).expect("opened");
    let long_ago = SystemTime::from(SystemClock.now()) - Duration::from_secs(2 * 3600);
    file.set_modified(long_ago).expect("set");

    let (status, report) = check(&[]);
    assert_eq!(status, Some(1));
    assert_eq!(report["missing"], serde_json::json!([digests[0]]));
    assert_eq!(report["damaged"], serde_json::json!([digests[1]]));
    assert_eq!(report["orphans"], serde_json::json!([orphans[0]]));
    assert_eq!((&report["content_checked"], &report["database"]), (&true.into(), &Value::Array(vec![])));
    let (status, report) = check(&["--lengths"]);
    assert_eq!((status, &report["damaged"]), (Some(1), &Value::Array(vec![])));
    let shown = tcgs(["fsck", "--data", text(&data)]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(shown.contains(&format!("missing  {}", digests[0])) && shown.contains("1 orphan"), "{shown}");
    assert!(blob(&data, &orphans[0]).exists(), "it removes nothing");

    // Orphans alone do no harm.
    fs::remove_dir_all(&data).expect("removed");
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    service.stop().await;
    let (status, _) = check(&[]);
    assert_eq!(status, Some(0));
    assert_eq!(tcgs(["fsck", "--data", text(&folder.path().join("absent"))]).status.code(), Some(3));
}
