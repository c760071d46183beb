//! Garbage collection removes unreferenced blobs and ended uploads, and nothing else; the name of this module says where blobs are.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use jiff::SignedDuration;
use tcgs::{
    domain::{
        Clock, DatasetId, DatasetSummary, JobId, Layout, ManualClock, ProjectId, SystemClock, TrainOptions,
        UploadId,
    },
    store::{
        BlobError, BlobRef, Blobs, NewDataset, NewJob, NewUpload, QueuePolicy, Store,
        garbage::{Collected, GarbagePolicy, collect, collect_garbage, withdraw},
    },
};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::support::{bucket::S3Server, database::Database};

/// Longest wait for a collection.
const LONGEST: Duration = Duration::from_secs(120);
const GRACE: SignedDuration = SignedDuration::from_hours(1);

struct Fixture {
    store: Store,
    blobs: Blobs,
    /// Starts at the system time, which dates files.
    clock: Arc<ManualClock>,
    folder: TempDir,
    database: Database,
}

impl Fixture {
    async fn new() -> Option<Self> {
        let database = super::database().await?;
        let folder = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(ManualClock::new(SystemClock.now()));
        let store = database.open(clock.clone(), QueuePolicy::default()).await;
        let blobs = if module_path!().ends_with("in_bucket") {
            let server = S3Server::shared()?;
            let bucket = server.connect(&server.prefix());
            Blobs::open_bucket(folder.path(), bucket, store.clone()).await.expect("a bucket")
        } else {
            Blobs::open(folder.path()).expect("a blob store")
        };
        Some(Self { store, blobs, clock, folder, database })
    }

    async fn put(&self, content: &'static str) -> BlobRef {
        self.blobs.put(Bytes::from_static(content.as_bytes())).await.expect("published")
    }

    async fn is_there(&self, blob: BlobRef) -> bool {
        match self.blobs.read(blob.digest).await {
            Ok(_) => true,
            Err(BlobError::Missing(_)) => false,
            Err(error) => panic!("{error}"),
        }
    }

