//! The queue's guarantees, one test each, on a manual clock and on either database.

use std::{path::PathBuf, sync::Arc, time::Duration};

use bytes::Bytes;
use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{
        Clock, Digest, Event, EventKind, JobId, JobState, ManualClock, Metadata, Phase, Preparation, Problem,
        ProblemType, Progress, ProjectId, ProjectLimits, SceneFormat, SystemClock, TrainOptions,
    },
    store::{
        Artifact, ArtifactKind, AttemptOutcome, BlobRef, Blobs, Cancellation, Claim, DatabaseLocation,
        Deletion, IdempotentRequest, JobFilter, JobRecord, Lease, NewJob, NewProject, Outcome, PostgresUrl,
        ProjectChange, QueuePolicy, RetryOutcome, RetryRequest, Store, StoreError, WorkerDeath,
    },
};
use uuid::Uuid;

use crate::support::{database::Database, fakes};

/// Longest wait for another process.
const LONGEST: Duration = Duration::from_secs(120);

struct Queue {
    store: Store,
    clock: Arc<ManualClock>,
    database: Database,
}

impl Queue {
    async fn new() -> Option<Self> {
        Self::with(QueuePolicy::default()).await
    }

    async fn with(policy: QueuePolicy) -> Option<Self> {
        let database = super::database().await?;
        let start: Timestamp = "2026-11-21T12:00:00Z".parse().expect("an instant");
        let clock = Arc::new(ManualClock::new(start));
        let store = database.open(clock.clone(), policy).await;
        Some(Self { store, clock, database })
    }

    fn pass(&self, seconds: i64) {
        self.clock.advance(SignedDuration::from_secs(seconds));
    }

    async fn add(&self, number: u128) -> JobId {
        self.add_with_priority(number, 0).await
    }

    async fn add_with_priority(&self, number: u128, priority: i32) -> JobId {
        let id = JobId(Uuid::from_u128(number));
        let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
        let new = NewJob { priority, ..NewJob::new(id, TrainOptions::default(), dataset) };
        self.store.create_job(new).await.expect("created").job.id
    }

    async fn claim(&self) -> Option<Claim> {
        self.store.claim("worker").await.expect("a claim")
    }

    async fn lease(&self) -> Lease {
        self.claim().await.expect("something to claim").lease
    }

    async fn record(&self, id: JobId) -> JobRecord {
        self.store.job(id).await.expect("read").expect("known")
    }

    async fn state(&self, id: JobId) -> JobState {
        self.record(id).await.job.state
    }

    async fn events(&self, id: JobId) -> Vec<Event> {
        events(&self.store, id).await
    }

    async fn outcomes(&self, id: JobId) -> Vec<Option<AttemptOutcome>> {
        self.store.attempts(id).await.expect("read").into_iter().map(|attempt| attempt.outcome).collect()
    }
}

/// Every event of a job, whose numbers must count from 1.
async fn events(store: &Store, id: JobId) -> Vec<Event> {
    let events = store.events(id, 0, 1000).await.expect("read").expect("known");
    let numbers: Vec<u64> = events.iter().map(|event| event.seq).collect();
    assert_eq!(numbers, (1..=events.len() as u64).collect::<Vec<_>>(), "events must have no gaps");
    events
}

pub(super) fn succeeded() -> Outcome {
    let blob = BlobRef { digest: Digest::of(fakes::FILE), bytes: fakes::FILE.len() as u64 };
    Outcome::Succeeded {
        metrics: Box::new(fakes::metrics()),
        artifacts: vec![Artifact { kind: ArtifactKind::Scene(SceneFormat::Tcgs), lambda: None, blob }],
    }
}

fn problem() -> Problem {
    Problem::new(ProblemType::DeviceLost, "the adapter went away")
}

fn is_lost<T>(result: Result<T, StoreError>) -> bool {
    matches!(result, Err(StoreError::LeaseLost { .. }))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn claims_are_exclusive_under_32_concurrent_claimers() {
    let Some(queue) = Queue::new().await else { return };
    for number in 0..20 {
        queue.add(number).await;
    }
    let claimers = (0..32).map(|index| {
        let store = queue.store.clone();
        tokio::spawn(async move {
            let worker = format!("worker-{index}");
            let mut taken = Vec::new();
            while let Some(claim) = store.claim(&worker).await.expect("a claim") {
                taken.push(claim.lease.job);
            }
            taken
        })
    });
    let mut taken = Vec::new();
    for claimer in claimers.collect::<Vec<_>>() {
        taken.extend(claimer.await.expect("joined"));
    }
    taken.sort();
    assert_eq!(taken, (0..20).map(|number| JobId(Uuid::from_u128(number))).collect::<Vec<_>>());
}

/// Claimers in each child process of [`claims_are_exclusive_under_32_claimers_in_several_processes`].
const CLAIMERS: usize = 8;

/// Where a child finds the database, its folder, and its name.
const CHILD_DATABASE: &str = "TCGS_TEST_CLAIMING_CHILD_DATABASE";
const CHILD_FOLDER: &str = "TCGS_TEST_CLAIMING_CHILD_FOLDER";
const CHILD_NAME: &str = "TCGS_TEST_CLAIMING_CHILD_NAME";

/// Not a test of its own: a process whose claimers take all jobs that they can once the file `go` exists.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "the test of several processes runs it as a child process"]
async fn claiming_child_process() {
    let values = [CHILD_DATABASE, CHILD_FOLDER, CHILD_NAME].map(|name| std::env::var(name).ok());
    let [Some(database), Some(folder), Some(name)] = values else { return };
    let folder = PathBuf::from(folder);
    let location = match database.parse::<PostgresUrl>() {
        Ok(url) => DatabaseLocation::Postgres(url),
        Err(_) => DatabaseLocation::File(database.into()),
    };
    let store = Store::open(location, Arc::new(SystemClock), QueuePolicy::default()).await;
    let store = store.expect("a database");
    std::fs::write(folder.join(format!("{name}.ready")), "").expect("written");
    while !folder.join("go").exists() {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let claimers = (0..CLAIMERS).map(|number| {
        let (store, worker) = (store.clone(), format!("{name}-{number}"));
        tokio::spawn(async move {
            let mut taken = String::new();
            while let Some(claim) = store.claim(&worker).await.expect("a claim") {
                store.heartbeat(&claim.lease).await.expect("a heartbeat");
                taken += &format!("{} {worker}\n", claim.lease.job);
            }
            taken
        })
    });
    let mut taken = String::new();
    for claimer in claimers.collect::<Vec<_>>() {
        taken += &claimer.await.expect("joined");
    }
    std::fs::write(folder.join(format!("{name}.taken")), taken).expect("written");
}

#[tokio::test]
async fn claims_are_exclusive_under_32_claimers_in_several_processes() {
    let Some(queue) = Queue::new().await else { return };
    let mut jobs = Vec::new();
    for number in 0..60 {
        jobs.push(queue.add(number).await.to_string());
    }
    let folder = tempfile::tempdir().expect("a folder");
    let database = match queue.database.location() {
        DatabaseLocation::File(path) => path.into_os_string(),
        DatabaseLocation::Postgres(url) => url.expose().into(),
    };
    let module = module_path!().split_once("::").expect("a crate's name").1;
    let start = |name: &&str| {
        tokio::process::Command::new(std::env::current_exe().expect("a program"))
            .args([&*format!("{module}::claiming_child_process"), "--exact", "--ignored", "--test-threads=1"])
            .env(CHILD_DATABASE, &database)
            .env(CHILD_FOLDER, folder.path())
            .env(CHILD_NAME, name)
            .stdout(std::process::Stdio::null())
            .kill_on_drop(true)
            .spawn()
            .expect("the binary runs")
    };
    let names = ["one", "two", "three", "four"];
    let mut children: Vec<_> = names.iter().map(start).collect();
    let ready = async {
        while !names.iter().all(|name| folder.path().join(format!("{name}.ready")).exists()) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(LONGEST, ready).await.expect("all have opened the database");
    std::fs::write(folder.path().join("go"), "").expect("written");
    for child in &mut children {
        let status = tokio::time::timeout(LONGEST, child.wait()).await.expect("it ends").expect("a child");
        assert!(status.success());
    }
    let taken: String = names
        .iter()
        .map(|name| std::fs::read_to_string(folder.path().join(format!("{name}.taken"))).expect("written"))
        .collect();
    let mut all: Vec<_> =
        taken.lines().map(|line| line.split_once(' ').expect("a job and a worker")).collect();
    all.sort_unstable();
    assert_eq!(
        all.iter().map(|(job, _)| *job).collect::<Vec<_>>(),
        jobs,
        "each job is claimed once: {taken}"
    );
    for (job, worker) in all {
        let attempts = queue.store.attempts(job.parse().expect("an id")).await.expect("read");
        assert_eq!(attempts.len(), 1);
        assert_eq!(attempts[0].worker, worker);
    }
}

#[tokio::test]
async fn the_highest_priority_goes_first_then_the_oldest() {
    let Some(queue) = Queue::new().await else { return };
    let old = queue.add(9).await;
    queue.pass(1);
    let young = queue.add(1).await;
    let urgent = queue.add_with_priority(5, 10).await;
    let order = [queue.lease().await.job, queue.lease().await.job, queue.lease().await.job];
    assert_eq!(order, [urgent, old, young]);
    assert_eq!(queue.claim().await, None);
}

#[tokio::test]
async fn an_expired_lease_is_claimable_exactly_once() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let first = queue.lease().await;
    queue.pass(59);
    assert_eq!(queue.claim().await, None, "the lease still holds");
    queue.pass(1);
    let second = queue.lease().await;
    assert_eq!((second.job, second.attempt), (id, first.attempt + 1));
    assert_eq!(queue.claim().await, None);
    assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Lost), None]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn expired_leases_are_claimable_once_each_by_claimers_at_the_same_time() {
    let Some(queue) = Queue::new().await else { return };
    let other = another(&queue).await;
    let mut stale = Vec::new();
    for number in 1..=8 {
        queue.add(number).await;
        stale.push(queue.lease().await);
    }
    // Both processes have seen the leases, and neither a renewal.
    other.expire_leases().await.expect("observed");
    queue.pass(60);
    let claiming = (0..16).map(|number| {
        let store = if number % 2 == 0 { queue.store.clone() } else { other.clone() };
        tokio::spawn(async move {
            let mut granted = Vec::new();
            while let Some(claim) = store.claim(&format!("claimer {number}")).await.expect("a claim") {
                granted.push(claim.lease);
            }
            granted
        })
    });
    let mut granted = Vec::new();
    for claimer in claiming.collect::<Vec<_>>() {
        granted.extend(claimer.await.expect("joined"));
    }
    granted.sort_by_key(|lease| lease.job);
    let jobs: Vec<(JobId, u32)> = granted.iter().map(|lease| (lease.job, lease.attempt)).collect();
    assert_eq!(jobs, stale.iter().map(|lease| (lease.job, 2)).collect::<Vec<_>>());
    for (stale, live) in stale.iter().zip(&granted) {
        assert!(is_lost(queue.store.finish(stale, succeeded()).await));
        assert_eq!(queue.outcomes(live.job).await, [Some(AttemptOutcome::Lost), None]);
        queue.store.finish(live, succeeded()).await.expect("the only one");
    }
}

#[tokio::test]
async fn a_heartbeat_keeps_the_lease() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    let lease = queue.lease().await;
    for _ in 0..10 {
        queue.pass(45);
        assert_eq!(queue.claim().await, None);
        assert!(!queue.store.heartbeat(&lease).await.expect("renewed").cancel_requested);
    }
}

