//! Retention removes what ended long ago, and nothing that is queued, running or to be delivered.

use std::time::Duration;

use jiff::SignedDuration;
use tcgs::{
    domain::{Digest, JobId, JobState, Problem, ProblemType, ProjectId, SceneFormat},
    store::{
        AfterAttempt, DatasetCreation, DeliveryResult, DeliveryState, ExportRecord, IdempotentRequest,
        JobFilter, Outcome, RetryRequest, retention::remove_expired,
    },
};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::totals::{Fixture, blob, dataset, succeeded};

const DAY: SignedDuration = SignedDuration::from_hours(24);
const KEEP: Duration = Duration::from_secs(30 * 24 * 3600);

impl Fixture {
    async fn remove(&self, keep: Option<Duration>) -> u64 {
        remove_expired(&self.store, keep, &CancellationToken::new()).await.expect("removed")
    }

    async fn state(&self, job: JobId) -> Option<JobState> {
        self.store.job(job).await.expect("read").map(|record| record.job.state)
    }

    /// Delivers the message that is due first.
    async fn deliver(&self) {
        let due = self.store.take_delivery(Duration::from_secs(60)).await.expect("read").expect("one is due");
        let result = DeliveryResult { response_status: Some(200), error: None, next: AfterAttempt::Done };
        self.store.finish_delivery(due.id, due.attempt, result).await.expect("settled");
    }

    async fn rows_of(&self, job: JobId) -> i64 {
        let mut count = 0;
        for table in ["events", "attempts", "artifacts", "exports", "series"] {
            let query = format!("SELECT count(*) FROM {table} WHERE job_id = '{job}'");
            count += self.database.number(&query).await;
        }
        count
    }
}

fn failed() -> Outcome {
    Outcome::Failed(Problem::new(ProblemType::InvalidDataset, "no images"))
}

#[tokio::test]
async fn only_jobs_that_ended_long_ago_are_removed_and_totals_stay_right() {
    let Some(mut fixture) = Fixture::new().await else { return };
    let project = fixture.project(1).await;
    let DatasetCreation::Created(scene) =
        fixture.store.create_dataset(dataset(7, project, "a scene")).await.expect("created")
    else {
        panic!("it is new")
    };
    let succeeds = fixture.job(1, project, Some(scene.id), "a scene").await;
    fixture.finish(succeeded("a file")).await;
    let fails = fixture.job(2, project, None, "a dataset").await;
    fixture.finish(failed()).await;
    let cancelled = fixture.job(3, project, None, "another").await;
    fixture.store.cancel(cancelled).await.expect("an answer").expect("known");
    let export = ExportRecord {
        job: succeeds,
        source: blob("a file").digest,
        format: SceneFormat::Ply,
        blob: blob("as ply"),
        gaussians: 1,
        sh_degree: 0,
        fidelity: None,
    };
    fixture.store.add_export(export).await.expect("kept").expect("known");
    let repeat = RetryRequest { from_checkpoint: false, ..RetryRequest::of(JobId(Uuid::from_u128(4))) };
    fixture.store.retry_job(fails, repeat).await.expect("an answer").expect("known");
    let running = fixture.store.claim("worker").await.expect("an answer").expect("the retry").lease.job;
    let queued = fixture.job(5, project, None, "a dataset").await;
    let before = fixture.store.project_usage(Some(project), None, 1).await.expect("read").remove(0);

    fixture.clock.advance(DAY * 29);
    assert_eq!(fixture.remove(Some(KEEP)).await, 0);
    let late = fixture.job(6, project, None, "a third").await;
    fixture.store.cancel(late).await.expect("an answer").expect("known");
    fixture.clock.advance(DAY * 2);
    assert_eq!(fixture.remove(None).await, 0, "without a setting jobs are kept");
    assert_eq!(fixture.remove(Some(KEEP)).await, 3);
    fixture.check("retention").await;
    for gone in [succeeds, fails, cancelled] {
        assert_eq!(fixture.state(gone).await, None);
        assert_eq!(fixture.rows_of(gone).await, 0);
    }
    assert_eq!(fixture.state(running).await, Some(JobState::Running));
    assert_eq!(fixture.state(queued).await, Some(JobState::Queued));
    assert_eq!(fixture.state(late).await, Some(JobState::Cancelled));
    let retry = fixture.store.job(running).await.expect("read").expect("kept");
    assert_eq!((retry.retry_of, retry.job.version > 2), (None, true));
    assert!(fixture.store.dataset(scene.id).await.expect("read").is_some(), "scenes stay");
    let after = fixture.store.project_usage(Some(project), None, 1).await.expect("read").remove(0);
    assert_eq!((after.stored.artifacts, after.stored.exports), (0, 0));
    assert!(after.worker_seconds >= before.worker_seconds, "what was used does not fall");
    let files = ["a file", "the same cameras", "as ply", "another", "a dataset", "a scene"];
    let digests: Vec<Digest> = files.map(|content| blob(content).digest).to_vec();
    let forgotten = fixture.store.forget_blobs(&digests).await.expect("an answer");
    assert_eq!(forgotten, digests[..4], "the datasets of a job and of a scene are still used");
    fixture.check("a collection").await;
}

