//! Datasets, uploads and quotas, on a manual clock. Written against the traits.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{
        Clock as _, DatasetId, DatasetSummary, Digest, JobId, Layout, ManualClock, ProjectId, ProjectLimits,
        TrainOptions, UploadId,
    },
    store::{
        Artifact, ArtifactKind, BlobRef, DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord,
        JobDataset, NewDataset, NewJob, NewProject, NewUpload, Outcome, QueuePolicy, Store, StoreError,
        Usage, uploads::MAX_OPEN_UPLOADS,
    },
};
use uuid::Uuid;

use crate::support::{database::Database, fakes};

struct Fixture {
    store: Store,
    clock: Arc<ManualClock>,
    _database: Database,
}

impl Fixture {
    async fn new() -> Option<Self> {
        let database = super::database().await?;
        let start: Timestamp = "2026-11-21T12:00:00Z".parse().expect("an instant");
        let clock = Arc::new(ManualClock::new(start));
        let store = database.open(clock.clone(), QueuePolicy::default()).await;
        Some(Self { store, clock, _database: database })
    }

    /// Adds a project.
    async fn project(&self, number: u128, quota_bytes: Option<u64>) -> ProjectId {
        let limits = ProjectLimits { quota_bytes, ..ProjectLimits::default() };
        let new = NewProject { id: ProjectId(Uuid::from_u128(number)), name: "a project".into(), limits };
        self.store.create_project(new).await.expect("added").id
    }

    async fn add(&self, number: u128, project: ProjectId, content: &str) -> DatasetCreation {
        self.store.create_dataset(new_dataset(number, project, content)).await.expect("created")
    }

    async fn begin(&self, number: u128, project: ProjectId, length: u64) -> Result<UploadId, StoreError> {
        let id = UploadId(Uuid::from_u128(number));
        let expires_at = self.clock.now() + SignedDuration::from_hours(1);
        let new = NewUpload { id, project, length, metadata: None, expires_at };
        self.store.create_upload(new).await.map(|record| record.id)
    }

    async fn usage(&self, project: ProjectId) -> Usage {
        self.store.usage(project).await.expect("read")
    }
}

/// The project of what is made without a key.
const NOBODY: ProjectId = ProjectId::DEFAULT;

fn blob(content: &str) -> BlobRef {
    BlobRef { digest: Digest::of(content.as_bytes()), bytes: content.len() as u64 }
}

fn new_dataset(number: u128, project: ProjectId, content: &str) -> NewDataset {
    NewDataset {
        id: DatasetId(Uuid::from_u128(number)),
        project,
        name: Some(format!("scene {number}")),
        dataset: blob(content),
        summary: DatasetSummary {
            layout: Layout::Colmap,
            train: 7,
            test: 2,
            pixels: 432,
            points: Some(5),
            notes: vec!["a note".into()],
        },
        upload: None,
        intent: None,
    }
}

fn job(number: u128, project: ProjectId, scene: &DatasetRecord) -> NewJob {
    let id = JobId(Uuid::from_u128(number));
    let new = NewJob::new(id, TrainOptions::default(), scene.dataset);
    NewJob { project, dataset_id: Some(scene.id), ..new }
}

#[tokio::test]
async fn a_dataset_reads_back_as_it_was_added() {
    let Some(fixture) = Fixture::new().await else { return };
    let new = new_dataset(1, NOBODY, "dataset");
    let DatasetCreation::Created(made) = fixture.add(1, NOBODY, "dataset").await else { panic!("it is new") };
    assert_eq!((made.id, &made.name, made.dataset), (new.id, &new.name, new.dataset));
    assert_eq!((&made.summary, made.version, made.created_at), (&new.summary, 1, fixture.clock.now()));
    assert_eq!(fixture.store.dataset(new.id).await.expect("read"), Some(made));
    assert_eq!(fixture.store.dataset(DatasetId(Uuid::from_u128(2))).await.expect("read"), None);
}