#[tokio::test]
async fn a_stale_attempt_cannot_finish_checkpoint_report_or_emit_events() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let stale = queue.lease().await;
    queue.pass(60);
    let live = queue.lease().await;
    let before = (queue.record(id).await, queue.events(id).await);
    assert!(is_lost(queue.store.heartbeat(&stale).await));
    let progress = Progress { checkpoint_step: 900, ..Progress::default() };
    assert!(is_lost(queue.store.report(&stale, Phase::Train, &progress).await));
    assert!(is_lost(queue.store.record(&stale, &[progress]).await));
    assert_eq!(
        queue.database.number("SELECT checkpoint_step FROM jobs").await,
        0,
        "its checkpoint counts for nothing"
    );
    for outcome in [
        succeeded(),
        Outcome::Failed(problem()),
        Outcome::Retry(problem()),
        Outcome::Cancelled,
        Outcome::Released,
    ] {
        assert!(is_lost(queue.store.finish(&stale, outcome).await));
    }
    assert_eq!((queue.record(id).await, queue.events(id).await), before, "nothing was written");
    let impostor = Lease { worker: "another".into(), ..live.clone() };
    assert!(is_lost(queue.store.heartbeat(&impostor).await));
    assert_eq!(queue.store.finish(&live, succeeded()).await.expect("finished"), JobState::Succeeded);
    assert!(is_lost(queue.store.finish(&live, succeeded()).await), "and only once");
}

#[tokio::test]
async fn a_queued_job_is_cancelled_at_once() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let answer = queue.store.cancel(id).await.expect("written").expect("known");
    assert!(matches!(answer, Cancellation::Done(record) if record.job.state == JobState::Cancelled));
    assert_eq!(queue.claim().await, None);
    assert!(queue.store.cancel(JobId(Uuid::from_u128(404))).await.expect("read").is_none());
}

#[tokio::test]
async fn a_running_job_learns_of_its_cancellation_with_the_heartbeat() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let lease = queue.lease().await;
    for _ in 0..2 {
        let answer = queue.store.cancel(id).await.expect("written").expect("known");
        assert!(matches!(answer, Cancellation::Requested(record) if record.job.cancel_requested));
    }
    assert!(queue.store.heartbeat(&lease).await.expect("renewed").cancel_requested);
    assert_eq!(queue.store.finish(&lease, Outcome::Cancelled).await.expect("ended"), JobState::Cancelled);
    let asked = queue.events(id).await.iter().filter(|event| event.data["cancel_requested"] == true).count();
    assert_eq!(asked, 1, "asking twice changes nothing");
}

