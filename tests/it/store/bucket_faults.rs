//! Each request to the bucket in turn fails, before the server gets it or after, with a full disk or a broken one. What is done is an error
//! that passes or succeeds, no row refers to an object that is not there, and the same done again succeeds.

use std::{collections::BTreeSet, io::ErrorKind, sync::Arc};

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use jiff::{SignedDuration, Unit};
use object_store::{ObjectStore, path::Path as ObjectPath};
use tcgs::{
    domain::{Clock as _, Digest, JobId, ManualClock, ProjectId, SystemClock, TrainOptions, UploadId},
    store::{
        BlobError, BlobRef, Blobs, NewJob, NewUpload, QueuePolicy, Store,
        garbage::{GarbageError, GarbagePolicy, collect},
        publications::REMOVER_IS_DEAD,
    },
};
use tempfile::TempDir;
use uuid::Uuid;

use crate::support::{
    bucket::S3Server,
    database::Database,
    faulty_bucket::{FaultyBucket, Side},
};

/// More requests than anything here makes.
const MAX_REQUESTS: u32 = 100;

struct Fixture {
    store: Store,
    blobs: Blobs,
    faults: FaultyBucket,
    clock: Arc<ManualClock>,
    /// The bucket without faults.
    objects: Arc<dyn ObjectStore>,
    database: Database,
    _folder: TempDir,
}

impl Fixture {
    async fn new() -> Option<Self> {
        let database = super::database().await?;
        let server = S3Server::shared()?;
        let folder = tempfile::tempdir().expect("a folder");
        let now = SystemClock.now().round(Unit::Microsecond).expect("in range");
        let clock = Arc::new(ManualClock::new(now));
        let store = database.open(clock.clone(), QueuePolicy::default()).await;
        let objects = server.connect(&server.prefix());
        let faults = FaultyBucket::new(objects.clone());
        let blobs = Blobs::open_bucket(folder.path(), Arc::new(faults.clone()), store.clone());
        let blobs = blobs.await.expect("a bucket");
        Some(Self { store, blobs, faults, clock, objects, database, _folder: folder })
    }

    /// Does `work` again and again with other contents, each time with the next request failing, until none does. What has failed is
    /// repeated at once.
    async fn with_each_request_failing(&self, what: &str, work: impl AsyncFn(u32) -> Result<(), BlobError>) {
        let mut number = 0;
        for side in [Side::Request, Side::Answer] {
            for kind in [ErrorKind::StorageFull, ErrorKind::Other] {
                for request in 1.. {
                    assert!(request < MAX_REQUESTS, "{what} has no end");
                    number += 1;
                    self.faults.plan(side, kind, request);
                    let done = work(number).await;
                    let failed = self.faults.relieve();
                    let case = format!("{what}: {kind:?}, {side:?} {request}");
                    if let Err(error) = &done {
                        assert!(
                            failed && (error.is_transient() || error.is_disk_full()),
                            "{case}: {error:?}"
                        );
                    }
                    self.nothing_is_missing(&case).await;
                    if done.is_err() {
                        work(number).await.unwrap_or_else(|error| panic!("{case}, repeated: {error:?}"));
                    }
                    if !failed {
                        println!("{what}: {kind:?} at each of {} requests, {side:?}", request - 1);
                        break;
                    }
                }
            }
        }
    }

    async fn objects(&self) -> BTreeSet<String> {
        let listed = self.objects.list(Some(&ObjectPath::from("sha256")));
        let listed: Vec<_> = listed.try_collect().await.expect("a list");
        listed.iter().map(|object| object.location.filename().expect("a name").to_owned()).collect()
    }

    async fn names(&self, statement: &str) -> BTreeSet<String> {
        self.database.rows(statement, 1).await.into_iter().flatten().collect()
    }

    async fn referred(&self) -> BTreeSet<String> {
        self.names("SELECT dataset FROM jobs UNION SELECT dataset FROM scenes").await
    }

    async fn nothing_is_missing(&self, after: &str) {
        let (referred, objects) = (self.referred().await, self.objects().await);
        assert!(referred.is_subset(&objects), "{after}: {:?}", referred.difference(&objects));
    }

    /// What is left once garbage is collected is what is referred to.
    async fn is_tidy_after_collections(&self, after: &str) {
        // Removers that were cut off count as dead.
        for _ in 0..2 {
            self.clock.advance(REMOVER_IS_DEAD + SignedDuration::from_hours(2));
            self.collect().await.expect("collected");
        }
        assert_eq!(self.objects().await, self.referred().await, "after {after}");
    }

