//! The totals that the schema's triggers maintain equal a recount after every change, and counters never fall.

use std::{sync::Arc, time::Duration};

use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{
        Clock as _, DatasetId, DatasetSummary, DeliveryId, Digest, EndpointId, JobId, Layout, ManualClock,
        Problem, ProblemType, ProjectId, ProjectLimits, SceneFormat, TrainOptions, UploadId, WebhookEvent,
        WebhookSecret,
    },
    store::{
        AfterAttempt, Artifact, ArtifactKind, BlobRef, DeliveryResult, ExportRecord, NewDataset, NewEndpoint,
        NewJob, NewProject, NewUpload, Outcome, QueuePolicy, RetryRequest, Store, StoreStats, Usage,
        WorkerDeath,
    },
};
use uuid::Uuid;

use crate::support::{database::Database, fakes, totals::totals_equal_a_recount};

pub(in crate::store) struct Fixture {
    pub(in crate::store) store: Store,
    pub(super) clock: Arc<ManualClock>,
    pub(super) database: Database,
    pub(in crate::store) seen: StoreStats,
}

impl Fixture {
    pub(super) async fn new() -> Option<Self> {
        Some(Self::open(super::database().await?).await)
    }

    pub(in crate::store) async fn open(database: Database) -> Self {
        let start: Timestamp = "2026-11-21T12:00:00Z".parse().expect("an instant");
        let clock = Arc::new(ManualClock::new(start));
        let store = database.open(clock.clone(), QueuePolicy::default()).await;
        Self { store, clock, database, seen: StoreStats::default() }
    }

    pub(super) async fn project(&mut self, number: u128) -> ProjectId {
        let id = ProjectId(Uuid::from_u128(number));
        let new = NewProject { id, name: "a project".into(), limits: ProjectLimits::default() };
        self.store.create_project(new).await.expect("added").id
    }

    /// Compares totals with a recount, and counters with their values before.
    pub(in crate::store) async fn check(&mut self, what: &str) {
        totals_equal_a_recount(&self.database, what).await;
        let figures = self.store.stats().await.expect("read");
        assert!(figures.claims >= self.seen.claims, "after {what}");
        for (now, before) in figures.phase_seconds.iter().zip(&self.seen.phase_seconds) {
            assert!(now.1 >= before.1, "after {what}: {now:?} and {before:?}");
        }
        for before in &self.seen.attempts {
            let now = figures
                .attempts
                .iter()
                .find(|now| (now.outcome, &now.cause) == (before.outcome, &before.cause));
            assert!(now.is_some_and(|now| now.count >= before.count), "after {what}: {before:?}");
        }
        self.seen = figures;
    }

    pub(super) fn new_job(&self, number: u128, project: ProjectId, content: &str) -> NewJob {
        let id = JobId(Uuid::from_u128(number));
        NewJob { project, ..NewJob::new(id, TrainOptions::default(), blob(content)) }
    }

    pub(super) async fn job(
        &self,
        number: u128,
        project: ProjectId,
        scene: Option<DatasetId>,
        content: &str,
    ) -> JobId {
        let new = NewJob { dataset_id: scene, ..self.new_job(number, project, content) };
        self.store.create_job(new).await.expect("created").job.id
    }

    /// An endpoint that is told of everything.
    pub(super) async fn endpoint(&self, project: ProjectId) -> EndpointId {
        let new = NewEndpoint {
            id: EndpointId(Uuid::now_v7()),
            project,
            url: "https://example.com/".into(),
            events: WebhookEvent::ALL.to_vec(),
            description: None,
            secret: WebhookSecret::generate(&tcgs::domain::SystemRandom).expect("drawn"),
        };
        self.store.create_endpoint(new, 9).await.expect("made").expect("room").id
    }

    pub(super) async fn finish(&self, outcome: Outcome) {
        let claim = self.store.claim("worker").await.expect("an answer").expect("a job");
        self.store.finish(&claim.lease, outcome).await.expect("ended");
    }
}