/// Both orders come about, and whichever it is, both callers are told the same.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn cancellation_and_completion_at_the_same_time_have_one_outcome() {
    let Some(queue) = Queue::new().await else { return };
    for number in 0..40 {
        let id = queue.add(number).await;
        let lease = queue.lease().await;
        let (cancelling, finishing) = (queue.store.clone(), queue.store.clone());
        let cancelled = tokio::spawn(async move { cancelling.cancel(id).await });
        let finished = tokio::spawn(async move { finishing.finish(&lease, succeeded()).await });
        let answer = cancelled.await.expect("joined").expect("written").expect("known");
        let state = finished.await.expect("joined").expect("ended");
        let record = queue.record(id).await;
        assert_eq!(record.job.state, state);
        match state {
            JobState::Succeeded => assert!(matches!(answer, Cancellation::TooLate(_)), "{answer:?}"),
            JobState::Cancelled => assert!(matches!(answer, Cancellation::Requested(_)), "{answer:?}"),
            state => panic!("{state:?}"),
        }
        assert_eq!(record.artifacts.is_empty(), state == JobState::Cancelled);
        queue.events(id).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn bounds_of_a_project_hold_against_requests_at_the_same_time() {
    let Some(queue) = Queue::new().await else { return };
    let limits =
        ProjectLimits { max_active_jobs: Some(7), max_running_jobs: Some(3), ..ProjectLimits::default() };
    let project = project(&queue, 77, limits).await;
    let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
    let requests = (0..40).map(|number| {
        let store = queue.store.clone();
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        tokio::spawn(async move { store.create_job(NewJob { project, ..new }).await })
    });
    let mut made = 0;
    for request in requests.collect::<Vec<_>>() {
        match request.await.expect("joined") {
            Ok(_) => made += 1,
            Err(StoreError::TooManyJobs { active }) => assert_eq!(active, 7),
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!(made, 7);
    let claims = (0..16).map(|number| {
        let store = queue.store.clone();
        tokio::spawn(async move { store.claim(&format!("worker-{number}")).await })
    });
    let mut running = 0;
    for claim in claims.collect::<Vec<_>>() {
        running += usize::from(claim.await.expect("joined").expect("a claim").is_some());
    }
    assert_eq!(running, 3);
}

/// Everything that changes jobs, at the same time, over few projects and blobs: nothing fails, and totals stay right.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn changes_at_the_same_time_neither_fail_nor_lose_count() {
    let Some(queue) = Queue::new().await else { return };
    let mut projects = vec![ProjectId::DEFAULT];
    for number in 71..74 {
        projects.push(project(&queue, number, ProjectLimits::default()).await);
    }
    let tasks = (0..12_u128).map(|task| {
        let (store, projects) = (queue.store.clone(), projects.clone());
        tokio::spawn(async move {
            for round in 0..12_u128 {
                let number = 1000 * task + round;
                let dataset =
                    BlobRef { digest: Digest::of(&[(number % 3) as u8]), bytes: 7 + (number % 3) as u64 };
                let id = JobId(Uuid::from_u128(number));
                let new = NewJob::new(id, TrainOptions::default(), dataset);
                let project = projects[(number % 4) as usize];
                store.create_job(NewJob { project, ..new }).await.expect("created");
                if let Some(claim) = store.claim(&format!("worker-{task}")).await.expect("a claim") {
                    store.report(&claim.lease, Phase::Train, &Progress::default()).await.expect("reported");
                    let ended = store.finish(&claim.lease, succeeded()).await.expect("ended");
                    assert!(matches!(ended, JobState::Succeeded | JobState::Cancelled));
                }
                match round % 3 {
                    0 => drop(store.cancel(id).await.expect("an answer")),
                    1 => drop(store.delete_job(id, None).await.expect("an answer")),
                    _ => drop(store.forget_blobs(&[dataset.digest]).await.expect("an answer")),
                }
            }
        })
    });
    for task in tasks.collect::<Vec<_>>() {
        task.await.expect("joined");
    }
    let counted = |column: &str, states: &str| {
        format!(
            "SELECT count(*) FROM projects JOIN project_totals ON project_totals.project = projects.id WHERE {column} <>
                 (SELECT count(*) FROM jobs WHERE jobs.project = projects.id AND state IN ({states}))"
        )
    };
    for (column, states) in [
        ("queued_jobs", "'queued'"),
        ("running_jobs", "'running'"),
        ("succeeded_jobs", "'succeeded'"),
        ("cancelled_jobs", "'cancelled'"),
    ] {
        assert_eq!(queue.database.number(&counted(column, states)).await, 0, "{column}");
    }
    let gaps =
        "SELECT count(*) FROM jobs WHERE last_seq <> (SELECT count(*) FROM events WHERE job_id = jobs.id)";
    assert_eq!(queue.database.number(gaps).await, 0);
}

#[tokio::test]
async fn a_finished_job_cannot_be_cancelled() {
    let Some(queue) = Queue::new().await else { return };
    let done = queue.add(1).await;
    queue.store.finish(&queue.lease().await, succeeded()).await.expect("finished");
    let failed = queue.add(2).await;
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("finished");
    for id in [done, failed] {
        let before = queue.record(id).await;
        let answer = queue.store.cancel(id).await.expect("read").expect("known");
        assert_eq!(answer, Cancellation::TooLate(before.clone()));
        assert_eq!(queue.record(id).await, before);
    }
}

#[tokio::test]
async fn cancel_and_completion_are_decided_by_whichever_commits_first() {
    let Some(queue) = Queue::new().await else { return };
    let cancelled_first = queue.add(1).await;
    let lease = queue.lease().await;
    queue.store.cancel(cancelled_first).await.expect("written");
    assert_eq!(queue.store.finish(&lease, succeeded()).await.expect("ended"), JobState::Cancelled);
    let record = queue.record(cancelled_first).await;
    assert_eq!((record.artifacts, record.job.metrics), (vec![], None), "nothing is published");

    let completed_first = queue.add(2).await;
    let lease = queue.lease().await;
    queue.store.finish(&lease, succeeded()).await.expect("finished");
    let answer = queue.store.cancel(completed_first).await.expect("read").expect("known");
    assert!(matches!(answer, Cancellation::TooLate(_)));
    assert_eq!(queue.state(completed_first).await, JobState::Succeeded);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_race_of_cancel_and_completion_leaves_one_consistent_end() {
    let Some(queue) = Queue::new().await else { return };
    for number in 0..25 {
        let id = queue.add(number).await;
        let lease = queue.lease().await;
        let (cancelled, finished) =
            tokio::join!(queue.store.cancel(id), queue.store.finish(&lease, succeeded()));
        let (cancelled, finished) =
            (cancelled.expect("answered").expect("known"), finished.expect("answered"));
        let record = queue.record(id).await;
        assert_eq!(record.job.state, finished);
        let accepted = !matches!(cancelled, Cancellation::TooLate(_));
        assert_eq!(accepted, finished == JobState::Cancelled);
        assert_eq!(record.artifacts.is_empty(), accepted);
    }
}

#[tokio::test]
async fn a_retry_waits_out_its_delay() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let state = queue.store.finish(&queue.lease().await, Outcome::Retry(problem())).await.expect("ended");
    assert_eq!(state, JobState::Queued);
    queue.pass(8);
    assert_eq!(queue.claim().await, None, "the delay is 9 to 11 seconds");
    let other = queue.add(2).await;
    assert_eq!(queue.lease().await.job, other, "a younger job goes ahead of one that must wait");
    assert_eq!(queue.claim().await, None);
    queue.pass(4);
    assert_eq!(queue.lease().await.attempt, 2);
    let ended = queue.events(id).await.into_iter().find(|event| event.kind == EventKind::Attempt);
    let ended = ended.expect("an attempt event");
    assert_eq!((ended.attempt, &ended.data["outcome"]), (1, &serde_json::json!("retried")));
    assert_eq!(ended.data["cause"]["type"], "urn:tcgs:problem:device-lost");
}

#[tokio::test]
async fn when_the_attempts_are_used_up_the_job_fails_and_its_attempts_stay_recorded() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    for attempt in 1..=3 {
        let lease = queue.lease().await;
        assert_eq!(lease.attempt, attempt);
        queue.store.finish(&lease, Outcome::Retry(problem())).await.expect("ended");
        queue.pass(3600);
    }
    let record = queue.record(id).await;
    assert_eq!(record.job.state, JobState::Failed);
    let error = record.job.error.expect("a reason");
    assert_eq!(error.kind, problem().kind);
    assert!(error.detail.contains("3 attempts"), "{error}");
    let history = queue.store.attempts(id).await.expect("read");
    assert_eq!(history.len(), 3);
    assert!(history.iter().all(|attempt| attempt.cause == Some(problem()) && attempt.ended_at.is_some()));
    assert_eq!(queue.claim().await, None);
}

#[tokio::test]
async fn bad_input_is_not_retried() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    assert_eq!(queue.record(id).await.job.error, Some(problem()));
    assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Failed)]);
}

#[tokio::test]
async fn a_job_that_crashes_two_workers_is_not_given_to_a_third() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.lease().await;
    assert_eq!(queue.store.expire_worker("worker", WorkerDeath::Alone).await.expect("taken"), 1);
    queue.lease().await;
    queue.pass(60);
    assert_eq!(queue.claim().await, None);
    let error = queue.record(id).await.job.error.expect("a reason");
    assert_eq!(error.kind, "urn:tcgs:problem:resource-exhausted");
    assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Lost), Some(AttemptOutcome::Lost)]);
}

/// A second store on the same database, as another process would open it.
async fn another(queue: &Queue) -> Store {
    queue.database.open(queue.clock.clone(), QueuePolicy::default()).await
}

#[tokio::test]
async fn no_number_of_power_cuts_costs_a_job() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    for cut in 0..12 {
        // Every other time a supervisor finds its predecessor's worker dead; else the lease has to run out.
        let store = another(&queue).await;
        let claim = store.claim("worker").await.expect("a claim").expect("the job");
        assert_eq!(claim.lease.attempt, cut + 1);
        drop(store);
        let after = another(&queue).await;
        if cut % 2 == 0 {
            assert_eq!(after.expire_worker("worker", WorkerDeath::WithService).await.expect("taken"), 1);
        } else {
            assert_eq!(after.expire_leases().await.expect("looked"), 0, "it has seen nothing yet");
            queue.pass(59);
            assert_eq!(after.claim("next").await.expect("a claim"), None);
            queue.pass(1);
            assert_eq!(after.expire_leases().await.expect("looked"), 1);
        }
        assert_eq!(queue.state(id).await, JobState::Queued);
        // A job that gets nowhere waits longer and longer.
        queue.pass(3600);
    }
    let lost = queue.store.attempts(id).await.expect("read");
    assert!(lost.iter().all(|attempt| attempt.outcome == Some(AttemptOutcome::Lost)));
    let cause = lost[0].cause.as_ref().expect("a cause");
    assert!(cause.detail.contains("does not count against the job"), "{cause}");
    // All its retries are left to it.
    for attempt in 1..=3 {
        let state = queue.store.finish(&queue.lease().await, Outcome::Retry(problem())).await.expect("ended");
        assert_eq!(state, if attempt < 3 { JobState::Queued } else { JobState::Failed });
        queue.pass(3600);
    }
}

#[tokio::test]
async fn power_cuts_delay_a_job_only_after_several_without_progress() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    let lose = async || {
        let lease = queue.lease().await;
        queue.store.expire_worker("worker", WorkerDeath::WithService).await.expect("taken");
        lease.attempt
    };
    for attempt in 1..=4 {
        assert_eq!(lose().await, attempt);
    }
    assert_eq!(queue.claim().await, None, "the fourth in a row is followed by a pause");
    queue.pass(11);
    let lease = queue.lease().await;
    let progress = Progress { checkpoint_step: 7, ..Progress::default() };
    queue.store.report(&lease, Phase::Train, &progress).await.expect("reported");
    queue.store.expire_worker("worker", WorkerDeath::WithService).await.expect("taken");
    assert_eq!(lose().await, 6, "whoever gets on is not kept waiting");
}