    async fn collect(&self) -> Result<(), GarbageError> {
        collect(&self.store, &self.blobs, &GarbagePolicy::default(), self.clock.now()).await.map(drop)
    }

    async fn create_job(&self, dataset: BlobRef) {
        let new = NewJob::new(JobId(Uuid::now_v7()), TrainOptions::default(), dataset);
        self.store.create_job(new).await.expect("queued");
    }
}

fn small(number: u32) -> Bytes {
    format!("content {number}").into()
}

/// Three parts.
fn large(number: u32) -> Bytes {
    let mut content = vec![7; 17 << 20];
    content[..4].copy_from_slice(&number.to_le_bytes());
    content.into()
}

#[tokio::test]
async fn publications_survive_the_fault_of_any_request() {
    let Some(fixture) = Fixture::new().await else { return };
    for (what, content) in [("a small blob", small as fn(u32) -> Bytes), ("a large blob", large)] {
        let publish = async |number: u32| {
            let blob = fixture.blobs.put(content(number)).await?;
            fixture.create_job(blob).await;
            assert!(fixture.blobs.read(blob.digest).await? == content(number));
            Ok(())
        };
        fixture.with_each_request_failing(what, publish).await;
    }
    fixture.is_tidy_after_collections("publications").await;
}

#[tokio::test]
async fn resumable_uploads_survive_the_fault_of_any_request() {
    let Some(fixture) = Fixture::new().await else { return };
    let later = fixture.clock.now() + SignedDuration::from_hours(100);
    let upload = async |number: u32| {
        let (id, content) = (UploadId(Uuid::from_u128(number.into())), large(number));
        let length = content.len() as u64;
        if fixture.store.upload(id).await?.is_none() {
            let new =
                NewUpload { id, project: ProjectId::DEFAULT, length, metadata: None, expires_at: later };
            fixture.store.create_upload(new).await?;
        }
        for end in [content.len() / 3, content.len()] {
            let mut file = fixture.blobs.open_upload(id).await?.expect("free");
            let received = fixture.store.upload(id).await?.expect("there").received;
            let at = usize::try_from(received).expect("small");
            if at < end {
                file.continue_at(received).await?;
                file.write(&content[at..end]).await?;
                assert!(file.save(&fixture.store, end as u64, later).await?);
            }
        }
        let staged = fixture.blobs.open_upload(id).await?.expect("free").finish(length).await?;
        assert_eq!(staged.blob(), BlobRef { digest: Digest::of(&content), bytes: length });
        let blob = fixture.blobs.publish(&staged).await?.blob;
        drop(staged);
        fixture.create_job(blob).await;
        fixture.store.delete_upload(id).await?;
        fixture.blobs.remove_upload(id).await?;
        Ok(())
    };
    fixture.with_each_request_failing("an upload", upload).await;
    fixture.is_tidy_after_collections("uploads").await;
    assert!(fixture.blobs.uploads().await.expect("a list").is_empty());
}

#[tokio::test]
async fn collections_survive_the_fault_of_any_request() {
    let Some(fixture) = Fixture::new().await else { return };
    let kept = fixture.blobs.put(small(0)).await.expect("published");
    fixture.create_job(kept).await;
    let collection = async |number: u32| {
        // Published before the fault, if it is the first time.
        for place in 0..2 {
            fixture.blobs.put(format!("garbage {number} {place}").into()).await?;
        }
        fixture.clock.advance(SignedDuration::from_hours(2));
        match fixture.collect().await {
            Ok(()) => Ok(()),
            Err(GarbageError::Blobs(error)) => {
                // Its mark counts for as long as the remover may live.
                fixture.clock.advance(REMOVER_IS_DEAD + SignedDuration::from_secs(1));
                Err(error)
            }
            Err(GarbageError::Store(error)) => panic!("{error}"),
        }
    };
    fixture.with_each_request_failing("a collection", collection).await;
    fixture.is_tidy_after_collections("collections").await;
    assert_eq!(fixture.blobs.read(kept.digest).await.expect("there"), small(0));
}

#[tokio::test]
async fn an_object_that_cannot_be_deleted_leaves_the_others_to_be_collected() {
    let Some(fixture) = Fixture::new().await else { return };
    for number in 0..3 {
        fixture.blobs.put(small(number)).await.expect("published");
    }
    fixture.clock.advance(SignedDuration::from_hours(2));
    fixture.faults.plan_of("delete", Side::Request, ErrorKind::Other, 1);
    fixture.collect().await.expect_err("one is left");
    assert!(fixture.faults.relieve());
    assert_eq!(fixture.objects().await.len(), 1);
    fixture.is_tidy_after_collections("an object that could not be deleted").await;
}
