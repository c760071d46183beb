//! What the service has acknowledged is on disk: a library that is preloaded into it lists the files that it syncs.

#![cfg(target_os = "linux")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use crate::support::{dataset, program, service::Service, skip::skip};

/// Compiles the library; none without a C compiler.
fn library(folder: &Path) -> Option<PathBuf> {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/it/support/sync_log.c");
    let library = folder.join("sync_log.so");
    let Ok(status) =
        Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).args([source, "-ldl"]).status()
    else {
        skip("cc is not installed");
        return None;
    };
    assert!(status.success(), "{source} does not compile");
    Some(library)
}

/// Files that were synced since it was asked last.
struct SyncLog {
    path: PathBuf,
    read: usize,
}

impl SyncLog {
    fn news(&mut self) -> Vec<PathBuf> {
        let text = fs::read_to_string(&self.path).unwrap_or_default();
        let lines: Vec<PathBuf> = text.lines().skip(self.read).map(PathBuf::from).collect();
        self.read += lines.len();
        lines
    }
}

/// A file below the folder, not the folder itself.
#[track_caller]
fn assert_synced_below(synced: &[PathBuf], folder: &Path, what: &str) {
    let found =
        synced.iter().any(|path| path.starts_with(folder) && path.extension() != Some("lock".as_ref()));
    assert!(found, "{what}: nothing below {} among {synced:?}", folder.display());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_acknowledged_is_synced_first() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(library) = library(folder.path()) else { return };
    // As the kernel names it.
    let root = folder.path().canonicalize().expect("a path");
    let (data, mut log) = (root.join("data"), SyncLog { path: root.join("synced"), read: 0 });
    let mut command = program::command();
    command.env("LD_PRELOAD", library).env("SYNC_LOG", &log.path);
    let service = Service::start_as(command, &data, ["--workers", "0"]).await;

    log.news();
    let created = service.upload("", dataset::zip()).await.expect(201);
    let synced = log.news();
    // A blob is synced under the name that it was received by, then the folder that holds its own.
    assert_synced_below(&synced, &data.join("staging"), "the dataset's content");
    assert_synced_below(&synced, &data.join("blobs"), "the dataset's name");
    let wal = |path: &PathBuf| path.to_string_lossy().ends_with("-wal");
    assert!(synced.iter().any(wal), "the job's row: {synced:?}");

    // One transaction, which SQLite would leave to the next checkpoint where `synchronous` is less than FULL.
    let job = created.header("location").to_owned();
    service.send("POST", &format!("{job}/cancel"), |request| request).await.expect(200);
    let synced = log.news();
    assert!(synced.iter().any(wal), "the cancellation: {synced:?}");

    let tus = |request: reqwest::RequestBuilder| request.header("tus-resumable", "1.0.0");
    let begun = service.send("POST", "/v1/uploads", |request| tus(request).header("upload-length", 9)).await;
    let upload = begun.expect(201).header("location").to_owned();
    log.news();
    let part = service.send("PATCH", &upload, |request| {
        let request = tus(request).header("upload-offset", 0);
        request.header("content-type", "application/offset+octet-stream").body("four")
    });
    part.await.expect(204);
    assert_synced_below(&log.news(), &data.join("uploads"), "a part of an upload");
    assert!(service.stop().await.success());
}