#[tokio::test]
async fn a_worker_that_died_alone_counts_against_its_job_only_without_a_new_checkpoint() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let die_at = async |checkpoint_step| {
        let lease = queue.lease().await;
        let progress = Progress { checkpoint_step, ..Progress::default() };
        queue.store.report(&lease, Phase::Train, &progress).await.expect("reported");
        queue.store.expire_worker("worker", WorkerDeath::Alone).await.expect("taken");
        // An attempt that was overtaken can say nothing of checkpoints.
        let late = Progress { checkpoint_step: 1_000_000, ..Progress::default() };
        assert!(is_lost(queue.store.report(&lease, Phase::Train, &late).await));
    };
    for checkpoint in [0, 100, 200, 300, 400, 500] {
        die_at(checkpoint).await;
        assert_eq!(queue.state(id).await, JobState::Queued);
    }
    die_at(500).await;
    let error = queue.record(id).await.job.error.expect("a reason");
    assert_eq!(error.kind, "urn:tcgs:problem:resource-exhausted");
    assert!(
        error.detail.contains("2 attempts in a row") && error.detail.contains("checkpoint at step 500"),
        "{error}"
    );
}

#[tokio::test]
async fn a_process_that_observed_the_lease_renewed_knows_that_the_worker_died_alone() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let service = another(&queue).await;
    assert_eq!(service.expire_leases().await.expect("looked"), 0);
    for _ in 0..2 {
        another(&queue).await.claim("worker").await.expect("a claim").expect("the job");
        assert_eq!(service.expire_leases().await.expect("looked"), 0, "this is when it came");
        queue.pass(60);
        assert_eq!(service.expire_leases().await.expect("looked"), 1);
    }
    let error = queue.record(id).await.job.error.expect("a reason");
    assert!(error.detail.contains("2 attempts in a row ended before its first checkpoint"), "{error}");
}

#[tokio::test]
async fn a_clock_that_jumps_takes_no_job_from_its_worker() {
    let Some(queue) = Queue::new().await else { return };
    let running = queue.add(1).await;
    let lease = queue.lease().await;
    let other = queue.add(2).await;
    for hours in [1, -2, 24 * 365, -24 * 365 * 2] {
        queue.clock.set_by(SignedDuration::from_hours(hours));
        assert_eq!(queue.store.expire_leases().await.expect("looked"), 0);
        let waiting = queue.claim().await.expect("the other job").lease;
        assert_eq!(waiting.job, other, "the first is still its worker's");
        queue.store.finish(&waiting, Outcome::Released).await.expect("released");
        queue.pass(59);
        assert!(!queue.store.heartbeat(&lease).await.expect("renewed").cancel_requested);
    }
    assert_eq!(queue.outcomes(running).await, [None]);
}

#[tokio::test]
async fn other_processes_notice_renewals_on_a_clock_that_is_set_back_to_the_same_time() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    let lease = queue.lease().await;
    let other = another(&queue).await;
    for _ in 0..4 {
        assert_eq!(other.expire_leases().await.expect("looked"), 0);
        queue.pass(40);
        queue.clock.set_by(SignedDuration::from_secs(-40));
        queue.store.heartbeat(&lease).await.expect("renewed");
    }
}

#[tokio::test]
async fn a_time_without_the_database_takes_no_job_from_its_worker() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    let lease = queue.lease().await;
    assert_eq!(queue.store.expire_leases().await.expect("looked"), 0);
    queue.pass(50);
    queue.database.run("ALTER TABLE jobs RENAME TO jobs_that_are_away").await;
    assert!(queue.store.heartbeat(&lease).await.is_err());
    queue.pass(50);
    queue.database.run("ALTER TABLE jobs_that_are_away RENAME TO jobs").await;
    assert_eq!(queue.store.expire_leases().await.expect("looked"), 0, "it could not be renewed");
    queue.pass(59);
    queue.store.heartbeat(&lease).await.expect("still held");
}

#[tokio::test]
async fn a_worker_that_has_lost_its_lease_delays_the_end_of_no_other() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    let over = queue.lease().await;
    queue.store.finish(&over, succeeded()).await.expect("ended");
    let id = queue.add(2).await;
    queue.lease().await;
    queue.pass(59);
    assert!(is_lost(queue.store.heartbeat(&over).await));
    queue.pass(1);
    assert_eq!(queue.store.expire_leases().await.expect("looked"), 1);
    assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Lost)]);
}

#[tokio::test]
async fn a_clock_that_is_set_back_delays_no_job() {
    let Some(queue) = Queue::new().await else { return };
    let back = || queue.clock.set_by(SignedDuration::from_hours(-1));
    let id = queue.add(1).await;
    back();
    let lease = queue.lease().await;
    assert_eq!(lease.job, id, "a job that was made later than now");
    queue.store.finish(&lease, Outcome::Retry(problem())).await.expect("ended");
    assert_eq!(queue.claim().await, None, "it waits out its delay");
    back();
    let lease = queue.lease().await;
    assert_eq!(lease.attempt, 2, "but not an hour more");
    queue.store.finish(&lease, Outcome::Held(problem())).await.expect("ended");
    back();
    assert_eq!(queue.lease().await.attempt, 3);
    // A lease that lasts into the future is over when nobody has renewed it.
    back();
    queue.pass(60);
    assert_eq!(queue.lease().await.attempt, 4);
}

#[tokio::test]
async fn changes_to_one_job_end_no_lease_of_another() {
    let Some(queue) = Queue::new().await else { return };
    let [theirs, cancelled, deleted] = [queue.add(1).await, queue.add(2).await, queue.add(3).await];
    for _ in 0..3 {
        queue.lease().await;
    }
    queue.pass(60);
    assert!(matches!(queue.store.cancel(cancelled).await.expect("written"), Some(Cancellation::Done(_))));
    queue.store.delete_job(deleted, None).await.expect("answered");
    assert_eq!(queue.outcomes(cancelled).await, [Some(AttemptOutcome::Lost)]);
    assert_eq!(queue.outcomes(deleted).await, [Some(AttemptOutcome::Lost)]);
    assert_eq!((queue.state(theirs).await, queue.outcomes(theirs).await), (JobState::Running, vec![None]));
}

#[tokio::test]
async fn a_held_job_states_the_cause_and_is_retried_without_a_charge() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let full = Problem::new(ProblemType::StorageFull, "no room");
    for attempt in 1..=5 {
        let lease = queue.lease().await;
        assert_eq!(lease.attempt, attempt);
        let state = queue.store.finish(&lease, Outcome::Held(full.clone())).await.expect("ended");
        assert_eq!(state, JobState::Queued);
        assert_eq!(queue.claim().await, None, "it waits");
        queue.pass(if attempt == 1 { 10 } else { 60 });
    }
    assert_eq!(queue.record(id).await.job.error, None, "it has not failed");
    let events = queue.events(id).await;
    let held: Vec<_> = events.iter().filter(|event| event.kind == EventKind::Attempt).collect();
    assert_eq!(held.len(), 5);
    assert!(held.iter().all(|event| {
        event.data["outcome"] == "released" && event.data["cause"]["type"] == full.kind.as_str()
    }));
    for _ in 0..2 {
        queue.store.finish(&queue.lease().await, Outcome::Retry(problem())).await.expect("ended");
        queue.pass(3600);
    }
    assert_eq!(
        queue.store.finish(&queue.lease().await, succeeded()).await.expect("ended"),
        JobState::Succeeded
    );
}

#[tokio::test]
async fn a_job_that_was_released_before_waits_no_longer_at_its_first_hold() {
    let Some(queue) = Queue::new().await else { return };
    queue.add(1).await;
    for _ in 0..3 {
        queue.store.finish(&queue.lease().await, Outcome::Released).await.expect("ended");
    }
    for seconds in [10, 20, 40, 60] {
        queue.store.finish(&queue.lease().await, Outcome::Held(problem())).await.expect("ended");
        queue.pass(seconds - 1);
        assert_eq!(queue.claim().await, None, "it waits for {seconds} s");
        queue.pass(1);
    }
    queue.store.finish(&queue.lease().await, Outcome::Released).await.expect("ended");
    queue.store.finish(&queue.lease().await, Outcome::Held(problem())).await.expect("ended");
    queue.pass(10);
    queue.lease().await;
}

async fn project(queue: &Queue, number: u128, limits: ProjectLimits) -> ProjectId {
    let new = NewProject { id: ProjectId(Uuid::from_u128(number)), name: "a project".into(), limits };
    queue.store.create_project(new).await.expect("created").id
}

async fn add_of(queue: &Queue, number: u128, project: ProjectId, priority: i32) -> JobId {
    queue.pass(1);
    let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
    let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
    queue.store.create_job(NewJob { project, priority, ..new }).await.expect("created").job.id
}

