//! Backups of a folder while what is in it changes.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use bytes::Bytes;
use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{Clock, JobId, SystemClock, TrainOptions},
    store::{
        BackupError, BackupNote, BlobRef, BlobSource, Blobs, CopyMode, DATABASE, NewJob, QueuePolicy, Store,
        back_up, restore,
    },
};
use tempfile::TempDir;
use tokio::{runtime::Handle, task::block_in_place};
use uuid::Uuid;

/// A data folder.
#[derive(Clone)]
struct DataFolder {
    store: Store,
    blobs: Blobs,
}

/// A clock that says how often it was asked before, to whoever changes something then.
struct InterruptingClock<F> {
    asked: AtomicU32,
    interrupt: F,
}

impl<F: Fn(u32) + Send + Sync + 'static> Clock for InterruptingClock<F> {
    fn now(&self) -> Timestamp {
        (self.interrupt)(self.asked.fetch_add(1, Ordering::SeqCst));
        SystemClock.now()
    }

    fn elapsed(&self) -> Duration {
        SystemClock.elapsed()
    }
}

/// Does `work` in the middle of another task's.
fn in_between<T>(work: impl Future<Output = T>) -> T {
    block_in_place(|| Handle::current().block_on(work))
}

impl DataFolder {
    async fn open(data: &Path) -> Self {
        fs::create_dir_all(data).expect("made");
        let store = Store::open(&data.join(DATABASE), Arc::new(SystemClock), QueuePolicy::default()).await;
        Self { store: store.expect("a database"), blobs: Blobs::open(data).expect("a store") }
    }

    async fn job(&self, number: u128, content: &'static str) -> BlobRef {
        let dataset = self.blobs.put(Bytes::from_static(content.as_bytes())).await.expect("published");
        let id = JobId(Uuid::from_u128(number));
        self.store.create_job(NewJob::new(id, TrainOptions::default(), dataset)).await.expect("queued");
        self.store.cancel(id).await.expect("cancelled");
        dataset
    }

    async fn delete(&self, number: u128) {
        self.store.delete_job(JobId(Uuid::from_u128(number)), None).await.expect("deleted");
    }

    async fn remove_file(&self, blob: BlobRef) {
        let removed = self.blobs.remove_older(blob.digest, SignedDuration::ZERO, Timestamp::MAX).await;
        assert_eq!(removed.expect("asked"), Some(blob.bytes));
    }

    /// As garbage collection does.
    async fn forget(&self, blob: BlobRef) {
        assert_eq!(self.store.forget_blobs(&[blob.digest]).await.expect("asked"), [blob.digest]);
        self.remove_file(blob).await;
    }

    async fn back_up(&self, to: &Path, clock: Arc<dyn Clock>) -> Result<BackupNote, BackupError> {
        back_up(&self.store, &BlobSource::Store(self.blobs.clone()), to, CopyMode::Link, clock).await
    }
}

/// The folder of a test, and the names of what it makes there.
fn folders() -> (TempDir, [PathBuf; 3]) {
    let folder = tempfile::tempdir().expect("a folder");
    let names = ["data", "backup", "restored"].map(|name| folder.path().join(name));
    (folder, names)
}

/// The names of a database and its files beside it.
fn database_files(folder: &Path) -> BTreeSet<String> {
    let names = fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").file_name());
    names.filter_map(|name| name.into_string().ok()).filter(|name| name.starts_with(DATABASE)).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_leaves_out_what_is_deleted_while_it_is_made() {
    let (_folder, [data, backup, restored]) = folders();
    let from = DataFolder::open(&data).await;
    let (kept, deleted) = (from.job(1, "kept").await, from.job(2, "deleted").await);
    let meddled = from.clone();
    // First it is asked for the time of the snapshot, and then for that of the changes to it.
    let interrupt = move |asked| {
        if asked == 1 {
            in_between(async {
                meddled.delete(2).await;
                meddled.forget(deleted).await;
            });
        }
    };
    let clock = Arc::new(InterruptingClock { asked: AtomicU32::new(0), interrupt });
    let note = from.back_up(&backup, clock.clone()).await.expect("a backup");
    assert!(clock.asked.load(Ordering::SeqCst) > 2, "another snapshot was taken");
    assert_eq!((note.blobs, note.bytes), (1, kept.bytes));
    assert_eq!(database_files(&backup), BTreeSet::from([DATABASE.to_owned()]));

    assert_eq!(restore(&backup, &restored, None, Arc::new(SystemClock)).await.expect("restored"), note);
    assert_eq!(database_files(&restored), BTreeSet::from([DATABASE.to_owned()]));
    let to = DataFolder::open(&restored).await;
    let states = [1, 2].map(|number| to.store.job(JobId(Uuid::from_u128(number))));
    let [found, gone] = states;
    assert!(found.await.expect("read").is_some() && gone.await.expect("read").is_none());
    assert_eq!(to.blobs.read(kept.digest).await.expect("there"), b"kept".as_slice());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_is_given_up_after_five_snapshots_whose_files_were_removed() {
    let (_folder, [data, backup, _]) = folders();
    let from = DataFolder::open(&data).await;
    from.job(1, "kept").await;
    let meddled = from.clone();
    let interrupt = move |asked| {
        in_between(async {
            if asked % 2 == 0 {
                let short_lived = meddled.job(2, "short-lived").await;
                meddled.remove_file(short_lived).await;
            } else {
                meddled.delete(2).await;
            }
        });
    };
    let clock = Arc::new(InterruptingClock { asked: AtomicU32::new(0), interrupt });
    let failed = tokio::time::timeout(Duration::from_secs(60), from.back_up(&backup, clock.clone())).await;
    let failed = failed.expect("it does not try for ever").expect_err("a file is missing");
    assert!(matches!(failed, BackupError::Missing { .. }), "{failed:?}");
    assert_eq!(clock.asked.load(Ordering::SeqCst), 10);
}

#[tokio::test]
async fn a_backup_that_is_not_what_its_note_says_is_not_restored() {
    let (_folder, [data, backup, restored]) = folders();
    let from = DataFolder::open(&data).await;
    from.job(1, "kept").await;
    let note = from.back_up(&backup, Arc::new(SystemClock)).await.expect("a backup");
    let path = backup.join("backup.json");
    for wrong in [BackupNote { blobs: 2, ..note.clone() }, BackupNote { bytes: 3, ..note.clone() }] {
        fs::write(&path, serde_json::to_vec(&wrong).expect("JSON")).expect("written");
        let refused = restore(&backup, &restored, None, Arc::new(SystemClock)).await;
        assert!(matches!(refused, Err(BackupError::Incomplete(_))), "{refused:?}");
        assert!(!restored.join(DATABASE).exists());
        fs::remove_dir_all(&restored).expect("removed");
    }
}