#[tokio::test]
async fn a_dataset_that_came_with_a_job_goes_with_its_last_job_unless_it_is_kept() {
    let Some(fixture) = Fixture::new().await else { return };
    let project = fixture.project(1, None).await;
    let of_job = async |number: u128, content: &str| {
        let id = JobId(Uuid::from_u128(number));
        let summary = new_dataset(0, project, content).summary;
        let own = JobDataset { id: DatasetId(Uuid::from_u128(100 + number)), summary };
        let new = NewJob::new(id, TrainOptions::default(), blob(content));
        let made = fixture.store.create_job(NewJob { project, own_dataset: Some(own), ..new }).await;
        fixture.store.cancel(id).await.expect("cancelled").expect("known");
        made.expect("queued").dataset_id.expect("a dataset")
    };
    let delete = async |number: u128| {
        let id = JobId(Uuid::from_u128(number));
        fixture.store.delete_job(id, None).await.expect("an answer").expect("known")
    };
    let dataset = async |id: DatasetId| fixture.store.dataset(id).await.expect("read");
    let [first, again, other] = [of_job(1, "one").await, of_job(2, "one").await, of_job(3, "other").await];
    assert!(first == again && first != other, "an archive is one dataset");
    let shown = dataset(first).await.expect("there");
    assert_eq!((shown.kept, shown.name, shown.dataset), (false, None, blob("one")));
    assert_eq!(fixture.usage(project).await.stored, 8);
    delete(1).await;
    assert!(dataset(first).await.is_some(), "another job has it");
    delete(2).await;
    assert_eq!(dataset(first).await, None);

    let DatasetCreation::Created(kept) = fixture.add(9, project, "other").await else {
        panic!("it was not kept")
    };
    assert_eq!((kept.id, kept.kept, kept.name.as_deref(), kept.version), (other, true, Some("scene 9"), 2));
    assert_eq!(fixture.add(10, project, "other").await, DatasetCreation::Existing(kept));
    delete(3).await;
    assert!(dataset(other).await.is_some());
    assert_eq!(fixture.usage(project).await.stored, 5);
    assert_eq!(of_job(4, "other").await, other);
    delete(4).await;
    assert!(dataset(other).await.is_some(), "it stays kept");
}

#[tokio::test]
async fn a_project_has_an_archive_once_and_another_has_its_own_dataset_of_it() {
    let Some(fixture) = Fixture::new().await else { return };
    let [one, other] = [fixture.project(1, None).await, fixture.project(2, None).await];
    for project in [NOBODY, one, other] {
        let number = 10 + project.0.as_u128();
        let DatasetCreation::Created(made) = fixture.add(number, project, "dataset").await else {
            panic!("nothing of another project's is seen")
        };
        let again = fixture.add(number + 10, project, "dataset").await;
        assert_eq!(again, DatasetCreation::Existing(made.clone()));
        let found = fixture.store.dataset_by_archive(project, made.dataset.digest).await.expect("read");
        assert_eq!(found, Some(made));
        assert_eq!(fixture.usage(project).await, Usage { stored: 7, reserved: 0 });
    }
    let list = |project| fixture.store.datasets(project, None, 10);
    assert_eq!(list(None).await.expect("all").len(), 3);
    let own = list(Some(one)).await.expect("own");
    assert_eq!(own.iter().map(|scene| scene.project).collect::<Vec<_>>(), [one]);
    let absent = fixture.store.dataset_by_archive(one, Digest::of(b"other")).await.expect("read");
    assert_eq!(absent, None);
}