    /// Waits until a collection has removed a blob.
    async fn gone(&self, blob: BlobRef) {
        let gone = async {
            while self.is_there(blob).await {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONGEST, gone).await.expect("it is collected");
    }

    async fn keep(&self, dataset: BlobRef) -> DatasetId {
        let summary = DatasetSummary {
            layout: Layout::Blender,
            train: 1,
            test: 0,
            pixels: 1,
            points: None,
            notes: Vec::new(),
        };
        let id = DatasetId(Uuid::new_v4());
        let new = NewDataset {
            id,
            project: ProjectId::DEFAULT,
            name: None,
            dataset,
            summary,
            upload: None,
            intent: None,
        };
        self.store.create_dataset(new).await.expect("kept").record().id
    }

    async fn delete(&self, scene: DatasetId) {
        self.store.delete_dataset(scene, None).await.expect("asked").expect("known");
    }

    async fn collect_once(&self) -> Collected {
        let policy = GarbagePolicy { blob_grace: GRACE, ..GarbagePolicy::default() };
        collect(&self.store, &self.blobs, &policy, self.clock.now()).await.expect("collected")
    }

    fn pass(&self, minutes: i64) {
        self.clock.advance(SignedDuration::from_mins(minutes));
    }

    /// Dates a blob back, as if its publication had been long ago.
    async fn date_back(&self, blob: BlobRef) {
        if module_path!().ends_with("in_bucket") {
            let digest = blob.digest;
            self.database
                .run(&format!("UPDATE publications SET published_at = 0 WHERE digest = '{digest}'"))
                .await;
            return;
        }
        let file = self.blobs.local_copy(blob.digest).await.expect("what a scene refers to is there");
        let file = std::fs::File::options().write(true).open(file.path()).expect("writable");
        file.set_modified(std::time::SystemTime::UNIX_EPOCH).expect("dated back");
    }
}

#[tokio::test]
async fn an_unreferenced_blob_stays_for_the_grace_time() {
    let Some(fixture) = Fixture::new().await else { return };
    let [lost, kept, late] =
        [fixture.put("lost").await, fixture.put("kept").await, fixture.put("late").await];
    let scene = fixture.keep(kept).await;
    fixture.pass(59);
    assert_eq!(fixture.collect_once().await, Collected::default());
    fixture.keep(late).await;
    fixture.pass(2);
    assert_eq!(fixture.collect_once().await, Collected { blobs: 1, bytes: 4, uploads: 0 });
    assert!(!fixture.is_there(lost).await && fixture.is_there(kept).await && fixture.is_there(late).await);
    fixture.delete(scene).await;
    assert_eq!(fixture.collect_once().await.blobs, 1, "it was published long ago");
    assert!(!fixture.is_there(kept).await);
    assert_eq!(fixture.collect_once().await, Collected::default());
}

#[tokio::test]
async fn staging_files_of_dead_processes_are_removed_and_those_of_live_ones_stay() {
    let Some(fixture) = Fixture::new().await else { return };
    let mut staging = fixture.blobs.stage(100).await.expect("room");
    staging.write(b"half").await.expect("written");
    let left = fixture.folder.path().join("staging/process-of-another");
    std::fs::create_dir(&left).expect("made");
    std::fs::write(left.join("upload-half"), "half").expect("written");
    fixture.collect_once().await;
    assert!(!left.exists());
    let staged = staging.finish().await.expect("whole");
    assert_eq!(fixture.blobs.publish(&staged).await.expect("published").blob.bytes, 4);
}

#[tokio::test]
async fn an_unused_publication_is_withdrawn_unless_something_refers_to_it() {
    let Some(fixture) = Fixture::new().await else { return };
    let publish =
        async |content: &'static str| fixture.blobs.put_new(content.into()).await.expect("published");
    let (lost, kept) = (publish("lost").await, publish("kept").await);
    fixture.keep(kept.blob).await;
    let withdraw =
        async |published| withdraw(&fixture.store, &fixture.blobs, published).await.expect("asked");
    assert!(withdraw(lost).await && !withdraw(kept).await);
    assert!(!fixture.is_there(lost.blob).await && fixture.is_there(kept.blob).await);
}

#[tokio::test]
async fn a_job_keeps_its_archive_after_the_dataset_is_deleted() {
    let Some(fixture) = Fixture::new().await else { return };
    let dataset = fixture.put("dataset").await;
    let scene = fixture.keep(dataset).await;
    let new = NewJob::new(JobId(Uuid::from_u128(1)), TrainOptions::default(), dataset);
    fixture.store.create_job(NewJob { dataset_id: Some(scene), ..new }).await.expect("queued");
    fixture.store.cancel(JobId(Uuid::from_u128(1))).await.expect("cancelled");
    fixture.delete(scene).await;
    fixture.pass(90);
    assert_eq!(fixture.collect_once().await, Collected::default());
    assert!(fixture.is_there(dataset).await);
}

#[tokio::test]
async fn a_file_that_cannot_be_removed_leaves_the_others_to_be_collected() {
    let Some(fixture) = Fixture::new().await else { return };
    if module_path!().ends_with("in_bucket") {
        return; // Its faults have a module of their own.
    }
    let blobs = [fixture.put("one").await, fixture.put("another").await, fixture.put("a third").await];
    for blob in blobs {
        fixture.date_back(blob).await;
    }
    // A folder is removed by no call that removes files.
    let stuck = blobs.iter().min_by_key(|blob| blob.digest.to_string()).expect("three");
    let path = fixture.blobs.local_copy(stuck.digest).await.expect("a file").path().to_owned();
    std::fs::remove_file(&path).expect("removed");
    std::fs::create_dir(&path).expect("made");
    std::fs::write(path.join("stuck"), "").expect("written");
    fixture.pass(61);
    let policy = GarbagePolicy { blob_grace: GRACE, ..GarbagePolicy::default() };
    let now = fixture.clock.now();
    collect(&fixture.store, &fixture.blobs, &policy, now).await.expect_err("one is left");
    for blob in blobs.iter().filter(|blob| *blob != stuck) {
        assert!(!fixture.is_there(*blob).await);
    }
}

#[tokio::test]
async fn a_temporary_file_that_cannot_be_removed_leaves_blobs_to_be_collected() {
    let Some(fixture) = Fixture::new().await else { return };
    if module_path!().ends_with("in_bucket") {
        return; // There are none in a bucket.
    }
    let blob = fixture.put("one").await;
    fixture.date_back(blob).await;
    let path = fixture.blobs.local_copy(blob.digest).await.expect("a file").path().to_owned();
    // A folder is removed by no call that removes files.
    let stuck = path.with_extension("#1");
    std::fs::create_dir(&stuck).expect("made");
    let opened = std::fs::File::open(&stuck).expect("opened");
    opened.set_modified(std::time::SystemTime::UNIX_EPOCH).expect("dated back");
    fixture.pass(61);
    let policy = GarbagePolicy { blob_grace: GRACE, ..GarbagePolicy::default() };
    let now = fixture.clock.now();
    collect(&fixture.store, &fixture.blobs, &policy, now).await.expect_err("one is left");
    assert!(!fixture.is_there(blob).await);
}

#[tokio::test]
async fn publishing_a_blob_again_renews_its_age() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = fixture.put("again").await;
    let scene = fixture.keep(blob).await;
    fixture.delete(scene).await;
    fixture.date_back(blob).await;
    // A collection has come this far when the blob is published again.
    let now = fixture.clock.now();
    let old = fixture.blobs.older_than(GRACE, now).await.expect("a list").all();
    assert_eq!(old.expect("all"), [blob.digest]);
    assert_eq!(fixture.store.forget_blobs(&[blob.digest]).await.expect("forgotten"), [blob.digest]);
    fixture.put("again").await;
    assert_eq!(fixture.blobs.remove_older(blob.digest, GRACE, now).await.expect("asked"), None);
    fixture.keep(blob).await;
    assert_eq!(fixture.collect_once().await, Collected::default());
    assert!(fixture.is_there(blob).await);
}