#[tokio::test]
async fn a_removal_is_many_short_transactions_and_stops_when_it_is_told() {
    let Some(fixture) = Fixture::new().await else { return };
    for number in 1..=35 {
        let job = fixture.job(number, ProjectId::DEFAULT, None, "a dataset").await;
        // Old jobs that have not ended lie between those that have.
        if number % 5 != 0 {
            fixture.store.cancel(job).await.expect("an answer").expect("known");
        }
    }
    fixture.clock.advance(DAY * 31);
    let stopped = CancellationToken::new();
    stopped.cancel();
    assert_eq!(remove_expired(&fixture.store, Some(KEEP), &stopped).await.expect("nothing"), 0);
    let (mut steps, mut after) = (Vec::new(), None);
    loop {
        let removed = fixture.store.remove_ended_jobs(KEEP, after).await.expect("removed");
        steps.push(removed.count);
        after = removed.next;
        if after.is_none() {
            break;
        }
        // Others write between two steps.
        fixture.job(100 + steps.len() as u128, ProjectId::DEFAULT, None, "a dataset").await;
    }
    assert_eq!(steps, [10, 10, 8]);
    let left = fixture.store.jobs(&JobFilter::default(), None, 99).await.expect("read");
    assert_eq!(left.len(), 7 + 2);
    assert!(left.iter().all(|record| record.job.state == JobState::Queued));
}

#[tokio::test]
async fn messages_of_removed_jobs_go_once_they_are_delivered() {
    let Some(mut fixture) = Fixture::new().await else { return };
    let project = fixture.project(1).await;
    let endpoint = fixture.endpoint(project).await;
    let job = fixture.job(1, project, None, "a dataset").await;
    fixture.finish(failed()).await;
    let messages = fixture.store.deliveries(endpoint, None, 9).await.expect("read");
    assert!(messages.len() >= 2, "{messages:?}");
    for _ in 1..messages.len() {
        fixture.deliver().await;
    }
    let week = Duration::from_secs(7 * 24 * 3600);
    fixture.clock.advance(DAY * 8);
    assert_eq!(fixture.remove(None).await, 0);
    assert_eq!(fixture.store.deliveries(endpoint, None, 9).await.expect("read").len(), messages.len());
    assert_eq!(fixture.remove(Some(week)).await, 1);
    let left = fixture.store.deliveries(endpoint, None, 9).await.expect("read");
    assert_eq!(
        left.iter().map(|message| (message.job, message.state)).collect::<Vec<_>>(),
        [(job, DeliveryState::Pending)]
    );
    fixture.deliver().await;
    fixture.remove(Some(week)).await;
    assert!(fixture.store.deliveries(endpoint, None, 9).await.expect("read").is_empty());
    fixture.check("the last message").await;
}

#[tokio::test]
async fn delivered_messages_go_after_thirty_days_although_their_job_stays() {
    let Some(mut fixture) = Fixture::new().await else { return };
    let project = fixture.project(1).await;
    let endpoint = fixture.endpoint(project).await;
    let [first, second] =
        [fixture.job(1, project, None, "a dataset").await, fixture.job(2, project, None, "a dataset").await];
    fixture.deliver().await;
    let told = async || {
        let messages = fixture.store.deliveries(endpoint, None, 9).await.expect("read");
        messages.iter().map(|message| message.job).collect::<Vec<_>>()
    };
    fixture.clock.advance(DAY * 30);
    fixture.remove(Some(KEEP / 2)).await;
    assert_eq!(told().await, [second, first], "the jobs have not ended");
    fixture.clock.advance(SignedDuration::from_secs(1));
    fixture.remove(None).await;
    assert_eq!(told().await, [second], "what is still to be delivered stays");
    fixture.deliver().await;
    assert_eq!(told().await, [], "delivered so late, it is not kept");
}

#[tokio::test]
async fn records_of_requests_and_messages_go_without_further_requests() {
    let Some(mut fixture) = Fixture::new().await else { return };
    let project = fixture.project(1).await;
    let mut new = fixture.new_job(1, project, "a dataset");
    new.intent =
        Some(IdempotentRequest { project, key: "a key".into(), fingerprint: Digest::of(b"a request") });
    fixture.store.create_job(new).await.expect("created");
    let requests = "SELECT count(*) FROM idempotency";
    fixture.clock.advance(SignedDuration::from_hours(23));
    fixture.remove(None).await;
    assert_eq!(fixture.database.number(requests).await, 1);
    // More than go in one transaction.
    fixture
        .database
        .run(
            "INSERT INTO idempotency (project, key, fingerprint, status, resource, created_at)
             WITH RECURSIVE counted (number) AS (SELECT 1 UNION ALL SELECT number + 1 FROM counted WHERE number < 1200)
             SELECT project, CAST(number AS TEXT), fingerprint, status, resource, created_at FROM idempotency, counted",
        )
        .await;
    assert_eq!(fixture.database.number(requests).await, 1201);
    fixture.clock.advance(SignedDuration::from_hours(2));
    fixture.remove(None).await;
    assert_eq!(fixture.database.number(requests).await, 0);
}
