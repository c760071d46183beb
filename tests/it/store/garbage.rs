//! Blobs and uploads that nobody wants any more are cleared away, and nothing else is.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{
        Clock, DatasetSummary, JobId, Layout, ManualClock, SceneId, SystemClock, TrainOptions, UploadId,
    },
    store::{
        BlobError, BlobRef, Blobs, NewDataset, NewJob, NewUpload, QueuePolicy, SqliteStore, Store,
        garbage::{Collected, GarbagePolicy, clear, collect_garbage, withdraw},
    },
};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// Longest wait for a round.
const LONGEST: Duration = Duration::from_secs(120);
const GRACE: SignedDuration = SignedDuration::from_hours(1);

struct House {
    store: Arc<dyn Store>,
    blobs: Blobs,
    /// Begins with the machine's time, by which files are dated.
    clock: Arc<ManualClock>,
    folder: TempDir,
}

impl House {
    async fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(ManualClock::new(SystemClock.now()));
        let path = folder.path().join("tcgs.db");
        let store = SqliteStore::open(&path, clock.clone(), QueuePolicy::default()).await;
        let blobs = Blobs::open(folder.path()).expect("a blob store");
        Self { store: Arc::new(store.expect("a database")), blobs, clock, folder }
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

    async fn keep(&self, dataset: BlobRef) -> SceneId {
        let summary = DatasetSummary {
            layout: Layout::Blender,
            train: 1,
            test: 0,
            pixels: 1,
            points: None,
            notes: Vec::new(),
        };
        let id = SceneId(Uuid::new_v4());
        let new = NewDataset { id, owner: None, name: None, dataset, summary, upload: None, intent: None };
        self.store.create_dataset(new).await.expect("kept").record().id
    }

    async fn delete(&self, scene: SceneId) {
        self.store.delete_dataset(scene, None).await.expect("asked").expect("known");
    }

    async fn clear(&self) -> Collected {
        let policy = GarbagePolicy { blob_grace: GRACE, ..GarbagePolicy::default() };
        clear(&*self.store, &self.blobs, &policy, self.clock.now()).await.expect("a round")
    }

    fn pass(&self, minutes: i64) {
        self.clock.advance(SignedDuration::from_mins(minutes));
    }

    /// The time before which a blob must have been published to be cleared away.
    fn before(&self) -> Timestamp {
        self.clock.now() - GRACE
    }
}

#[tokio::test]
async fn a_blob_waits_for_its_reference_as_long_as_the_grace_time() {
    let house = House::new().await;
    let [lost, kept, late] = [house.put("lost").await, house.put("kept").await, house.put("late").await];
    let scene = house.keep(kept).await;
    house.pass(59);
    assert_eq!(house.clear().await, Collected::default());
    house.keep(late).await;
    house.pass(2);
    assert_eq!(house.clear().await, Collected { blobs: 1, bytes: 4, uploads: 0 });
    assert!(!house.is_there(lost).await && house.is_there(kept).await && house.is_there(late).await);
    house.delete(scene).await;
    assert_eq!(house.clear().await.blobs, 1, "it was published long ago");
    assert!(!house.is_there(kept).await);
    assert_eq!(house.clear().await, Collected::default());
}

#[tokio::test]
async fn what_a_process_that_is_gone_was_receiving_goes_and_what_a_living_one_receives_stays() {
    let house = House::new().await;
    let mut staging = house.blobs.stage(100).await.expect("room");
    staging.write(b"half").await.expect("written");
    let left = house.folder.path().join("staging/process-of-another");
    std::fs::create_dir(&left).expect("made");
    std::fs::write(left.join("upload-half"), "half").expect("written");
    house.clear().await;
    assert!(!left.exists());
    let staged = staging.finish().await.expect("whole");
    assert_eq!(house.blobs.publish(&staged).await.expect("published").blob.bytes, 4);
}

#[tokio::test]
async fn a_publication_that_came_to_nothing_is_withdrawn_unless_something_refers_to_it() {
    let house = House::new().await;
    let publish = async |content: &'static str| house.blobs.put_new(content.into()).await.expect("published");
    let (lost, kept) = (publish("lost").await, publish("kept").await);
    house.keep(kept.blob).await;
    let withdraw = async |published| withdraw(&*house.store, &house.blobs, published).await.expect("asked");
    assert!(withdraw(lost).await && !withdraw(kept).await);
    assert!(!house.is_there(lost.blob).await && house.is_there(kept.blob).await);
}

#[tokio::test]
async fn a_job_keeps_its_dataset_after_the_scene_is_gone() {
    let house = House::new().await;
    let dataset = house.put("dataset").await;
    let scene = house.keep(dataset).await;
    let new = NewJob::new(JobId(Uuid::from_u128(1)), TrainOptions::default(), dataset);
    house.store.create_job(NewJob { scene: Some(scene), ..new }).await.expect("queued");
    house.store.cancel(JobId(Uuid::from_u128(1))).await.expect("cancelled");
    house.delete(scene).await;
    house.pass(90);
    assert_eq!(house.clear().await, Collected::default());
    assert!(house.is_there(dataset).await);
}