#[tokio::test]
async fn a_collection_that_stopped_between_row_and_file_is_completed_by_the_next() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = fixture.put("half gone").await;
    let scene = fixture.keep(blob).await;
    fixture.delete(scene).await;
    assert_eq!(fixture.store.forget_blobs(&[blob.digest]).await.expect("forgotten"), [blob.digest]);
    fixture.pass(61);
    assert_eq!(fixture.collect_once().await.blobs, 1);
    fixture.put("half gone").await;
    fixture.keep(blob).await;
    assert!(fixture.is_there(blob).await);
}

/// One blob is published, referenced, dated back and released over and over, while collections run without pause. It is published again
/// at once, in the middle of a collection, or after a whole one, which has removed it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_referenced_blob_exists_however_collection_and_publication_interleave() {
    const TURNS: u32 = 60;
    let Some(fixture) = Fixture::new().await.map(Arc::new) else { return };
    let stop = CancellationToken::new();
    let (ended, mut rounds) = tokio::sync::watch::channel(0_u32);
    let collecting = tokio::spawn({
        let (fixture, stop) = (Arc::clone(&fixture), stop.clone());
        async move {
            let mut blobs = 0;
            while !stop.is_cancelled() {
                blobs += fixture.collect_once().await.blobs;
                ended.send_modify(|rounds| *rounds += 1);
            }
            blobs
        }
    });
    for turn in 0..TURNS {
        let blob = fixture.put("wanted and unwanted").await;
        let scene = fixture.keep(blob).await;
        fixture.date_back(blob).await;
        assert!(fixture.is_there(blob).await, "however old it is");
        fixture.delete(scene).await;
        // The round that is under way has perhaps not seen it; the next one does.
        let until = *rounds.borrow() + turn % 3;
        let waited = tokio::time::timeout(LONGEST, rounds.wait_for(|rounds| *rounds >= until)).await;
        waited.expect("rounds go on").expect("no collection failed");
    }
    stop.cancel();
    let collected =
        tokio::time::timeout(LONGEST, collecting).await.expect("it stops").expect("no collection failed");
    assert!(collected >= (TURNS / 3) as usize, "collected {collected} times");
}

#[tokio::test]
async fn files_of_ended_uploads_are_removed_unless_they_are_locked() {
    let Some(fixture) = Fixture::new().await else { return };
    let ids = [1, 2, 3].map(|number| UploadId(Uuid::from_u128(number)));
    for (id, minutes) in ids.into_iter().zip([10, 20, 30]) {
        let expires_at = fixture.clock.now() + SignedDuration::from_mins(minutes);
        let new = NewUpload { id, project: ProjectId::DEFAULT, length: 9, metadata: None, expires_at };
        fixture.store.create_upload(new).await.expect("begun");
        let mut file = fixture.blobs.open_upload(id).await.expect("opens").expect("free");
        file.continue_at(0).await.expect("at its beginning");
        file.write(b"half").await.expect("written");
        assert!(file.save(&fixture.store, 4, expires_at).await.expect("saved"));
    }
    fixture.pass(25);
    let held = fixture.blobs.open_upload(ids[1]).await.expect("opens").expect("free");
    assert_eq!(fixture.collect_once().await.uploads, 2);
    let mut left = fixture.blobs.uploads().await.expect("a list");
    left.sort();
    assert_eq!(left, ids[1..]);
    drop(held);
    assert_eq!(fixture.collect_once().await.uploads, 0);
    assert_eq!(fixture.blobs.uploads().await.expect("a list"), ids[2..]);
}