#[tokio::test]
async fn at_equal_priority_the_project_with_the_fewest_running_jobs_is_served_first() {
    let Some(queue) = Queue::new().await else { return };
    let free = ProjectLimits::default();
    let (busy, other) = (project(&queue, 100, free).await, project(&queue, 101, free).await);
    let add = async |number, project, priority| add_of(&queue, number, project, priority).await;
    let of_busy =
        [add(1, busy, 0).await, add(2, busy, 0).await, add(3, busy, 0).await, add(4, busy, -1).await];
    let of_other = [add(5, other, 0).await, add(6, other, 0).await];
    let nobody = add(7, ProjectId::DEFAULT, 0).await;
    let mut order = Vec::new();
    let mut leases = Vec::new();
    while let Some(claim) = queue.claim().await {
        order.push(claim.lease.job);
        leases.push(claim.lease);
    }
    assert_eq!(
        order,
        [of_busy[0], of_other[0], nobody, of_busy[1], of_other[1], of_busy[2], of_busy[3]],
        "in turn, the oldest of each, and those of low priority last"
    );
    for lease in &leases {
        queue.store.finish(lease, succeeded()).await.expect("ended");
    }
    // Jobs that have ended are no reason to wait.
    let (older, younger) = (add(8, busy, 0).await, add(9, other, 0).await);
    assert_eq!([queue.lease().await.job, queue.lease().await.job], [older, younger]);
}

#[tokio::test]
async fn one_worker_serves_projects_in_turn_however_many_jobs_each_has_queued() {
    let Some(queue) = Queue::new().await else { return };
    let free = ProjectLimits::default();
    let (busy, other) = (project(&queue, 100, free).await, project(&queue, 101, free).await);
    for number in 1..=6 {
        add_of(&queue, number, busy, 0).await;
    }
    for number in 7..=8 {
        add_of(&queue, number, other, 0).await;
    }
    let mut order = Vec::new();
    while let Some(claim) = queue.claim().await {
        order.push(claim.lease.job.0.as_u128());
        queue.pass(5);
        queue.store.finish(&claim.lease, succeeded()).await.expect("ended");
    }
    assert_eq!(order, [1, 7, 2, 8, 3, 4, 5, 6]);

    // A project that was idle takes no turns for that, and waits for none.
    for number in 11..=13 {
        add_of(&queue, number, busy, 0).await;
    }
    let first = queue.lease().await;
    add_of(&queue, 14, other, 0).await;
    add_of(&queue, 15, other, 0).await;
    queue.store.finish(&first, succeeded()).await.expect("ended");
    let mut order = vec![first.job.0.as_u128()];
    while let Some(claim) = queue.claim().await {
        order.push(claim.lease.job.0.as_u128());
        queue.store.finish(&claim.lease, succeeded()).await.expect("ended");
    }
    assert_eq!(order, [11, 14, 12, 15, 13]);
}

#[tokio::test]
async fn a_project_runs_no_more_jobs_than_it_may_while_others_go_on() {
    let Some(queue) = Queue::new().await else { return };
    let capped = ProjectLimits { max_running_jobs: Some(2), ..ProjectLimits::default() };
    let (one, other) = (
        project(&queue, 100, capped).await,
        project(&queue, 101, ProjectLimits { max_running_jobs: Some(0), ..capped }).await,
    );
    for number in 1..=4 {
        add_of(&queue, number, one, 50).await;
    }
    add_of(&queue, 5, other, 0).await;
    add_of(&queue, 6, ProjectId::DEFAULT, -1).await;
    let leases = [queue.lease().await, queue.lease().await, queue.lease().await];
    assert_eq!(leases.clone().map(|lease| lease.job.0.as_u128()), [1, 2, 6]);
    assert!(queue.claim().await.is_none(), "two of the first project run, and the second may run none");
    queue.store.finish(&leases[0], Outcome::Retry(problem())).await.expect("ended");
    assert_eq!(
        queue.lease().await.job.0.as_u128(),
        3,
        "the one that is to be tried again waits for its time"
    );
    queue.pass(12);
    assert!(queue.claim().await.is_none());
    queue.store.finish(&leases[1], succeeded()).await.expect("ended");
    assert_eq!(queue.lease().await.job.0.as_u128(), 1, "by age again");

    let change = ProjectChange { name: "other".into(), limits: ProjectLimits::default() };
    queue.store.update_project(other, None, change).await.expect("an answer").expect("known");
    assert_eq!(queue.lease().await.job.0.as_u128(), 5, "a limit that is raised holds at once");
}

#[tokio::test]
async fn a_queued_job_shows_its_position_in_its_project_and_its_attempts() {
    let Some(queue) = Queue::new().await else { return };
    let one = project(&queue, 100, ProjectLimits::default()).await;
    for (number, priority) in [(1, 0), (2, 0), (3, 5), (4, -1)] {
        add_of(&queue, number, one, priority).await;
    }
    add_of(&queue, 5, ProjectId::DEFAULT, 9).await;
    let shown =
        async |number| queue.store.job(JobId(Uuid::from_u128(number))).await.expect("read").expect("known");
    let mut positions = Vec::new();
    for number in 1..=5 {
        positions.push(shown(number).await.queue_position);
    }
    assert_eq!(positions, [Some(2), Some(3), Some(1), Some(4), Some(1)]);
    let taken = queue.lease().await;
    assert_eq!(shown(taken.job.0.as_u128()).await.queue_position, None, "it runs");

    let lease = queue.lease().await;
    assert_eq!((lease.job.0.as_u128(), shown(1).await.queue_position), (3, Some(1)));
    queue.pass(7);
    queue.store.finish(&lease, Outcome::Retry(problem())).await.expect("ended");
    let attempts = shown(3).await.attempts;
    assert_eq!(attempts.len(), 1);
    assert_eq!((attempts[0].number, attempts[0].outcome), (1, Some(AttemptOutcome::Retried)));
    assert_eq!(attempts[0].cause.as_ref().map(|cause| cause.kind.clone()), Some(problem().kind));
}

#[tokio::test]
async fn positions_are_counted_up_to_a_bound_which_stands_for_all_later_ones() {
    let Some(queue) = Queue::new().await else { return };
    let first = queue.add(1).await;
    let columns = "project, dataset, options, state, phase, progress, priority, run_after, max_attempts";
    let more = format!(
        "INSERT INTO jobs (id, created_at, {columns})
         WITH RECURSIVE counted (number) AS (SELECT 2 UNION ALL SELECT number + 1 FROM counted WHERE number < 1002)
         SELECT '00000000-0000-0000-0000-' || CAST(100000000000 + number AS TEXT), created_at + number, {columns} FROM jobs, counted"
    );
    queue.database.run(&more).await;
    let position = async |id| queue.record(id).await.queue_position;
    assert_eq!(position(first).await, Some(1));
    for (number, expected) in [(2, 2), (999, 999), (1000, 1000), (1001, 1000), (1002, 1000)] {
        let id = format!("00000000-0000-0000-0000-{}", 100_000_000_000_u64 + number);
        assert_eq!(position(id.parse().expect("an id")).await, Some(expected), "job {number}");
    }
}

#[tokio::test]
async fn scenes_of_a_curve_keep_their_order() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let artifact = |kind, lambda, content: &str| {
        let blob = BlobRef { digest: Digest::of(content.as_bytes()), bytes: content.len() as u64 };
        Artifact { kind, lambda, blob }
    };
    let scene = ArtifactKind::Scene(SceneFormat::Tcgs);
    let artifacts = vec![
        artifact(scene, Some(0.002), "middle"),
        artifact(ArtifactKind::Cameras, None, "cameras"),
        artifact(scene, Some(0.004), "small"),
        artifact(scene, Some(0.001), "large"),
    ];
    let outcome = Outcome::Succeeded { metrics: Box::new(fakes::metrics()), artifacts: artifacts.clone() };
    queue.store.finish(&queue.lease().await, outcome).await.expect("ended");
    let kept = queue.record(id).await;
    let of = |kind| kept.artifacts.iter().filter(|kept| kept.kind == kind).copied().collect::<Vec<_>>();
    assert_eq!(of(scene), [artifacts[0], artifacts[2], artifacts[3]]);
    assert_eq!(of(ArtifactKind::Cameras), [artifacts[1]]);
}

