//! Blobs in a bucket of a real S3 server.

use std::{path::Path, sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::{FutureExt as _, TryFutureExt as _, TryStreamExt as _};
use jiff::{SignedDuration, Unit};
use object_store::{ObjectStore, ObjectStoreExt as _, path::Path as ObjectPath};
use tcgs::{
    domain::{Clock as _, Digest, JobId, ManualClock, ProjectId, SystemClock, TrainOptions, UploadId},
    store::{
        BackupError, BackupNote, BlobError, BlobPlace, BlobRef, BlobSource, BlobState, Blobs, BucketClaim,
        CheckDepth, CopyMode, DATABASE, NewJob, NewUpload, QueuePolicy, Store, StoreError, back_up,
        garbage::{GarbageError, GarbagePolicy, collect},
        publications::{REMOVER_IS_DEAD, Removable},
        restore,
        uploads::WRITER_LIFE,
    },
};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;

use crate::support::{
    bucket::{S3Server, connect},
    database::Database,
    faulty_bucket::FaultyBucket,
    gate::{Gate, GateState},
};

struct Fixture {
    objects: Arc<dyn ObjectStore>,
    store: Store,
    blobs: Blobs,
    clock: Arc<ManualClock>,
    folder: TempDir,
    database: Database,
}

impl Fixture {
    async fn new() -> Option<Self> {
        let database = super::database().await?;
        let server = S3Server::shared()?;
        let folder = tempfile::tempdir().expect("a folder");
        // As precise as the database.
        let now = SystemClock.now().round(Unit::Microsecond).expect("in range");
        let clock = Arc::new(ManualClock::new(now));
        let store = database.open(clock.clone(), QueuePolicy::default()).await;
        let objects = server.connect(&server.prefix());
        let blobs =
            Blobs::open_bucket(folder.path(), objects.clone(), store.clone()).await.expect("a bucket");
        Some(Self { objects, store, blobs, clock, folder, database })
    }

    /// As another process would open it.
    async fn reopen(&self) -> Result<Blobs, BlobError> {
        let store = self.database.open(self.clock.clone(), QueuePolicy::default()).await;
        Blobs::open_bucket(self.folder.path(), self.objects.clone(), store).await
    }

    async fn stage(&self, content: &[u8]) -> tcgs::store::StagedBlob {
        let mut staging = self.blobs.stage(1 << 30).await.expect("room");
        staging.write(content).await.expect("written");
        staging.finish().await.expect("whole")
    }

    /// A queued job with a dataset in the bucket.
    async fn queue(&self, number: u128, content: &'static [u8]) -> (JobId, BlobRef) {
        let dataset = self.blobs.put(Bytes::from_static(content)).await.expect("published");
        let job = JobId(uuid::Uuid::from_u128(number));
        self.store.create_job(NewJob::new(job, TrainOptions::default(), dataset)).await.expect("queued");
        (job, dataset)
    }

    async fn back_up(&self, destination: &Path) -> BackupNote {
        let source = BlobSource::Store(self.blobs.clone());
        back_up(&self.store, &source, destination, CopyMode::Link, self.clock.clone())
            .await
            .expect("a backup")
    }

    /// A restored database whose blobs are in a bucket, as a service opens it.
    async fn open_restored(&self, data: &Path, bucket: &Arc<dyn ObjectStore>) -> (Store, Blobs) {
        let store = Store::open(&data.join(DATABASE), self.clock.clone(), QueuePolicy::default()).await;
        let store = store.expect("a database");
        let blobs = Blobs::open_bucket(data, bucket.clone(), store.clone()).await.expect("its bucket");
        (store, blobs)
    }
}

/// Where a blob's object is.
fn object(digest: Digest) -> ObjectPath {
    let hex = digest.to_string();
    ObjectPath::from(format!("sha256/{}/{}/{hex}", &hex[..2], &hex[2..4]))
}

/// More than one part.
fn large() -> Vec<u8> {
    (0..20_000_003_u32).map(|index| (index.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

#[tokio::test]
async fn a_blob_in_a_bucket_reads_back_whole_in_parts_and_as_a_file() {
    let Some(fixture) = Fixture::new().await else { return };
    let large = large();
    for content in [b"twelve bytes".as_slice(), &[], &large] {
        let staged = fixture.stage(content).await;
        let blob = fixture.blobs.publish(&staged).await.expect("published").blob;
        assert_eq!(blob, BlobRef { digest: Digest::of(content), bytes: content.len() as u64 });
        assert_eq!(fixture.blobs.publish(&staged).await.expect("again").blob, blob);
        assert!(fixture.blobs.read(blob.digest).await.expect("whole") == content);
        let copy = fixture.blobs.local_copy(blob.digest).await.expect("a file");
        assert!(std::fs::read(copy.path()).expect("readable") == content);
        let path = copy.path().to_owned();
        drop(copy);
        assert!(!path.exists(), "a copy does not outlive its handle");
        if let Some(part) = content.get(content.len() / 2..)
            && !part.is_empty()
        {
            let range = content.len() as u64 / 2..content.len() as u64;
            let read: Vec<Bytes> = fixture
                .blobs
                .stream_part(blob.digest, range)
                .await
                .expect("a part")
                .try_collect()
                .await
                .expect("read");
            assert!(read.concat() == part);
        }
        let whole = fixture.blobs.stream_whole(blob).await.expect("there");
        assert!(whole.try_collect::<Vec<Bytes>>().await.expect("sound").concat() == content);
        assert_eq!(fixture.blobs.check(blob, CheckDepth::Content).await.expect("asked"), BlobState::Sound);
    }
    let put = fixture.blobs.put(Bytes::from(large.clone())).await.expect("published");
    assert_eq!(put.digest, Digest::of(&large));
}

#[tokio::test]
async fn content_that_is_large_is_never_put_in_one_request() {
    let Some(fixture) = Fixture::new().await else { return };
    let objects = FaultyBucket::new(fixture.objects.clone());
    let store = fixture.database.open(fixture.clock.clone(), QueuePolicy::default()).await;
    let blobs = Blobs::open_bucket(fixture.folder.path(), Arc::new(objects.clone()), store).await;
    let blobs = blobs.expect("a bucket");
    let files = blobs.shared_files().expect("it is a bucket");
    let path = fixture.folder.path().join("file");
    for (content, in_parts) in [(vec![7; (8 << 20) + 2], true), (vec![7; 5], false)] {
        std::fs::write(&path, &content).expect("written");
        let staged = fixture.stage(&content[1..]).await;
        let (put, publish, save) =
            (blobs.put(content.into()), blobs.publish(&staged), files.save("folder/file", &path));
        let writes = [put.map_ok(drop).boxed(), publish.map_ok(drop).boxed(), save.boxed()];
        for (number, write) in writes.into_iter().enumerate() {
            let held = objects.hold_next_put();
            let at_once = tokio::select! {
                written = write => {
                    written.expect("written");
                    false
                }
                asked = held.asked => {
                    asked.expect("held");
                    true
                }
            };
            assert_eq!(at_once, !in_parts, "write {number}");
        }
    }
}

/// How much of a damaged blob a reader of the whole gets, and why it ends.
async fn read_until_damage(blobs: &Blobs, blob: BlobRef) -> (u64, BlobError) {
    let mut stream = match blobs.stream_whole(blob).await {
        Ok(stream) => stream,
        Err(cause) => return (0, cause),
    };
    let mut read = 0;
    loop {
        match stream.try_next().await {
            Ok(piece) => read += piece.expect("a damaged blob ends with an error").len() as u64,
            Err(cause) => return (read, cause),
        }
    }
}

#[tokio::test]
async fn a_large_blob_that_was_altered_in_the_bucket_never_arrives_whole() {
    let Some(fixture) = Fixture::new().await else { return };
    let content = large();
    let blob = fixture.blobs.put(Bytes::from(content.clone())).await.expect("published");
    let flipped = |place: usize| {
        let mut content = content.clone();
        content[place] ^= 1;
        content
    };
    let longer = [&content[..], b"more"].concat();
    for altered in [flipped(0), flipped(content.len() - 1), content[..content.len() / 2].to_vec(), longer] {
        fixture.objects.put(&object(blob.digest), altered.into()).await.expect("overwritten");
        let (read, cause) = read_until_damage(&fixture.blobs, blob).await;
        assert!(read < blob.bytes, "{read} bytes");
        assert!(matches!(cause, BlobError::Damaged { .. }), "{cause}");
    }
}

#[tokio::test]
async fn damage_and_absence_in_a_bucket_are_found() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = fixture.blobs.put(Bytes::from_static(b"sound")).await.expect("published");
    let state = async |depth| fixture.blobs.check(blob, depth).await.expect("asked");
    fixture.objects.put(&object(blob.digest), b"risen".to_vec().into()).await.expect("overwritten");
    assert!(matches!(fixture.blobs.read(blob.digest).await, Err(BlobError::Damaged { .. })));
    assert!(matches!(fixture.blobs.local_copy(blob.digest).await, Err(BlobError::Damaged { .. })));
    assert_eq!(state(CheckDepth::Content).await, BlobState::Damaged);
    assert_eq!(state(CheckDepth::Length).await, BlobState::Sound);
    let (read, cause) = read_until_damage(&fixture.blobs, blob).await;
    assert!(read < 5 && matches!(cause, BlobError::Damaged { .. }), "{read} bytes, {cause}");
    // Another length is seen by a publisher, who mends it.
    fixture.objects.put(&object(blob.digest), b"so".to_vec().into()).await.expect("overwritten");
    assert_eq!(state(CheckDepth::Length).await, BlobState::Damaged);
    fixture.blobs.put(Bytes::from_static(b"sound")).await.expect("published");
    assert_eq!(state(CheckDepth::Content).await, BlobState::Sound);
    fixture.objects.delete(&object(blob.digest)).await.expect("deleted");
    assert_eq!(state(CheckDepth::Content).await, BlobState::Missing);
    assert!(matches!(fixture.blobs.read(blob.digest).await, Err(BlobError::Missing(_))));
    assert!(matches!(fixture.blobs.local_copy(blob.digest).await, Err(BlobError::Missing(_))));
    assert!(fixture.blobs.republish(blob).await.expect("asked").is_none());
    fixture.blobs.put(Bytes::from_static(b"sound")).await.expect("published");
    let (_, copy) = fixture.blobs.republish(blob).await.expect("asked").expect("there");
    assert_eq!(std::fs::read(copy.path()).expect("readable"), b"sound");
}

#[tokio::test]
async fn a_bucket_belongs_to_one_database_and_a_database_to_one_place() {
    let Some(fixture) = Fixture::new().await else { return };
    fixture.reopen().await.expect("its own database opens it again");
    fixture.blobs.probe().await.expect("its own");
    assert!(matches!(fixture.store.claim_place(BlobPlace::Folder).await, Err(StoreError::BlobsInBucket)));

    let other = Database::sqlite();
    let store = other.open(fixture.clock.clone(), QueuePolicy::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let opened = Blobs::open_bucket(folder.path(), fixture.objects.clone(), store).await;
    assert!(matches!(opened, Err(BlobError::OtherDatabase)));

    let third = Database::sqlite();
    let store = third.open(fixture.clock.clone(), QueuePolicy::default()).await;
    let first = store.claim_place(BlobPlace::Folder).await.expect("decided now");
    assert_eq!(store.claim_place(BlobPlace::Folder).await.expect("as before"), first);
    let opened = Blobs::open_bucket(folder.path(), fixture.objects.clone(), store).await;
    assert!(matches!(opened, Err(BlobError::Index(StoreError::BlobsInFolder))));

    fixture.objects.put(&ObjectPath::from("database"), b"another".to_vec().into()).await.expect("taken over");
    assert!(matches!(fixture.blobs.probe().await, Err(BlobError::OtherDatabase)));
}

#[tokio::test]
async fn a_database_that_has_blobs_takes_no_other_empty_bucket_for_its_own() {
    let Some(fixture) = Fixture::new().await else { return };
    let server = S3Server::shared().expect("asked before");
    let open_empty = async || {
        let empty = server.connect(&server.prefix());
        let store = fixture.database.open(fixture.clock.clone(), QueuePolicy::default()).await;
        (Blobs::open_bucket(fixture.folder.path(), empty.clone(), store).await, empty)
    };
    open_empty().await.0.expect("nothing is anywhere yet");
    fixture.queue(1, b"a dataset").await;
    let (refused, empty) = open_empty().await;
    assert!(matches!(refused, Err(BlobError::OtherBucket)), "{refused:?}");
    assert!(empty.head(&ObjectPath::from("database")).await.is_err(), "it is not marked");
    fixture.reopen().await.expect("its own bucket");
}

#[tokio::test]
async fn a_publication_in_a_bucket_is_undone_only_if_it_created_the_blob_and_none_followed() {
    let Some(fixture) = Fixture::new().await else { return };
    let blobs = &fixture.blobs;
    let content = || Bytes::from_static(b"twelve bytes");
    let put = blobs.put_new(content()).await.expect("published");
    assert!(blobs.unpublish(put).await.expect("asked"));
    assert!(matches!(blobs.read(put.blob.digest).await, Err(BlobError::Missing(_))));
    assert!(!blobs.unpublish(put).await.expect("asked"), "it is gone");
    // On a clock that stands still, publications differ all the same.
    let first = blobs.put_new(content()).await.expect("published");
    let second = blobs.put_new(content()).await.expect("published again");
    assert!(!blobs.unpublish(first).await.expect("asked"), "another counts on it");
    assert!(!blobs.unpublish(second).await.expect("asked"), "it was there before");
    assert_eq!(blobs.read(first.blob.digest).await.expect("there"), content());
}

#[tokio::test]
async fn a_publisher_waits_for_a_remover_and_takes_over_from_a_dead_one() {
    let Some(fixture) = Fixture::new().await else { return };
    let content = || Bytes::from_static(b"wanted again");
    let blob = fixture.blobs.put(content()).await.expect("published");
    let any_age = Removable::OlderThan(SignedDuration::ZERO);
    fixture.clock.advance(SignedDuration::from_secs(1));
    let removal = fixture.store.begin_removal(blob.digest, any_age).await.expect("asked").expect("marked");
    assert_eq!(removal.blob, blob);
    assert_eq!(
        fixture.store.begin_removal(blob.digest, any_age).await.expect("asked"),
        None,
        "one at a time"
    );

    let publishing = tokio::spawn({
        let blobs = fixture.blobs.clone();
        async move { blobs.put(content()).await.expect("published in the end") }
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(!publishing.is_finished(), "it must not count on what is being deleted");
    fixture.objects.delete(&object(blob.digest)).await.expect("deleted");
    fixture.store.end_removal(removal).await.expect("forgotten");
    assert_eq!(publishing.await.expect("ends"), blob);
    assert_eq!(fixture.blobs.read(blob.digest).await.expect("there"), content());

    // This remover dies before it has deleted anything.
    fixture.clock.advance(SignedDuration::from_secs(1));
    let dead = fixture.store.begin_removal(blob.digest, any_age).await.expect("asked").expect("marked");
    assert!(fixture.store.abandoned_removals().await.expect("asked").is_empty());
    fixture.clock.advance(REMOVER_IS_DEAD + SignedDuration::from_secs(1));
    assert_eq!(fixture.blobs.put(content()).await.expect("published"), blob);
    // It was not dead.
    fixture.store.end_removal(dead).await.expect("too late");
    let row = fixture.store.begin_removal(blob.digest, any_age).await.expect("asked");
    assert_eq!(row, None, "published just now");
    assert_eq!(fixture.blobs.read(blob.digest).await.expect("there"), content());
    fixture.clock.advance(SignedDuration::from_secs(1));
    let row = fixture.store.begin_removal(blob.digest, any_age).await.expect("asked");
    assert!(row.is_some(), "the one that was too late has removed nothing");
}

#[tokio::test]
async fn what_a_dead_remover_left_is_finished_by_a_collection() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = fixture.blobs.put(Bytes::from_static(b"unwanted")).await.expect("published");
    fixture.clock.advance(SignedDuration::from_secs(1));
    let which = Removable::OlderThan(SignedDuration::ZERO);
    fixture.store.begin_removal(blob.digest, which).await.expect("asked").expect("marked");
    fixture.blobs.finish_removals().await.expect("asked");
    assert!(fixture.objects.head(&object(blob.digest)).await.is_ok(), "its remover may be alive");
    fixture.clock.advance(REMOVER_IS_DEAD + SignedDuration::from_secs(1));
    fixture.blobs.finish_removals().await.expect("finished");
    assert!(fixture.objects.head(&object(blob.digest)).await.is_err());
    let announced = fixture.store.announce(blob).await.expect("asked").expect("nobody removes it");
    assert!(announced.is_new);
}

#[tokio::test]
async fn a_publication_that_was_removed_meanwhile_is_not_confirmed() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = BlobRef { digest: Digest::of(b"slow"), bytes: 4 };
    let slow = fixture.store.announce(blob).await.expect("asked").expect("free");
    fixture.clock.advance(SignedDuration::from_hours(2));
    let old = Removable::OlderThan(SignedDuration::from_hours(1));
    let removal = fixture.store.begin_removal(blob.digest, old).await.expect("asked").expect("marked");
    assert_eq!(fixture.store.confirm(slow).await.expect("asked"), None);
    fixture.store.end_removal(removal).await.expect("forgotten");
    assert_eq!(fixture.store.confirm(slow).await.expect("asked"), None);
    let again = fixture.store.announce(blob).await.expect("asked").expect("free");
    assert_eq!(fixture.store.confirm(slow).await.expect("asked"), None, "that is another publication");
    assert!(again.is_new && fixture.store.confirm(again).await.expect("asked").is_some());
}

#[tokio::test]
async fn a_publication_is_new_until_another_publisher_announces_or_renews_it() {
    let Some(fixture) = Fixture::new().await else { return };
    let blob = BlobRef { digest: Digest::of(b"slow"), bytes: 4 };
    let announce = async || fixture.store.announce(blob).await.expect("asked").expect("free");
    let confirm = async |announced| fixture.store.confirm(announced).await.expect("asked").expect("there");
    let slow = announce().await;
    let renewed = confirm(confirm(slow).await).await;
    assert!(slow.is_new && renewed.is_new, "its own renewals do not count");
    assert!(slow.published_at < renewed.published_at);
    assert!(!confirm(slow).await.is_new, "it was renewed since");
    let other = announce().await;
    assert!(!other.is_new && !confirm(renewed).await.is_new && !confirm(other).await.is_new);
}

#[tokio::test]
async fn a_slow_publication_cannot_be_undone_once_another_counts_on_the_object() {
    let Some(fixture) = Fixture::new().await else { return };
    let objects = FaultyBucket::new(fixture.objects.clone());
    let store = fixture.database.open(fixture.clock.clone(), QueuePolicy::default()).await;
    let slow = Blobs::open_bucket(fixture.folder.path(), Arc::new(objects.clone()), store).await;
    let slow = slow.expect("another replica");
    let content = || Bytes::from_static(b"twelve bytes");

    let held = objects.hold_next_put();
    let publishing = tokio::spawn(async move { slow.put_new(content()).await.expect("published") });
    held.asked.await.expect("announced");
    let other = fixture.blobs.put_new(content()).await.expect("published");
    fixture.clock.advance(SignedDuration::from_secs(1));
    held.release.send(()).expect("held until now");
    let first = publishing.await.expect("ends");
    assert!(!fixture.blobs.unpublish(first).await.expect("asked"), "the other counts on it");
    assert!(!fixture.blobs.unpublish(other).await.expect("asked"), "it was announced before");
    assert_eq!(fixture.blobs.read(other.blob.digest).await.expect("there"), content());
}

/// An upload of the default project.
async fn begin_upload(fixture: &Fixture, number: u128, length: u64) -> UploadId {
    let id = UploadId(uuid::Uuid::from_u128(number));
    let expires_at = fixture.clock.now() + SignedDuration::from_hours(1);
    let new = NewUpload { id, project: ProjectId::DEFAULT, length, metadata: None, expires_at };
    fixture.store.create_upload(new).await.expect("begun");
    id
}

#[tokio::test]
async fn an_upload_in_a_bucket_goes_on_at_another_replica() {
    let Some(fixture) = Fixture::new().await else { return };
    let other = fixture.reopen().await.expect("another replica");
    let content = large();
    let length = content.len() as u64;
    let id = begin_upload(&fixture, 1, length).await;
    let later = fixture.clock.now() + SignedDuration::from_hours(2);
    let half = content.len() / 2;

    let mut file = fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    assert!(other.open_upload(id).await.expect("asked").is_none(), "one writer at a time");
    assert!(!other.remove_upload(id).await.expect("asked"), "it is held");
    file.continue_at(0).await.expect("at its beginning");
    file.write(&content[..100]).await.expect("written");
    assert!(file.save(&fixture.store, 100, later).await.expect("saved"));
    file.write(&content[100..half]).await.expect("written");
    assert!(file.save(&fixture.store, half as u64, later).await.expect("saved"));
    file.write(b"never saved").await.expect("written");
    drop(file);

    let mut file = other.open_upload(id).await.expect("asked").expect("free again");
    let record = fixture.store.upload(id).await.expect("asked").expect("there");
    assert_eq!((record.received, record.expires_at), (half as u64, later));
    file.continue_at(record.received).await.expect("where the other ended");
    file.write(&content[half..]).await.expect("written");
    assert!(file.save(&fixture.store, length, later).await.expect("saved"));
    drop(file);
    assert_eq!(fixture.blobs.uploads().await.expect("a list"), [id]);

    let reopen = async || fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    let short = reopen().await.finish(length + 1).await;
    assert!(matches!(short, Err(BlobError::UploadDamaged { found, .. }) if found == length));
    let staged = reopen().await.finish(length).await.expect("whole");
    assert_eq!(staged.blob(), BlobRef { digest: Digest::of(&content), bytes: length });
    assert!(other.open_upload(id).await.expect("asked").is_none(), "nobody writes while it is used");
    fixture.blobs.publish(&staged).await.expect("published");
    drop(staged);
    assert!(fixture.store.delete_upload(id).await.expect("deleted"));
    assert!(other.remove_upload(id).await.expect("asked"));
    assert!(fixture.blobs.uploads().await.expect("a list").is_empty());
    assert!(fixture.blobs.remove_upload(id).await.expect("asked"), "what is gone is gone");
    assert!(fixture.blobs.read(Digest::of(&content)).await.expect("the blob stays") == content);
}

#[tokio::test]
async fn what_a_failed_write_left_is_no_part_of_an_upload() {
    let Some(fixture) = Fixture::new().await else { return };
    let id = begin_upload(&fixture, 1, 11).await;
    let later = fixture.clock.now() + SignedDuration::from_hours(1);
    let reopen = async || fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    for (start, piece, end) in [(0, b"first".as_slice(), 5), (5, b" later", 11)] {
        let mut file = reopen().await;
        file.continue_at(start).await.expect("at its place");
        file.write(piece).await.expect("written");
        file.write(b"some of a piece").await.expect("written, but not counted");
        assert!(file.save(&fixture.store, end, later).await.expect("saved"));
    }
    let staged = reopen().await.finish(11).await.expect("no byte more, and none less");
    assert_eq!(staged.blob().digest, Digest::of(b"first later"));
}

#[tokio::test]
async fn a_save_without_new_bytes_adds_no_part() {
    let Some(fixture) = Fixture::new().await else { return };
    let id = begin_upload(&fixture, 1, 11).await;
    let later = fixture.clock.now() + SignedDuration::from_hours(1);
    let mut file = fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    for (piece, end) in [(b"".as_slice(), 0), (b"first", 5), (b"", 5), (b"", 5), (b" later", 11), (b"", 11)] {
        file.write(piece).await.expect("written");
        assert!(file.save(&fixture.store, end, later).await.expect("saved"));
    }
    let parts = fixture.objects.list(Some(&ObjectPath::from("uploads")));
    assert_eq!(parts.try_collect::<Vec<_>>().await.expect("a list").len(), 2);
    let staged = file.finish(11).await.expect("whole");
    assert_eq!(staged.blob().digest, Digest::of(b"first later"));
}

#[tokio::test]
async fn an_upload_that_has_ended_takes_no_more_bytes() {
    let Some(fixture) = Fixture::new().await else { return };
    let id = begin_upload(&fixture, 1, 8).await;
    let mut file = fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    file.write(b"late").await.expect("written");
    fixture.clock.advance(SignedDuration::from_hours(1));
    assert_eq!(fixture.store.expire_uploads(fixture.clock.now()).await.expect("swept"), [id]);
    let later = fixture.clock.now() + SignedDuration::from_hours(1);
    assert!(!file.save(&fixture.store, 4, later).await.expect("asked"));
    assert_eq!(fixture.store.upload_parts(id).await.expect("read"), []);
}

#[tokio::test]
async fn a_lock_of_an_upload_counts_until_it_is_released() {
    let Some(fixture) = Fixture::new().await else { return };
    let id = begin_upload(&fixture, 1, 8).await;
    let later = fixture.clock.now() + SignedDuration::from_hours(1);
    let lock = async || fixture.store.lock_upload(id).await.expect("asked");
    let renew = async |writer| fixture.store.renew_upload_lock(writer).await.expect("asked");
    let add = async |writer, start, end| {
        fixture.store.add_upload_part(writer, start, "a part", end, later).await.expect("asked")
    };
    let first = lock().await.expect("free");
    fixture.clock.advance(WRITER_LIFE);
    assert_eq!(lock().await, None, "it lasts as long as that");
    assert!(renew(first).await);
    fixture.clock.advance(WRITER_LIFE);
    assert_eq!(lock().await, None);
    assert!(add(first, 0, 4).await);
    fixture.clock.advance(WRITER_LIFE);
    assert_eq!(lock().await, None, "a part renews it too");

    fixture.store.unlock_upload(first).await.expect("released");
    assert!(!renew(first).await && !add(first, 4, 8).await);
    let second = lock().await.expect("free");
    assert!(second.number > first.number);
    fixture.store.unlock_upload(first).await.expect("nothing of its own");
    assert!(!renew(first).await && !add(first, 4, 8).await, "that is the other's lock");
    assert!(renew(second).await && add(second, 4, 8).await);
    fixture.clock.set_by(SignedDuration::from_hours(-24));
    let third = lock().await.expect("a lock of tomorrow is from before the clock was set back");
    assert!(third.number > second.number);
    assert_eq!(lock().await, None);
    assert_eq!(
        fixture.store.upload_parts(id).await.expect("read"),
        [(0, "a part".to_owned()), (4, "a part".to_owned())]
    );
}

#[tokio::test]
async fn a_writer_that_was_away_too_long_saves_nothing_more() {
    let Some(fixture) = Fixture::new().await else { return };
    let id = begin_upload(&fixture, 1, 8).await;
    let later = fixture.clock.now() + SignedDuration::from_hours(2);
    let mut away = fixture.blobs.open_upload(id).await.expect("asked").expect("free");
    away.continue_at(0).await.expect("at its beginning");
    away.write(b"lost").await.expect("written");
    fixture.clock.advance(WRITER_LIFE + SignedDuration::from_secs(1));
    let mut next = fixture.blobs.open_upload(id).await.expect("asked").expect("its lock has ended");
    next.continue_at(0).await.expect("at its beginning");
    next.write(b"kept").await.expect("written");
    assert!(!away.save(&fixture.store, 4, later).await.expect("asked"), "another writes now");
    assert!(next.save(&fixture.store, 4, later).await.expect("asked"));
    next.write(b"more").await.expect("written");
    drop(away);
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert!(next.save(&fixture.store, 8, later).await.expect("asked"), "its lock is not the other's");
    let staged = next.finish(8).await.expect("whole");
    assert_eq!(staged.blob().digest, Digest::of(b"keptmore"));
}

/// What a test does while the bucket does not answer, through a proxy that can be shut.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bucket_that_is_away_is_an_error_that_passes() {
    let Some(database) = super::database().await else { return };
    let Some(server) = S3Server::shared() else { return };
    let gate = Gate::start(server.address).await;
    let folder = tempfile::tempdir().expect("a folder");
    let store = database.open(Arc::new(SystemClock), QueuePolicy::default()).await;
    let url = server.prefix();
    let blobs =
        Blobs::open_bucket(folder.path(), connect(&url, gate.address), store).await.expect("a bucket");
    let blob = blobs.put(Bytes::from_static(b"before")).await.expect("published");
    let content = large();
    for when in [GateState::Shut, GateState::CutAfter(10_000), GateState::CutAfter(3_000_000)] {
        gate.set(when);
        let failed = blobs.put(Bytes::from(content.clone())).await.expect_err("the bucket is away");
        assert!(failed.is_transient(), "{failed:?}");
        if when == GateState::Shut {
            assert!(blobs.read(blob.digest).await.expect_err("away").is_transient());
            assert!(blobs.probe().await.expect_err("away").is_transient());
        }
        gate.set(GateState::Open);
        assert!(blobs.read(blob.digest).await.expect("back") == b"before".as_slice());
    }
    let put = blobs.put(Bytes::from(content.clone())).await.expect("published");
    assert!(blobs.read(put.digest).await.expect("whole") == content);
    gate.set(GateState::Slow);
    assert!(blobs.read(put.digest).await.expect("slow, but whole") == content);
}

/// Several writers, a collector and readers through a proxy that delays requests and lets answers overtake each other.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn blobs_survive_answers_in_another_order_beside_garbage_collection() {
    let Some(database) = super::database().await else { return };
    let Some(server) = S3Server::shared() else { return };
    let gate = Gate::start(server.address).await;
    gate.set(GateState::Reordered(20));
    let folder = tempfile::tempdir().expect("a folder");
    let store = database.open(Arc::new(SystemClock), QueuePolicy::default()).await;
    let url = server.prefix();
    let blobs = Blobs::open_bucket(folder.path(), connect(&url, gate.address), store.clone())
        .await
        .expect("a bucket");
    let content = |number: u8| Bytes::from([&[number; 5][..], &large()].concat());
    // Whatever is older than this publisher needs is collected all the time.
    let stop = CancellationToken::new();
    let policy = GarbagePolicy { blob_grace: SignedDuration::from_secs(60), ..GarbagePolicy::default() };
    let collecting = tokio::spawn({
        let (store, blobs, stop) = (store.clone(), blobs.clone(), stop.clone());
        async move {
            while !stop.is_cancelled() {
                collect(&store, &blobs, &policy, SystemClock.now()).await.expect("collected");
            }
        }
    });
    let publish = async |number: u8| {
        for turn in 0..2 {
            let put = blobs.put(content(number % 2 + turn)).await.expect("published");
            let new = NewJob::new(JobId(uuid::Uuid::now_v7()), TrainOptions::default(), put);
            store.create_job(new).await.expect("queued");
            assert!(blobs.read(put.digest).await.expect("whole") == content(number % 2 + turn));
        }
    };
    tokio::join!(publish(0), publish(1), publish(2), publish(3));
    stop.cancel();
    collecting.await.expect("no collection failed");
    let objects = connect(&url, server.address);
    for number in 0..3 {
        let digest = Digest::of(&content(number));
        let found = objects.get(&object(digest)).await.expect("there").bytes().await.expect("read");
        assert!(found == content(number));
    }
    let listed: Vec<_> = objects.list(Some(&ObjectPath::from("sha256"))).try_collect().await.expect("a list");
    assert_eq!(listed.len(), 3);
}

#[tokio::test]
async fn a_backup_moves_blobs_out_of_a_bucket_and_into_another() {
    let Some(fixture) = Fixture::new().await else { return };
    if fixture.database.is_postgres() {
        return; // Its backups are pg_dump's.
    }
    let server = S3Server::shared().expect("asked before");
    let (job, dataset) = fixture.queue(7, b"a dataset").await;

    let folder = tempfile::tempdir().expect("a folder");
    let [backup, in_bucket, in_folder] = ["backup", "bucket", "folder"].map(|name| folder.path().join(name));
    let clock = fixture.clock.clone();
    let note = fixture.back_up(&backup).await;
    assert_eq!((note.blobs, note.bytes), (1, 9));

    let objects = server.connect(&server.prefix());
    for (data, bucket) in [(&in_bucket, Some(objects.clone())), (&in_folder, None)] {
        let claimed = bucket.clone().map(|bucket| (bucket, BucketClaim::Unclaimed));
        let restored = restore(&backup, data, claimed, clock.clone()).await.expect("restored");
        assert_eq!(restored, note);
        let (store, blobs) = match bucket {
            Some(bucket) => fixture.open_restored(data, &bucket).await,
            None => {
                let store = Store::open(&data.join(DATABASE), clock.clone(), QueuePolicy::default()).await;
                let store = store.expect("a database");
                store.claim_place(BlobPlace::Folder).await.expect("decided by the restoration");
                (store, Blobs::open(data).expect("its folder"))
            }
        };
        assert!(store.job(job).await.expect("read").is_some());
        assert_eq!(blobs.read(dataset.digest).await.expect("there"), b"a dataset".as_slice());
    }
}

#[tokio::test]
async fn what_a_bucket_already_has_is_checked_by_a_restoration_and_collected_later() {
    let Some(fixture) = Fixture::new().await else { return };
    if fixture.database.is_postgres() {
        return; // Its backups are pg_dump's.
    }
    let server = S3Server::shared().expect("asked before");
    let jobs = [fixture.queue(1, b"a dataset").await, fixture.queue(2, b"another one").await];
    let folder = tempfile::tempdir().expect("a folder");
    let [backup, data] = ["backup", "data"].map(|name| folder.path().join(name));
    fixture.back_up(&backup).await;

    let objects = server.connect(&server.prefix());
    let [sound, damaged] = jobs.map(|(_, dataset)| object(dataset.digest));
    objects.put(&sound, b"a dataset".to_vec().into()).await.expect("put");
    objects.put(&damaged, b"rotten once".to_vec().into()).await.expect("put");
    let bucket = Some((objects.clone(), BucketClaim::Unclaimed));
    restore(&backup, &data, bucket, fixture.clock.clone()).await.expect("restored");
    let (store, blobs) = fixture.open_restored(&data, &objects).await;
    for (job, dataset) in jobs {
        let found = blobs.check(dataset, CheckDepth::Content).await.expect("asked");
        assert_eq!(found, BlobState::Sound, "{job}");
        store.cancel(job).await.expect("cancelled");
        store.delete_job(job, None).await.expect("deleted");
    }
    fixture.clock.advance(SignedDuration::from_hours(2));
    let collected = collect(&store, &blobs, &GarbagePolicy::default(), fixture.clock.now()).await;
    assert_eq!(collected.expect("collected").blobs, 2);
    for gone in [sound, damaged] {
        assert!(objects.head(&gone).await.is_err(), "{gone}");
    }
}

#[tokio::test]
async fn a_restored_copy_is_refused_the_bucket_of_the_database_that_was_backed_up() {
    let Some(fixture) = Fixture::new().await else { return };
    if fixture.database.is_postgres() {
        return; // Its backups are pg_dump's.
    }
    fixture.queue(1, b"a dataset").await;
    let folder = tempfile::tempdir().expect("a folder");
    let [backup, data] = ["backup", "data"].map(|name| folder.path().join(name));
    fixture.back_up(&backup).await;

    let bucket = Some((fixture.objects.clone(), BucketClaim::Unclaimed));
    let refused = restore(&backup, &data, bucket, fixture.clock.clone()).await.expect_err("it is in use");
    assert!(matches!(refused, BackupError::BucketInUse), "{refused:?}");
    let told = refused.to_string();
    assert!(told.contains("another prefix") && told.contains("--take-over-bucket"), "{told}");
    assert!(!data.join(DATABASE).exists());
    fixture.blobs.probe().await.expect("the bucket is still the original's");
}

#[tokio::test]
async fn a_restoration_takes_over_a_bucket_on_request_with_what_it_has() {
    let Some(fixture) = Fixture::new().await else { return };
    if fixture.database.is_postgres() {
        return; // Its backups are pg_dump's.
    }
    let (job, dataset) = fixture.queue(1, b"a dataset").await;
    let folder = tempfile::tempdir().expect("a folder");
    let [backup, lost, data] = ["backup", "lost", "data"].map(|name| folder.path().join(name));
    let note = fixture.back_up(&backup).await;
    let after_backup = fixture.blobs.put(Bytes::from_static(b"published after it")).await.expect("published");

    // As after a restoration that failed, the second one finds the bucket taken by the first.
    for folder in [&lost, &data] {
        let bucket = Some((fixture.objects.clone(), BucketClaim::TakeOver));
        let restored = restore(&backup, folder, bucket, fixture.clock.clone()).await.expect("restored");
        assert_eq!(restored, note);
    }
    let policy = GarbagePolicy::default();
    fixture.clock.advance(SignedDuration::from_hours(2));
    assert!(matches!(fixture.blobs.probe().await, Err(BlobError::OtherDatabase)));
    let late = collect(&fixture.store, &fixture.blobs, &policy, fixture.clock.now()).await;
    assert!(matches!(late, Err(GarbageError::Blobs(BlobError::OtherDatabase))), "{late:?}");

    let (store, blobs) = fixture.open_restored(&data, &fixture.objects).await;
    assert!(store.job(job).await.expect("read").is_some());
    assert!(fixture.objects.head(&object(after_backup.digest)).await.is_ok());
    let collected = collect(&store, &blobs, &policy, fixture.clock.now()).await.expect("collected");
    assert_eq!(collected.blobs, 1);
    assert!(fixture.objects.head(&object(after_backup.digest)).await.is_err(), "the backup does not know it");
    assert_eq!(blobs.read(dataset.digest).await.expect("there"), b"a dataset".as_slice());
}