#[tokio::test]
async fn garbage_is_collected_until_shutdown_and_soon_after_a_request() {
    let Some(fixture) = Fixture::new().await else { return };
    // No round comes by itself after the first.
    let policy = GarbagePolicy {
        every: Duration::from_secs(24 * 3600),
        at_most_every: Duration::ZERO,
        blob_grace: GRACE,
        ..GarbagePolicy::default()
    };
    let first = fixture.put("there before the first round").await;
    fixture.pass(61);
    let stop = CancellationToken::new();
    let clock: Arc<dyn Clock> = fixture.clock.clone();
    let keeping = tokio::spawn(collect_garbage(
        fixture.store.clone(),
        fixture.blobs.clone(),
        clock,
        policy,
        stop.clone(),
    ));
    fixture.gone(first).await;
    for content in ["let go once", "let go again"] {
        let blob = fixture.put(content).await;
        fixture.pass(61);
        fixture.blobs.request_collection();
        fixture.gone(blob).await;
    }
    assert!(!keeping.is_finished(), "it goes on until it is told to stop");
    stop.cancel();
    tokio::time::timeout(LONGEST, keeping).await.expect("it stops").expect("in order");
    let kept = fixture.put("after the end").await;
    fixture.blobs.request_collection();
    assert!(fixture.is_there(kept).await);
}

#[tokio::test]
async fn a_collection_that_is_told_to_stop_leaves_the_rest_to_the_next() {
    let Some(fixture) = Fixture::new().await else { return };
    let blobs = [fixture.put("one").await, fixture.put("another").await];
    fixture.pass(61);
    let policy = GarbagePolicy { blob_grace: GRACE, ..GarbagePolicy::default() };
    let stop = CancellationToken::new();
    stop.cancel();
    let clock: Arc<dyn Clock> = fixture.clock.clone();
    let collecting = collect_garbage(fixture.store.clone(), fixture.blobs.clone(), clock, policy, stop);
    tokio::time::timeout(LONGEST, collecting).await.expect("it stops");
    for blob in blobs {
        assert!(fixture.is_there(blob).await);
    }
    assert_eq!(fixture.collect_once().await.blobs, blobs.len());
}

#[tokio::test]
async fn rounds_of_collection_keep_their_distance() {
    let day = Duration::from_secs(24 * 3600);
    let policy = |at_most_every| GarbagePolicy {
        every: day,
        at_most_every,
        blob_grace: GRACE,
        ..GarbagePolicy::default()
    };
    // Without a request there is none for a day, and with one neither if it is too early.
    for (policy, request) in [(policy(Duration::ZERO), false), (policy(day), true)] {
        let Some(fixture) = Fixture::new().await else { return };
        let first = fixture.put("there before the first round").await;
        fixture.pass(61);
        let stop = CancellationToken::new();
        let clock: Arc<dyn Clock> = fixture.clock.clone();
        let (store, blobs) = (fixture.store.clone(), fixture.blobs.clone());
        let keeping = tokio::spawn(collect_garbage(store, blobs, clock, policy, stop.clone()));
        fixture.gone(first).await;
        let later = fixture.put("there after it").await;
        fixture.pass(61);
        if request {
            fixture.blobs.request_collection();
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert!(fixture.is_there(later).await, "{policy:?}");
        stop.cancel();
        tokio::time::timeout(LONGEST, keeping).await.expect("it stops").expect("in order");
    }
}

#[tokio::test]
async fn what_a_job_past_its_retention_stored_is_removed_in_the_same_round() {
    let Some(fixture) = Fixture::new().await else { return };
    let (archive, of_scene) = (fixture.put("archive").await, fixture.put("archive of a scene").await);
    let scene = fixture.keep(of_scene).await;
    let ids = [1, 2].map(|number| JobId(Uuid::from_u128(number)));
    for (id, dataset, scene) in [(ids[0], archive, None), (ids[1], of_scene, Some(scene))] {
        let new = NewJob::new(id, TrainOptions::default(), dataset);
        fixture.store.create_job(NewJob { dataset_id: scene, ..new }).await.expect("queued");
        fixture.store.cancel(id).await.expect("cancelled");
    }
    fixture.pass(8 * 24 * 60);
    let policy = GarbagePolicy {
        every: Duration::from_secs(24 * 3600),
        blob_grace: GRACE,
        keep_jobs: Some(Duration::from_secs(7 * 24 * 3600)),
        ..GarbagePolicy::default()
    };
    let stop = CancellationToken::new();
    let clock: Arc<dyn Clock> = fixture.clock.clone();
    let (store, blobs) = (fixture.store.clone(), fixture.blobs.clone());
    let keeping = tokio::spawn(collect_garbage(store, blobs, clock, policy, stop.clone()));
    fixture.gone(archive).await;
    stop.cancel();
    tokio::time::timeout(LONGEST, keeping).await.expect("it stops").expect("in order");
    for id in ids {
        assert!(fixture.store.job(id).await.expect("read").is_none());
    }
    assert!(fixture.is_there(of_scene).await, "a scene that was kept on its own stays");
}