#[tokio::test]
async fn a_project_s_datasets_are_those_of_its_scenes_and_jobs() {
    let Some(fixture) = Fixture::new().await else { return };
    let [one, other] = [fixture.project(1, None).await, fixture.project(2, None).await];
    let largest = async || fixture.store.largest_dataset(one).await.expect("read");
    assert_eq!(largest().await, 0);
    fixture.add(1, one, "a scene").await;
    fixture.add(2, other, "a scene of another project").await;
    assert_eq!(largest().await, 7);
    let id = JobId(Uuid::from_u128(1));
    let new = NewJob::new(id, TrainOptions::default(), blob("of a job"));
    fixture.store.create_job(NewJob { project: one, ..new }).await.expect("queued");
    assert_eq!(largest().await, 8);
    for (content, owned) in [("a scene", true), ("of a job", true), ("a scene of another project", false)] {
        let found = fixture.store.owned_archive(one, blob(content).digest).await.expect("read");
        assert_eq!(found, owned.then_some(blob(content)));
    }
    let claim = fixture.store.claim("worker").await.expect("a claim").expect("a job");
    let artifact =
        Artifact { kind: ArtifactKind::Cameras, lambda: None, blob: blob("longer than all datasets") };
    let outcome = Outcome::Succeeded { metrics: Box::new(fakes::metrics()), artifacts: vec![artifact] };
    fixture.store.finish(&claim.lease, outcome).await.expect("ended");
    assert_eq!(largest().await, 8);
    fixture.store.delete_job(id, None).await.expect("asked").expect("known");
    assert_eq!(largest().await, 7);
}

#[tokio::test]
async fn datasets_are_listed_newest_first_without_gaps_or_repeats() {
    let Some(fixture) = Fixture::new().await else { return };
    let mut ids: Vec<DatasetId> = Vec::new();
    for number in 0..5 {
        // Two of each instant, so that the id has to decide.
        fixture.clock.advance(SignedDuration::from_secs(i64::from(number % 2 == 0)));
        ids.push(fixture.add(u128::from(number as u32) + 1, NOBODY, &format!("{number}")).await.record().id);
    }
    ids.reverse();
    let (mut listed, mut before) = (Vec::new(), None);
    loop {
        let page = fixture.store.datasets(None, before, 2).await.expect("a page");
        let Some(last) = page.last() else { break };
        before = Some(DatasetPageKey { created_at: last.created_at, id: last.id });
        listed.extend(page.iter().map(|scene| scene.id));
    }
    assert_eq!(listed, ids);
}

#[tokio::test]
async fn a_dataset_is_deleted_unless_an_active_job_trains_on_it() {
    let Some(fixture) = Fixture::new().await else { return };
    let made = fixture.add(1, NOBODY, "dataset").await.record().clone();
    let jobs = [job(1, NOBODY, &made), job(2, NOBODY, &made)];
    for new in jobs.clone() {
        fixture.store.create_job(new).await.expect("queued");
    }
    let delete = |version| fixture.store.delete_dataset(made.id, version);
    assert_eq!(delete(None).await.expect("asked"), Some(DatasetDeletion::InUse(2)));
    let claim = fixture.store.claim("worker").await.expect("a claim").expect("a job");
    assert_eq!(delete(None).await.expect("asked"), Some(DatasetDeletion::InUse(2)));
    for new in &jobs {
        fixture.store.cancel(new.id).await.expect("cancelled");
    }
    assert_eq!(delete(None).await.expect("asked"), Some(DatasetDeletion::InUse(1)));
    fixture.store.finish(&claim.lease, Outcome::Cancelled).await.expect("ended");
    let before = fixture.store.job(jobs[0].id).await.expect("read").expect("known").job.version;
    assert_eq!(delete(Some(2)).await.expect("asked"), Some(DatasetDeletion::VersionMismatch));
    assert_eq!(delete(Some(1)).await.expect("asked"), Some(DatasetDeletion::Deleted));
    assert_eq!(delete(None).await.expect("asked"), None);
    let kept = fixture.store.job(jobs[0].id).await.expect("read").expect("the job stays");
    assert_eq!((kept.dataset_id, kept.dataset), (None, made.dataset));
    assert_eq!(kept.job.version, before + 1, "it is shown otherwise than before");
    fixture.store.create_job(job(3, NOBODY, &made)).await.expect_err("a job cannot be made of what is gone");
}