/// A dataset with this archive, kept for a project.
pub(super) fn dataset(number: u128, project: ProjectId, content: &str) -> NewDataset {
    let summary =
        DatasetSummary { layout: Layout::Colmap, train: 1, test: 1, pixels: 1, points: None, notes: vec![] };
    NewDataset {
        id: DatasetId(Uuid::from_u128(number)),
        project,
        name: None,
        dataset: blob(content),
        summary,
        upload: None,
        intent: None,
    }
}

pub(super) fn blob(content: &str) -> BlobRef {
    BlobRef { digest: Digest::of(content.as_bytes()), bytes: content.len() as u64 }
}

pub(in crate::store) fn succeeded(file: &str) -> Outcome {
    let mut metrics = fakes::metrics();
    metrics.seconds.train = 2.5;
    let artifact = |kind, content| Artifact { kind, lambda: None, blob: blob(content) };
    let artifacts = vec![
        artifact(ArtifactKind::Scene(SceneFormat::Tcgs), file),
        artifact(ArtifactKind::Cameras, "the same cameras"),
    ];
    Outcome::Succeeded { metrics: Box::new(metrics), artifacts }
}

pub(super) fn problem() -> Problem {
    Problem::new(ProblemType::DeviceLost, "the adapter went away")
}

#[tokio::test]
async fn totals_equal_a_recount_after_every_change() {
    let Some(mut fixture) = Fixture::new().await else { return };
    let (one, other) = (fixture.project(1).await, fixture.project(2).await);
    fixture.check("the beginning").await;

    // Endpoints first, so that every change of a job is told.
    for project in [one, ProjectId::DEFAULT] {
        fixture.endpoint(project).await;
    }
    let mut scenes = Vec::new();
    for (number, (project, content)) in
        [(one, "a scene"), (other, "a scene"), (ProjectId::DEFAULT, "another")].into_iter().enumerate()
    {
        let new = dataset(number as u128 + 1, project, content);
        let id = new.id;
        fixture.store.create_dataset(new.clone()).await.expect("created");
        fixture
            .store
            .create_dataset(NewDataset { id: DatasetId(Uuid::now_v7()), ..new })
            .await
            .expect("known");
        fixture.check("a scene").await;
        scenes.push(id);
    }

    // Projects take turns, so that the jobs are claimed in this order.
    let first = fixture.job(1, one, Some(scenes[0]), "a scene").await;
    let second = fixture.job(2, other, None, "a dataset").await;
    let third = fixture.job(3, ProjectId::DEFAULT, None, "a dataset").await;
    let fourth = fixture.job(4, one, None, "a dataset").await;
    fixture.check("four jobs").await;
    fixture.finish(succeeded("a file")).await;
    fixture.check("a success").await;
    fixture.finish(Outcome::Retry(problem())).await;
    fixture.check("a retry").await;
    fixture.finish(succeeded("a file")).await;
    fixture.check("the same file of another").await;
    fixture.finish(Outcome::Failed(problem())).await;
    fixture.check("a failure").await;
    fixture.store.cancel(second).await.expect("an answer").expect("known");
    fixture.check("a cancellation").await;
    let repeat = RetryRequest { from_checkpoint: false, ..RetryRequest::of(JobId(Uuid::from_u128(5))) };
    fixture.store.retry_job(second, repeat).await.expect("an answer").expect("known");
    fixture.check("a repetition").await;
    fixture.clock.advance(SignedDuration::from_secs(1));
    let claim = fixture.store.claim("worker").await.expect("an answer").expect("a job");
    fixture.store.expire_worker("worker", WorkerDeath::Alone).await.expect("an answer");
    fixture.check("a lost worker").await;
    fixture.store.cancel(claim.lease.job).await.expect("an answer").expect("known");

    for (format, content) in [(SceneFormat::Ply, "as ply"), (SceneFormat::Spz, "as spz")] {
        let source = blob("a file").digest;
        let export = ExportRecord {
            job: first,
            source,
            format,
            blob: blob(content),
            gaussians: 1,
            sh_degree: 0,
            fidelity: None,
        };
        fixture.store.add_export(export).await.expect("kept").expect("known");
        fixture.store.add_export(export).await.expect("kept").expect("known");
    }
    fixture.check("exports").await;

    for (number, project) in [(1, one), (2, one), (3, ProjectId::DEFAULT)] {
        let id = UploadId(Uuid::from_u128(number));
        let expires_at = fixture.clock.now() + SignedDuration::from_hours(number as i64);
        let new = NewUpload { id, project, length: 100, metadata: None, expires_at };
        fixture.store.create_upload(new).await.expect("begun");
        fixture.store.advance_upload(id, 10, expires_at).await.expect("advanced");
        fixture.check("an upload").await;
    }
    let usage = fixture.store.usage(one).await.expect("read");
    let stored = ["a scene", "a dataset", "a file", "the same cameras", "as ply", "as spz"];
    assert_eq!(usage, Usage { stored: stored.map(str::len).iter().sum::<usize>() as u64, reserved: 200 });
    fixture.store.delete_upload(UploadId(Uuid::from_u128(2))).await.expect("deleted");
    fixture.check("a deleted upload").await;
    fixture.clock.advance(SignedDuration::from_mins(90));
    fixture.store.expire_uploads(Timestamp::MIN).await.expect("expired");
    fixture.check("an expired upload").await;
    fixture.store.expire_uploads(Timestamp::MAX).await.expect("expired");
    fixture.check("a forgotten upload").await;

    for next in
        [AfterAttempt::Done, AfterAttempt::RetryAfter(Duration::from_secs(1)), AfterAttempt::DisableEndpoint]
    {
        let due =
            fixture.store.take_delivery(Duration::from_secs(60)).await.expect("read").expect("one is due");
        let settled = DeliveryResult { response_status: Some(200), error: None, next };
        fixture.store.finish_delivery(due.id, due.attempt, settled).await.expect("settled");
        fixture.check("a delivery").await;
        let endpoint = endpoint_of(&fixture.database, due.id).await;
        fixture.store.replay(endpoint, due.id).await.expect("an answer");
        fixture.check("a replay").await;
    }

    let before = fixture.store.stats().await.expect("read");
    assert_eq!(before.phase_seconds[1], ("train", 5.0));
    assert!(
        before.claims >= 5
            && before.attempts.iter().any(|ended| ended.cause.as_deref() == Some("device-lost"))
    );
    for job in [first, second, third, fourth, claim.lease.job] {
        fixture.store.delete_job(job, None).await.expect("an answer").expect("known");
        fixture.check("a deleted job").await;
    }
    for scene in scenes {
        fixture.store.delete_dataset(scene, None).await.expect("an answer").expect("known");
        fixture.check("a deleted scene").await;
    }
    let all = ["a scene", "another", "a dataset", "a file", "the same cameras", "as ply", "as spz"];
    let digests: Vec<Digest> = all.map(|content| blob(content).digest).to_vec();
    assert_eq!(fixture.store.forget_blobs(&digests).await.expect("an answer").len(), digests.len());
    fixture.check("forgotten blobs").await;
    for endpoint in fixture.store.endpoints(None, None, 9).await.expect("read") {
        assert!(fixture.store.delete_endpoint(endpoint.id).await.expect("an answer"));
        fixture.check("a deleted endpoint").await;
    }
    let after = fixture.store.stats().await.expect("read");
    assert_eq!(
        (after.claims, &after.attempts, &after.phase_seconds),
        (before.claims, &before.attempts, &before.phase_seconds)
    );
    assert_eq!((after.blobs, after.blob_bytes), (0, 0));
    assert!(after.jobs.iter().all(|(_, count)| *count == 0));
}

async fn endpoint_of(database: &Database, delivery: DeliveryId) -> EndpointId {
    let query = format!("SELECT endpoint FROM webhook_deliveries WHERE id = '{delivery}'");
    database.rows(&query, 1).await[0][0].parse().expect("an id")
}