#[tokio::test]
async fn limits_of_the_service_hold_for_projects_without_their_own_but_the_default_one() {
    let limits = ProjectLimits {
        quota_bytes: Some(10),
        max_active_jobs: Some(1),
        max_running_jobs: Some(1),
        max_priority: Some(3),
    };
    let Some(queue) = Queue::with(QueuePolicy { limits, ..QueuePolicy::default() }).await else { return };
    let own = ProjectLimits { quota_bytes: Some(20), max_active_jobs: Some(2), ..ProjectLimits::default() };
    let [one, other] =
        [project(&queue, 100, ProjectLimits::default()).await, project(&queue, 101, own).await];
    let create = |number, project, content: &'static str| {
        let dataset = BlobRef { digest: Digest::of(content.as_bytes()), bytes: content.len() as u64 };
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        queue.store.create_job(NewJob { project, ..new })
    };
    create(1, one, "dataset").await.expect("room");
    assert!(matches!(create(2, one, "dataset").await, Err(StoreError::TooManyJobs { active: 1 })));
    queue.store.cancel(JobId(Uuid::from_u128(1))).await.expect("cancelled");
    let refused = create(2, one, "more").await;
    assert!(
        matches!(refused, Err(StoreError::QuotaExceeded { requested: 4, used: 7, quota: 10 })),
        "{refused:?}"
    );
    create(2, one, "few").await.expect("room");
    for number in 3..=4 {
        create(number, other, "as many as that").await.expect("room");
    }
    assert!(matches!(create(5, other, "dataset").await, Err(StoreError::TooManyJobs { active: 2 })));
    for number in 5..=7 {
        create(number, ProjectId::DEFAULT, "as many as that").await.expect("the default project has neither");
    }
    let in_force = async |project| {
        let usage = queue.store.project_usage(Some(project), None, 1).await.expect("read").remove(0);
        let capacity = queue.store.capacity(project).await.expect("read");
        assert_eq!(capacity.quota, usage.limits.quota_bytes);
        usage.limits
    };
    assert_eq!(in_force(one).await, limits);
    assert_eq!(in_force(other).await, own.or(limits));
    assert_eq!(
        in_force(ProjectId::DEFAULT).await,
        ProjectLimits { quota_bytes: None, max_active_jobs: None, ..limits }
    );
    let mut running = Vec::new();
    while let Some(claim) = queue.claim().await {
        running.push(claim.lease.job.0.as_u128());
    }
    assert_eq!(running, [2, 3, 5], "one of each");
}

#[tokio::test]
async fn what_a_project_uses_is_counted_by_kind_and_by_time() {
    let Some(queue) = Queue::new().await else { return };
    let limits = ProjectLimits { quota_bytes: Some(1000), ..ProjectLimits::default() };
    let one = project(&queue, 100, limits).await;
    add_of(&queue, 1, one, 0).await;
    add_of(&queue, 2, one, 0).await;
    let lease = queue.lease().await;
    queue.pass(30);
    queue.store.finish(&lease, succeeded()).await.expect("ended");
    let running = queue.lease().await;
    queue.pass(5);
    let usage = async |project| queue.store.project_usage(project, None, 9).await.expect("read");
    let [own] = &usage(Some(one)).await[..] else { panic!("one project") };
    assert_eq!((own.project.id, own.stored.datasets, own.stored.exports), (one, 7, 0));
    assert!(own.stored.artifacts > 0);
    assert_eq!(own.worker_seconds, 35.0);
    let count = |state| own.jobs.iter().find(|(counted, _)| *counted == state).map(|(_, count)| *count);
    assert_eq!((count(JobState::Running), count(JobState::Succeeded)), (Some(1), Some(1)));
    assert_eq!(own.limits.quota_bytes, Some(1000));
    queue.store.finish(&running, Outcome::Failed(problem())).await.expect("ended");
    queue.store.delete_job(running.job, None).await.expect("an answer").expect("known");
    let all = usage(None).await;
    assert_eq!(all.iter().map(|usage| usage.project.id).collect::<Vec<_>>(), [one, ProjectId::DEFAULT]);
    assert_eq!(all[0].worker_seconds, 35.0, "time that was used does not come back");
}

#[tokio::test]
async fn jobs_are_listed_by_name_time_and_labels() {
    let Some(queue) = Queue::new().await else { return };
    let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
    let mut instants = Vec::new();
    for (number, name, site) in [(1, "a", "north"), (2, "b", "north"), (3, "a", "south")] {
        queue.pass(10);
        instants.push(queue.clock.now());
        let labels = std::collections::BTreeMap::from([("site.no".to_owned(), site.to_owned())]);
        let new = NewJob {
            name: Some(name.into()),
            metadata: Metadata::try_from(labels).expect("labels"),
            ..NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset)
        };
        queue.store.create_job(new).await.expect("created");
    }
    queue.add(4).await;
    let listed = async |filter: JobFilter| {
        let jobs = queue.store.jobs(&filter, None, 9).await.expect("read");
        jobs.iter().map(|job| job.job.id.0.as_u128()).collect::<Vec<_>>()
    };
    let site = |name: &str| {
        let labels = std::collections::BTreeMap::from([("site.no".to_owned(), name.to_owned())]);
        Metadata::try_from(labels).expect("labels")
    };
    let all = JobFilter::default;
    assert_eq!(listed(JobFilter { name: Some("a".into()), ..all() }).await, [3, 1]);
    assert_eq!(listed(JobFilter { metadata: site("north"), ..all() }).await, [2, 1]);
    assert_eq!(
        listed(JobFilter { metadata: site("south"), name: Some("b".into()), ..all() }).await,
        [0_u128; 0]
    );
    let (from, end) = (Some(instants[1]), Some(instants[2]));
    assert_eq!(listed(JobFilter { created_from: from, created_before: end, ..all() }).await, [2]);
    assert_eq!(
        listed(JobFilter { project: Some(ProjectId(Uuid::from_u128(9))), ..all() }).await,
        [0_u128; 0]
    );
}

#[tokio::test]
async fn a_reported_failure_resets_the_count_of_lost_attempts() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.lease().await;
    queue.store.expire_worker("worker", WorkerDeath::Alone).await.expect("taken");
    queue.store.finish(&queue.lease().await, Outcome::Released).await.expect("released");
    queue.lease().await;
    queue.store.expire_worker("worker", WorkerDeath::Alone).await.expect("taken");
    assert_eq!(queue.state(id).await, JobState::Queued);
}

#[tokio::test]
async fn only_the_dead_workers_jobs_are_queued_again_at_once() {
    let Some(queue) = Queue::new().await else { return };
    let (first, second) = (queue.add(1).await, queue.add(2).await);
    let kept = queue.store.claim("alive").await.expect("a claim").expect("a job").lease;
    queue.store.claim("dead").await.expect("a claim").expect("a job");
    assert_eq!(queue.store.expire_worker("dead", WorkerDeath::Alone).await.expect("taken"), 1);
    assert_eq!(queue.store.expire_worker("dead", WorkerDeath::Alone).await.expect("nothing left"), 0);
    assert_eq!(kept.job, first);
    queue.store.heartbeat(&kept).await.expect("still held");
    assert_eq!(queue.lease().await.job, second);
}

#[tokio::test]
async fn a_cancelled_job_whose_worker_dies_ends_cancelled() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.lease().await;
    queue.store.cancel(id).await.expect("written");
    queue.store.expire_worker("worker", WorkerDeath::Alone).await.expect("taken");
    assert_eq!(queue.state(id).await, JobState::Cancelled);
}

#[tokio::test]
async fn a_job_whose_lease_has_expired_is_cancelled_at_once() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.lease().await;
    queue.pass(60);
    let answer = queue.store.cancel(id).await.expect("written").expect("known");
    assert!(matches!(answer, Cancellation::Done(record) if record.job.state == JobState::Cancelled));
    assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Lost)]);
    queue.events(id).await;
}

#[tokio::test]
async fn a_release_is_not_charged() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    for _ in 0..10 {
        let lease = queue.lease().await;
        assert_eq!(queue.store.finish(&lease, Outcome::Released).await.expect("released"), JobState::Queued);
    }
    assert_eq!(queue.lease().await.attempt, 11, "the fence still rises");
    assert_eq!(queue.state(id).await, JobState::Running);
}

#[tokio::test]
async fn events_have_no_gaps_and_no_duplicates_across_a_reopen() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let lease = queue.lease().await;
    let progress = |step| Progress { step, ..Progress::default() };
    queue.store.report(&lease, Phase::Train, &progress(1)).await.expect("reported");
    let before = queue.events(id).await;
    let Queue { store, clock, database } = queue;
    drop(store);
    let store = database.open(clock, QueuePolicy::default()).await;
    assert_eq!(events(&store, id).await, before);
    store.heartbeat(&lease).await.expect("the lease survives the reopening");
    store.report(&lease, Phase::Encode, &progress(2)).await.expect("reported");
    store.finish(&lease, succeeded()).await.expect("finished");
    let after = events(&store, id).await;
    assert_eq!(after[..before.len()], before);
    let states: Vec<_> =
        after.iter().filter(|event| event.kind == EventKind::State).map(|e| &e.data["state"]).collect();
    assert_eq!(states, ["queued", "running", "succeeded"]);
}