#[tokio::test]
async fn an_upload_reserves_its_bytes_until_it_is_a_dataset_or_deleted() {
    let Some(fixture) = Fixture::new().await else { return };
    let project = fixture.project(1, Some(100)).await;
    let used = fixture.begin(1, project, 60).await.expect("room");
    let refused = fixture.begin(2, project, 41).await.expect_err("60 + 41 > 100");
    assert!(
        matches!(refused, StoreError::QuotaExceeded { requested: 41, used: 60, quota: 100 }),
        "{refused}"
    );
    let dropped = fixture.begin(3, project, 40).await.expect("exactly what is left");
    assert_eq!(fixture.usage(project).await, Usage { stored: 0, reserved: 100 });
    assert_eq!(fixture.usage(NOBODY).await, Usage::default(), "and nobody else's");
    fixture.begin(4, NOBODY, 1 << 50).await.expect("the default project has no quota");
    fixture.begin(5, NOBODY, u64::MAX >> 1).await.expect_err("sums of such lengths would overflow");
    assert!(fixture.store.delete_upload(dropped).await.expect("asked"));
    assert!(!fixture.store.delete_upload(dropped).await.expect("asked"));

    let later = fixture.clock.now() + SignedDuration::from_hours(2);
    assert!(fixture.store.advance_upload(used, 25, later).await.expect("advanced"));
    let record = fixture.store.upload(used).await.expect("read").expect("known");
    assert_eq!((record.received, record.expires_at, record.is_complete()), (25, later, false));
    assert_eq!(fixture.store.outstanding_bytes().await.expect("read"), 35 + (1 << 50));
    fixture.store.advance_upload(used, 61, later).await.expect_err("more than was announced");

    let content = "x".repeat(60);
    let new = NewDataset { upload: Some(used), ..new_dataset(1, project, &content) };
    let made = fixture.store.create_dataset(new).await.expect("its room becomes the scene's");
    assert_eq!(fixture.usage(project).await, Usage { stored: 60, reserved: 0 });
    let record = fixture.store.upload(used).await.expect("read").expect("known");
    assert_eq!((record.dataset_id, record.ended_at), (Some(made.record().id), Some(fixture.clock.now())));
    assert!(!fixture.store.advance_upload(used, 60, later).await.expect("asked"), "it has ended");
    assert!(!fixture.store.delete_upload(used).await.expect("asked"), "it has ended");

    let refused =
        fixture.store.create_dataset(new_dataset(2, project, &"y".repeat(41))).await.expect_err("60 + 41");
    assert!(
        matches!(refused, StoreError::QuotaExceeded { requested: 41, used: 60, quota: 100 }),
        "{refused}"
    );
}

#[tokio::test]
async fn uploads_expire_and_stay_listed_as_ended_for_a_while() {
    let Some(fixture) = Fixture::new().await else { return };
    let open = fixture.begin(1, NOBODY, 5).await.expect("room");
    fixture.clock.advance(SignedDuration::from_mins(30));
    let young = fixture.begin(2, NOBODY, 6).await.expect("room");
    fixture.clock.advance(SignedDuration::from_mins(30));
    let forget = |hours: i64| fixture.clock.now() - SignedDuration::from_hours(hours);
    let record = fixture.store.upload(open).await.expect("read").expect("known");
    assert!(!record.is_open(fixture.clock.now()), "its time is over before anybody sweeps");
    assert_eq!(fixture.store.expire_uploads(forget(24)).await.expect("swept"), [open]);
    assert_eq!(fixture.store.expire_uploads(forget(24)).await.expect("swept"), []);
    assert_eq!(fixture.store.open_uploads().await.expect("read"), [young]);
    assert_eq!(fixture.usage(NOBODY).await.reserved, 6);
    let record = fixture.store.upload(open).await.expect("read").expect("still known");
    assert_eq!(record.ended_at, Some(fixture.clock.now()));
    fixture.clock.advance(SignedDuration::from_hours(25));
    assert_eq!(fixture.store.expire_uploads(forget(24)).await.expect("swept"), [young]);
    assert_eq!(fixture.store.upload(open).await.expect("read"), None);
    assert!(fixture.store.upload(young).await.expect("read").is_some());
}