#[tokio::test]
async fn a_blob_that_is_published_again_is_young_again() {
    let house = House::new().await;
    let blob = house.put("again").await;
    let scene = house.keep(blob).await;
    house.delete(scene).await;
    // Dated back, as if all that had been long ago.
    let file = house.blobs.local_file(blob.digest).await.expect("a file");
    let file = std::fs::File::options().write(true).open(file).expect("writable");
    file.set_modified(std::time::SystemTime::UNIX_EPOCH).expect("dated back");
    // Whoever clears away has come as far as this when it is published again.
    let before = house.before();
    assert_eq!(house.blobs.older_than(before).await.expect("a list"), [blob.digest]);
    assert_eq!(house.store.forget_blobs(&[blob.digest]).await.expect("forgotten"), [blob.digest]);
    house.put("again").await;
    assert_eq!(house.blobs.remove_older(blob.digest, before).await.expect("asked"), None);
    house.keep(blob).await;
    assert_eq!(house.clear().await, Collected::default());
    assert!(house.is_there(blob).await);
}

#[tokio::test]
async fn a_round_that_broke_off_between_table_and_file_is_made_good_by_the_next() {
    let house = House::new().await;
    let blob = house.put("half gone").await;
    let scene = house.keep(blob).await;
    house.delete(scene).await;
    assert_eq!(house.store.forget_blobs(&[blob.digest]).await.expect("forgotten"), [blob.digest]);
    house.pass(61);
    assert_eq!(house.clear().await.blobs, 1);
    house.put("half gone").await;
    house.keep(blob).await;
    assert!(house.is_there(blob).await);
}

/// One blob is published, referred to, dated back and let go over and over, while rounds go on without pause. It is published again
/// at once, or in the middle of a round, or after a whole one, which has cleared it away.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_referred_to_is_there_however_clearing_and_publishing_interleave() {
    const TURNS: u32 = 60;
    let house = Arc::new(House::new().await);
    let stop = CancellationToken::new();
    let (ended, mut rounds) = tokio::sync::watch::channel(0_u32);
    let clearing = tokio::spawn({
        let (house, stop) = (Arc::clone(&house), stop.clone());
        async move {
            let mut blobs = 0;
            while !stop.is_cancelled() {
                blobs += house.clear().await.blobs;
                ended.send_modify(|rounds| *rounds += 1);
            }
            blobs
        }
    });
    for turn in 0..TURNS {
        let blob = house.put("wanted and unwanted").await;
        let scene = house.keep(blob).await;
        let file = house.blobs.local_file(blob.digest).await.expect("what a scene refers to is there");
        let file = std::fs::File::options().write(true).open(file).expect("writable");
        file.set_modified(std::time::SystemTime::UNIX_EPOCH).expect("dated back");
        assert!(house.is_there(blob).await, "however old it is");
        house.delete(scene).await;
        // The round that is under way has perhaps not seen it; the next one does.
        let until = *rounds.borrow() + turn % 3;
        let waited = tokio::time::timeout(LONGEST, rounds.wait_for(|rounds| *rounds >= until)).await;
        waited.expect("rounds go on").expect("no round failed");
    }
    stop.cancel();
    let cleared = tokio::time::timeout(LONGEST, clearing).await.expect("it stops").expect("no round failed");
    assert!(cleared >= (TURNS / 3) as usize, "cleared away {cleared} times");
}

#[tokio::test]
async fn files_of_uploads_go_with_them_unless_somebody_holds_them() {
    let house = House::new().await;
    let ids = [1, 2, 3].map(|number| UploadId(Uuid::from_u128(number)));
    for (id, minutes) in ids.into_iter().zip([10, 20, 30]) {
        let expires_at = house.clock.now() + SignedDuration::from_mins(minutes);
        let new = NewUpload { id, owner: None, length: 9, metadata: None, expires_at };
        house.store.create_upload(new).await.expect("begun");
        house.blobs.open_upload(id).await.expect("opens").expect("free");
    }
    house.pass(25);
    let held = house.blobs.open_upload(ids[1]).await.expect("opens").expect("free");
    assert_eq!(house.clear().await.uploads, 2);
    let mut left = house.blobs.uploads().await.expect("a list");
    left.sort();
    assert_eq!(left, ids[1..]);
    drop(held);
    assert_eq!(house.clear().await.uploads, 0);
    assert_eq!(house.blobs.uploads().await.expect("a list"), ids[2..]);
}

#[tokio::test]
async fn the_house_is_kept_until_it_is_told_to_stop_and_soon_after_something_is_let_go() {
    let house = House::new().await;
    // No round comes by itself after the first.
    let policy = GarbagePolicy {
        every: Duration::from_secs(24 * 3600),
        at_most_every: Duration::ZERO,
        blob_grace: GRACE,
        ..GarbagePolicy::default()
    };
    let gone = async |blob: BlobRef| {
        let gone = async {
            while house.is_there(blob).await {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONGEST, gone).await.expect("it is cleared away");
    };
    let first = house.put("there before the first round").await;
    house.pass(61);
    let stop = CancellationToken::new();
    let clock: Arc<dyn Clock> = house.clock.clone();
    let keeping =
        tokio::spawn(collect_garbage(house.store.clone(), house.blobs.clone(), clock, policy, stop.clone()));
    gone(first).await;
    for content in ["let go once", "let go again"] {
        let blob = house.put(content).await;
        house.blobs.request_collection();
        gone(blob).await;
    }
    assert!(!keeping.is_finished(), "it goes on until it is told to stop");
    stop.cancel();
    tokio::time::timeout(LONGEST, keeping).await.expect("it stops").expect("in order");
    let kept = house.put("after the end").await;
    house.blobs.request_collection();
    assert!(house.is_there(kept).await);
}