#[tokio::test]
async fn progress_is_always_current_but_its_events_are_limited_in_rate() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let lease = queue.lease().await;
    for step in 1..=100 {
        let progress = Progress { step, total: 100, ..Progress::default() };
        queue.store.report(&lease, Phase::Train, &progress).await.expect("reported");
        queue.clock.advance(SignedDuration::from_millis(100));
    }
    assert_eq!(queue.record(id).await.job.progress.step, 100);
    let events = queue.events(id).await;
    let progress = events.iter().filter(|event| event.kind == EventKind::Progress).count();
    assert_eq!(progress, 2, "ten seconds hold two intervals of five");
    let phases = events.iter().filter(|event| event.kind == EventKind::Phase).count();
    assert_eq!(phases, 2, "ingest and train, once each");
}

#[tokio::test]
async fn every_change_raises_the_version_and_a_new_attempt_starts_from_nothing() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let mut last = queue.record(id).await.job.version;
    let mut rises = |record: &JobRecord| {
        let version = record.job.version;
        assert!(version > last, "{version} after {last}");
        last = version;
    };
    let lease = queue.lease().await;
    rises(&queue.record(id).await);
    let progress = Progress { step: 5, ..Progress::default() };
    queue.store.report(&lease, Phase::Train, &progress).await.expect("reported");
    rises(&queue.record(id).await);
    queue.store.finish(&lease, Outcome::Retry(problem())).await.expect("ended");
    let waiting = queue.record(id).await;
    rises(&waiting);
    assert_eq!((waiting.job.error, waiting.job.phase), (None, Phase::Queued), "the job has not failed");
    queue.pass(60);
    queue.lease().await;
    let again = queue.record(id).await;
    rises(&again);
    assert_eq!((again.job.progress, again.job.phase), (Progress::default(), Phase::Ingest));
    queue.store.cancel(id).await.expect("written");
    rises(&queue.record(id).await);
}

fn retry(number: u128, from_checkpoint: bool) -> RetryRequest {
    let id = JobId(Uuid::from_u128(number));
    RetryRequest { from_checkpoint, ..RetryRequest::of(id) }
}

impl Queue {
    async fn add_until(&self, number: u128, seconds: i64) -> JobId {
        let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
        let deadline_at = self.clock.now().checked_add(SignedDuration::from_secs(seconds)).ok();
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        self.store.create_job(NewJob { deadline_at, ..new }).await.expect("created").job.id
    }
}

#[tokio::test]
async fn a_queued_job_past_its_deadline_fails_and_is_never_started() {
    let Some(queue) = Queue::new().await else { return };
    let (late, other) = (queue.add_until(1, 60).await, queue.add(2).await);
    assert_eq!(queue.store.fail_expired().await.expect("looked"), 0);
    queue.pass(60);
    assert_eq!(queue.lease().await.job, other, "a claim gives it up too");
    let record = queue.record(late).await;
    assert_eq!((record.job.state, record.job.attempt), (JobState::Failed, 0));
    let error = record.job.error.expect("a reason");
    assert_eq!(error.kind, "urn:tcgs:problem:deadline-exceeded");
    let last = queue.events(late).await.pop().expect("an event");
    assert_eq!((&last.data["state"], &last.data["error"]["type"]), (&"failed".into(), &error.kind.into()));
    let later = queue.add_until(3, 60).await;
    queue.pass(61);
    assert_eq!(queue.store.fail_expired().await.expect("looked"), 1);
    assert_eq!(queue.store.fail_expired().await.expect("looked"), 0);
    assert_eq!(queue.state(later).await, JobState::Failed);
    let answer = queue.store.cancel(later).await.expect("read").expect("known");
    assert!(matches!(answer, Cancellation::TooLate(_)));
}

#[tokio::test]
async fn a_running_job_learns_of_its_deadline_and_gets_no_other_attempt() {
    let Some(queue) = Queue::new().await else { return };
    for (number, outcome) in [(1, Outcome::Released), (2, Outcome::Retry(problem()))] {
        let id = queue.add_until(number, 30).await;
        let lease = queue.lease().await;
        assert!(!queue.store.heartbeat(&lease).await.expect("renewed").deadline_passed);
        queue.pass(30);
        assert!(queue.store.heartbeat(&lease).await.expect("renewed").deadline_passed);
        assert_eq!(queue.store.fail_expired().await.expect("looked"), 0, "its worker ends it");
        assert_eq!(queue.store.finish(&lease, outcome).await.expect("ended"), JobState::Failed);
        let error = queue.record(id).await.job.error.expect("a reason");
        assert_eq!(error.kind, "urn:tcgs:problem:deadline-exceeded");
        assert_eq!(queue.outcomes(id).await, [Some(AttemptOutcome::Failed)]);
    }
    let silent = queue.add_until(3, 30).await;
    queue.lease().await;
    queue.pass(60);
    assert_eq!(queue.claim().await, None);
    assert_eq!(queue.state(silent).await, JobState::Failed);
    assert_eq!(queue.outcomes(silent).await, [Some(AttemptOutcome::Lost)]);
    let done = queue.add_until(4, 30).await;
    let lease = queue.lease().await;
    queue.pass(31);
    assert_eq!(queue.store.finish(&lease, succeeded()).await.expect("ended"), JobState::Succeeded);
    assert_eq!(queue.record(done).await.artifacts.len(), 1, "what is finished is not thrown away");
}

#[tokio::test]
async fn a_retry_is_a_new_job_that_may_resume_from_the_checkpoint() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add_with_priority(1, 7).await;
    let now = queue.store.retry_job(id, retry(2, true)).await.expect("answered").expect("known");
    assert_eq!(now, RetryOutcome::NotRetryable(JobState::Queued));
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    for (number, from_checkpoint) in [(2, true), (3, false)] {
        let made = queue.store.retry_job(id, retry(number, from_checkpoint)).await.expect("answered");
        let Some(RetryOutcome::Created(record)) = made else { panic!("{made:?}") };
        assert_eq!((record.retry_of, record.priority), (Some(id), 7));
        assert_eq!((record.job.state, record.job.attempt), (JobState::Queued, 0));
        let claim = queue.claim().await.expect("a job");
        assert_eq!((claim.lease.job, claim.resume_from), (record.job.id, from_checkpoint.then_some(id)));
        queue.store.finish(&claim.lease, succeeded()).await.expect("ended");
        let done = queue.store.retry_job(record.job.id, retry(9, true)).await.expect("answered");
        assert_eq!(done, Some(RetryOutcome::NotRetryable(JobState::Succeeded)));
    }
    assert!(
        queue.store.retry_job(JobId(Uuid::from_u128(404)), retry(9, true)).await.expect("read").is_none()
    );
}

#[tokio::test]
async fn a_job_that_no_live_worker_can_prepare_is_refused_also_as_a_retry() {
    let Some(queue) = Queue::new().await else { return };
    let videos = async |number: u128| {
        let dataset = BlobRef { digest: Digest::of(b"a video"), bytes: 7 };
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        queue.store.create_job(NewJob { needs: Preparation::Video, ..new }).await
    };
    let id = videos(1).await.expect("a worker may start later").job.id;
    queue.store.cancel(id).await.expect("cancelled");
    for (can, is_able) in
        [(Preparation::None, false), (Preparation::Poses, false), (Preparation::Video, true)]
    {
        queue.store.announce_worker("w", can).await.expect("announced");
        let number = 10 + can as u128;
        let retried = queue.store.retry_job(id, retry(100 + number, true)).await.map(drop);
        for made in [videos(number).await.map(drop), retried] {
            match made {
                Ok(()) => assert!(is_able, "{can:?}"),
                Err(StoreError::NoWorker { needs: Preparation::Video, best }) => {
                    assert_eq!((best, is_able), (can, false));
                }
                Err(error) => panic!("{error}"),
            }
        }
    }
}

#[tokio::test]
async fn a_checkpoint_outlives_its_job_while_a_retry_may_resume_from_it() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    queue.store.retry_job(id, retry(2, true)).await.expect("answered").expect("known");
    assert_eq!(queue.store.delete_job(id, None).await.expect("written"), Some(Deletion::Deleted));
    assert_eq!(queue.store.resumable(&[id]).await.expect("read"), [id], "the retry waits");
    let claim = queue.claim().await.expect("the retry");
    assert_eq!(claim.resume_from, Some(id));
    assert_eq!(queue.store.resumable(&[id]).await.expect("read"), [id], "the retry runs");
    queue.store.finish(&claim.lease, succeeded()).await.expect("ended");
    assert_eq!(queue.store.resumable(&[id]).await.expect("read"), []);
}

#[tokio::test]
async fn a_retry_of_a_job_that_never_ran_resumes_from_the_same_checkpoint() {
    let Some(queue) = Queue::new().await else { return };
    let first = queue.add(1).await;
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    let mut last = first;
    for number in [2, 3] {
        queue.store.retry_job(last, retry(number, true)).await.expect("answered").expect("known");
        last = JobId(Uuid::from_u128(number));
        queue.store.cancel(last).await.expect("cancelled");
    }
    queue.store.retry_job(last, retry(4, true)).await.expect("answered").expect("known");
    let claim = queue.claim().await.expect("a job");
    assert_eq!(claim.resume_from, Some(first));
    queue.store.finish(&claim.lease, Outcome::Failed(problem())).await.expect("ended");
    let ran = claim.lease.job;
    queue.store.retry_job(ran, retry(5, true)).await.expect("answered").expect("known");
    assert_eq!(queue.claim().await.expect("a job").resume_from, Some(ran), "which took the checkpoint over");
}