#[tokio::test]
async fn a_project_has_a_bounded_number_of_open_uploads_which_expire_in_one_sweep() {
    let Some(fixture) = Fixture::new().await else { return };
    for number in 1..=u128::from(MAX_OPEN_UPLOADS) {
        fixture.begin(number, NOBODY, 0).await.expect("room");
    }
    let refused = fixture.begin(1000, NOBODY, 0).await.expect_err("one too many");
    assert!(matches!(refused, StoreError::TooManyUploads { open: MAX_OPEN_UPLOADS }), "{refused:?}");
    let other = fixture.project(1, None).await;
    fixture.begin(1001, other, 0).await.expect("it is the limit of a project");
    assert!(fixture.store.delete_upload(UploadId(Uuid::from_u128(1))).await.expect("deleted"));
    fixture.begin(1000, NOBODY, 0).await.expect("room for another");
    fixture.clock.advance(SignedDuration::from_hours(1));
    let forget = fixture.clock.now();
    let expired = fixture.store.expire_uploads(forget).await.expect("swept").len();
    assert_eq!(expired, MAX_OPEN_UPLOADS as usize + 1);
    fixture.begin(1002, NOBODY, 0).await.expect("the ended ones do not count");
    fixture.clock.advance(SignedDuration::from_secs(1));
    assert_eq!(fixture.store.expire_uploads(fixture.clock.now()).await.expect("swept"), []);
    let gone = fixture.store.upload(UploadId(Uuid::from_u128(1000))).await.expect("read");
    assert_eq!(gone, None, "what ended before is forgotten");
}

#[tokio::test]
async fn only_unreferenced_blobs_are_removed() {
    let Some(fixture) = Fixture::new().await else { return };
    let made = fixture.add(1, NOBODY, "dataset").await.record().clone();
    fixture.store.create_job(job(1, NOBODY, &made)).await.expect("queued");
    let unknown = Digest::of(b"never heard of");
    let all = [made.dataset.digest, unknown];
    assert_eq!(fixture.store.forget_blobs(&all).await.expect("asked"), [unknown]);
    fixture.store.cancel(JobId(Uuid::from_u128(1))).await.expect("cancelled");
    fixture.store.delete_dataset(made.id, None).await.expect("deleted");
    assert_eq!(
        fixture.store.forget_blobs(&all).await.expect("asked"),
        [unknown],
        "the job refers to it still"
    );
    assert_eq!(fixture.usage(NOBODY).await.stored, 7);
    let lone = fixture.add(2, NOBODY, "lone").await.record().clone();
    fixture.store.delete_dataset(lone.id, None).await.expect("deleted");
    assert_eq!(
        fixture.store.forget_blobs(&[lone.dataset.digest]).await.expect("asked"),
        [lone.dataset.digest]
    );
    fixture.add(3, NOBODY, "lone").await;
}

#[tokio::test]
async fn a_batch_of_blobs_is_forgotten_as_each_of_them_alone_is() {
    let Some(fixture) = Fixture::new().await else { return };
    let mut all = vec![Digest::of(b"never heard of")];
    for number in 1..=7_u8 {
        let made = fixture.add(number.into(), NOBODY, &format!("dataset {number}")).await.record().clone();
        all.push(made.dataset.digest);
        if number % 3 == 1 {
            fixture.store.create_job(job(number.into(), NOBODY, &made)).await.expect("queued");
            fixture.store.cancel(JobId(Uuid::from_u128(number.into()))).await.expect("cancelled");
        }
        if number != 2 && number != 4 {
            fixture.store.delete_dataset(made.id, None).await.expect("deleted");
        }
    }
    assert!(fixture.store.forget_blobs(&[]).await.expect("asked").is_empty());
    all.reverse();
    let batch = fixture.store.forget_blobs(&all).await.expect("asked");
    let mut single = Vec::new();
    for digest in &all {
        single.extend(fixture.store.forget_blobs(&[*digest]).await.expect("asked"));
    }
    assert_eq!((batch.len(), &batch), (4, &single));
}