#[tokio::test]
async fn a_job_is_deleted_only_once_it_has_ended_and_at_the_requested_version() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let delete = |version| queue.store.delete_job(id, version);
    assert_eq!(delete(None).await.expect("read"), Some(Deletion::Active(JobState::Queued)));
    let lease = queue.lease().await;
    assert_eq!(delete(None).await.expect("read"), Some(Deletion::Active(JobState::Running)));
    queue.store.finish(&lease, succeeded()).await.expect("ended");
    let version = queue.record(id).await.job.version;
    assert_eq!(delete(Some(version - 1)).await.expect("read"), Some(Deletion::VersionMismatch));
    assert_eq!(delete(Some(version)).await.expect("deleted"), Some(Deletion::Deleted));
    assert_eq!(delete(None).await.expect("read"), None);
    assert!(queue.store.events(id, 0, 10).await.expect("read").is_none());
    assert_eq!(queue.store.attempts(id).await.expect("read"), []);
    assert!(is_lost(queue.store.heartbeat(&lease).await));
    assert_eq!(queue.store.newest_events(&[id]).await.expect("read"), []);
}

#[tokio::test]
async fn checkpoints_are_needed_until_success_and_for_a_while_after_failure() {
    let Some(queue) = Queue::new().await else { return };
    let [done, failed, waiting] = [queue.add(1).await, queue.add(2).await, queue.add(3).await];
    queue.store.finish(&queue.lease().await, succeeded()).await.expect("ended");
    queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    let unknown = JobId(Uuid::from_u128(404));
    let asked = [done, failed, waiting, unknown];
    assert_eq!(queue.store.resumable(&asked).await.expect("read"), [failed, waiting]);
    queue.pass(24 * 3600);
    assert_eq!(queue.store.resumable(&asked).await.expect("read"), [waiting]);
}

#[tokio::test]
async fn a_checkpoint_is_needed_for_as_long_as_a_retry_from_it_waits() {
    let Some(queue) = Queue::new().await else { return };
    let [resumed, repeated] = [queue.add(1).await, queue.add(2).await];
    for _ in 0..2 {
        queue.store.finish(&queue.lease().await, Outcome::Failed(problem())).await.expect("ended");
    }
    for (id, retry) in [(resumed, retry(3, true)), (repeated, retry(4, false))] {
        queue.store.retry_job(id, retry).await.expect("answered").expect("known");
    }
    queue.pass(48 * 3600);
    let needed = async || queue.store.resumable(&[resumed, repeated]).await.expect("read");
    assert_eq!(needed().await, [resumed]);
    let lease = queue.lease().await;
    assert_eq!(needed().await, [resumed], "its worker may die before it takes the checkpoint over");
    queue.store.finish(&lease, succeeded()).await.expect("ended");
    assert_eq!(needed().await, []);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn fifty_requests_with_one_idempotency_key_create_one_job() {
    let Some(queue) = Queue::new().await else { return };
    let other = another(&queue).await;
    let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
    let intent = IdempotentRequest {
        project: ProjectId::DEFAULT,
        key: "one".into(),
        fingerprint: Digest::of(b"request"),
    };
    let requests = (0..50).map(|number| {
        let store = if number % 2 == 0 { queue.store.clone() } else { other.clone() };
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        let new = NewJob { intent: Some(intent.clone()), ..new };
        tokio::spawn(async move { store.create_job(new).await })
    });
    let (mut made, mut told) = (Vec::new(), Vec::new());
    for request in requests.collect::<Vec<_>>() {
        match request.await.expect("joined") {
            Ok(record) => made.push(record.job.id.to_string()),
            Err(StoreError::IdempotencyKeyUsed(earlier)) => told.push(*earlier),
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!((made.len(), told.len()), (1, 49));
    assert!(told.iter().all(|earlier| {
        earlier.resource == made[0] && earlier.status == 201 && earlier.fingerprint == intent.fingerprint
    }));
    let jobs = queue.store.jobs(&JobFilter::default(), None, 100).await.expect("read");
    assert_eq!(jobs.len(), 1, "what was refused left nothing behind");
}

#[tokio::test]
async fn an_idempotency_key_belongs_to_its_project_and_expires_after_a_day() {
    let Some(queue) = Queue::new().await else { return };
    let other = project(&queue, 77, ProjectLimits::default()).await;
    let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
    let create = |number, project| {
        let intent = IdempotentRequest { project, key: "one".into(), fingerprint: Digest::of(b"request") };
        let new = NewJob::new(JobId(Uuid::from_u128(number)), TrainOptions::default(), dataset);
        queue.store.create_job(NewJob { project, intent: Some(intent), ..new })
    };
    let nobody = ProjectId::DEFAULT;
    create(1, nobody).await.expect("made");
    create(2, other).await.expect("another's key is another key");
    assert!(matches!(create(3, nobody).await, Err(StoreError::IdempotencyKeyUsed(_))));
    let remembered = |project| queue.store.prior_request(project, "one");
    assert!(remembered(nobody).await.expect("read").is_some());
    queue.pass(24 * 3600);
    assert!(remembered(other).await.expect("read").is_none());
    create(4, nobody).await.expect("made anew");
    let rows = queue.database.number("SELECT COUNT(*) FROM idempotency").await;
    assert_eq!(rows, 1, "old ones are swept");
}

#[tokio::test]
async fn a_dataset_may_be_used_by_many_jobs() {
    let Some(queue) = Queue::new().await else { return };
    let (first, second) = (queue.add(1).await, queue.add(2).await);
    let dataset = queue.record(first).await.dataset;
    assert_eq!(queue.record(second).await.dataset, dataset);
    let rows = queue.database.number("SELECT COUNT(*) FROM blobs").await;
    assert_eq!(rows, 1, "it is kept once");
    for job in [first, second] {
        let claim = queue.claim().await.expect("a job");
        assert_eq!((claim.lease.job, claim.dataset), (job, dataset.digest));
        queue.store.finish(&claim.lease, Outcome::Failed(problem())).await.expect("ended");
    }
    let forget = async || queue.store.forget_blobs(&[dataset.digest]).await.expect("asked");
    queue.store.delete_job(first, None).await.expect("deleted");
    assert_eq!(forget().await, [], "the other job refers to it");
    assert_eq!(queue.record(second).await.dataset, dataset);
    queue.store.delete_job(second, None).await.expect("deleted");
    assert_eq!(forget().await, [dataset.digest], "nobody does");
}

#[tokio::test]
async fn an_invalid_row_is_an_error_and_not_a_panic() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    for change in [
        "UPDATE jobs SET options = '{\"preset\":\"unheard-of\"}'",
        "UPDATE jobs SET options = 'no JSON'",
        "UPDATE jobs SET options = '{}', phase = 'dreaming'",
        "UPDATE jobs SET phase = 'queued', attempt = -1",
        "UPDATE jobs SET attempt = 0, created_at = 9223372036854775807",
    ] {
        queue.database.run(change).await;
        let read = queue.store.job(id).await;
        assert!(matches!(read, Err(StoreError::Corrupt { .. })), "{change}: {read:?}");
    }
}

/// No text of PostgreSQL has the character U+0000, and its JSON functions refuse it even escaped.
#[tokio::test]
async fn a_null_character_in_what_is_stored_or_asked_for_fails_nothing() {
    let Some(queue) = Queue::new().await else { return };
    let id = queue.add(1).await;
    let lease = queue.lease().await;
    let problem = Problem::new(ProblemType::InvalidDataset, "frame 'a\0b' is no image");
    queue.store.finish(&lease, Outcome::Failed(problem)).await.expect("ended");
    let error = queue.record(id).await.job.error.expect("a problem");
    assert_eq!(error.detail, "frame 'a\u{fffd}b' is no image");
    let filter = JobFilter { name: Some("\0".into()), ..JobFilter::default() };
    assert_eq!(queue.store.jobs(&filter, None, 10).await.expect("read").len(), 0);
}

#[tokio::test]
async fn published_artifacts_survive_the_process() {
    let folder = tempfile::tempdir().expect("a folder");
    let blobs = Blobs::open(folder.path()).expect("a store");
    let blob = blobs.put(Bytes::from_static(b"kept")).await.expect("published");
    drop(blobs);
    let blobs = Blobs::open(folder.path()).expect("a store");
    assert_eq!(&blobs.read(blob.digest).await.expect("read")[..], b"kept");
    tokio::time::timeout(Duration::from_secs(60), blobs.probe()).await.expect("answers").expect("writable");
}
