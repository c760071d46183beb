//! The worker loop with a fake runner, and the supervisor with real child processes.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    process::Command,
    sync::Arc,
    time::Duration,
};

use serde_json::{Value, json};
use tcgs::{
    domain::{Clock as _, JobState, SystemClock, Workers as _},
    store::{
        AttemptOutcome, Blobs, DATABASE, NewJob, RetryRequest, Store, WorkerDeath,
        garbage::{GarbagePolicy, collect},
    },
    worker::{
        self, WorkerConfig, WorkerError,
        supervise::{LiveWorkers, SuperviseConfig, SupervisedWorkers, supervise},
    },
};
use tempfile::TempDir;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::support::{
    contract::Coverage,
    database::Database,
    eventually::eventually,
    fakes::FakeRunner,
    faults::{Failing, PlannedFaults},
    server::{Server, quick_policy, quick_worker},
};

/// Where the child of the supervisor tests finds its data.
const CHILD_DATA: &str = "TCGS_TEST_CHILD_DATA";

/// The output of a future; fails the test if it takes too long.
async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(120), future).await.expect("it comes to an end")
}

struct Fixture {
    store: Store,
    blobs: Blobs,
    runner: FakeRunner,
    shutdown: CancellationToken,
    data: TempDir,
}

impl Fixture {
    async fn new() -> Self {
        let data = tempfile::tempdir().expect("a folder");
        let (store, blobs) = open(data.path()).await;
        Self { store, blobs, runner: FakeRunner::default(), shutdown: CancellationToken::new(), data }
    }

    fn start(&self, config: WorkerConfig) -> JoinHandle<Result<(), WorkerError>> {
        self.start_on(self.store.clone(), config)
    }

    fn start_on(&self, store: Store, config: WorkerConfig) -> JoinHandle<Result<(), WorkerError>> {
        let blobs = self.blobs.clone();
        let runner = Arc::new(self.runner.clone());
        tokio::spawn(worker::serve(store, blobs, runner, config, self.shutdown.clone()))
    }

    /// Starts a worker whose calls of the store fail when told to.
    fn start_with_faults(&self, config: WorkerConfig) -> Arc<PlannedFaults> {
        let faults = Arc::new(PlannedFaults::default());
        let store = Store::clone(&self.store).with_faults(faults.clone());
        self.start_on(store, config);
        faults
    }

    async fn add(&self, wish: &'static str) -> tcgs::domain::JobId {
        let dataset = self.blobs.put(bytes::Bytes::from_static(wish.as_bytes())).await.expect("published");
        let id = tcgs::domain::JobId(Uuid::now_v7());
        let new = NewJob::new(id, Default::default(), dataset);
        self.store.create_job(new).await.expect("created").job.id
    }

    async fn reaches(&self, id: tcgs::domain::JobId, state: JobState) -> tcgs::domain::Job {
        let reached = async {
            loop {
                let job = self.store.job(id).await.expect("read").expect("known").job;
                if job.state == state {
                    return job;
                }
                assert!(!job.state.is_terminal(), "the job can no longer become {state:?}: {job:?}");
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        };
        within(reached).await
    }

    async fn outcomes(&self, id: tcgs::domain::JobId) -> Vec<Option<AttemptOutcome>> {
        self.store.attempts(id).await.expect("read").into_iter().map(|attempt| attempt.outcome).collect()
    }
}

impl Drop for Fixture {
    fn drop(&mut self) {
        self.runner.gate.open();
        self.shutdown.cancel();
    }
}

async fn open(data: &Path) -> (Store, Blobs) {
    let store = Store::open(&data.join(DATABASE), Arc::new(SystemClock), quick_policy()).await;
    (store.expect("a database"), Blobs::open(data).expect("a blob store"))
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_takes_its_time_to_die_is_found_without_another_start() {
    let fixture = Fixture::new().await;
    let workers = fixture.data.path().join("workers");
    std::fs::create_dir(&workers).expect("a folder");
    let file = std::fs::File::create(workers.join("earlier")).expect("a file");
    file.lock().expect("as a process that is still ending holds it");
    let lost = fixture.add("succeed").await;
    fixture.store.claim("earlier").await.expect("claimed").expect("a job");
    let config = SuperviseConfig {
        liveness_dir: Some(workers.clone()),
        liveness_interval: Duration::from_millis(20),
        ..SuperviseConfig::program("sleep".into(), vec!["600".into()], 1)
    };
    let supervisor = supervise(config, fixture.store.clone(), fixture.shutdown.clone());
    let live = supervisor.live_workers();
    eventually("the child runs", async || !live.pids().is_empty()).await;
    assert!(workers.join("earlier").exists(), "its lock is held");
    drop(file);
    eventually("it is found dead", async || !workers.join("earlier").exists()).await;
    assert_eq!(fixture.outcomes(lost).await, [Some(AttemptOutcome::Lost)]);
    kill_all(&live);
    fixture.shutdown.cancel();
    within(supervisor.stopped()).await;
}

/// Ends children that do not listen.
#[cfg(unix)]
fn kill_all(live: &LiveWorkers) {
    for pid in live.pids() {
        Command::new("kill").arg(pid.to_string()).status().expect("kill runs");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_panics_fails_its_attempts_and_the_worker_lives() {
    let fixture = Fixture::new().await;
    fixture.start(quick_worker("w"));
    let bad = fixture.add("panic").await;
    let job = fixture.reaches(bad, JobState::Failed).await;
    assert_eq!(
        (job.attempt, job.error.expect("a reason").kind.as_str()),
        (3, "urn:tcgs:problem:worker-panicked")
    );
    let good = fixture.add("succeed").await;
    fixture.reaches(good, JobState::Succeeded).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shutdown_releases_the_running_job_without_a_charge() {
    let fixture = Fixture::new().await;
    let working = fixture.start(quick_worker("w"));
    let id = fixture.add("wait").await;
    fixture.runner.gate.someone_waits().await;
    fixture.shutdown.cancel();
    working.await.expect("joined").expect("a clean end");
    assert_eq!(fixture.reaches(id, JobState::Queued).await.error, None);
    assert_eq!(fixture.outcomes(id).await, [Some(AttemptOutcome::Released)]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn checkpoints_are_removed_once_their_job_has_ended_and_not_before() {
    let fixture = Fixture::new().await;
    let root = fixture.data.path().join("checkpoints");
    let running = fixture.add("gate").await;
    let waiting = fixture.add("succeed later").await;
    let unknown = tcgs::domain::JobId(Uuid::now_v7());
    let folder = |name: &str| {
        let folder = root.join(name);
        std::fs::create_dir_all(&folder).expect("made");
        std::fs::write(folder.join("checkpoint.safetensors"), b"anything").expect("writes");
        folder
    };
    let [running_folder, waiting_folder, unknown_folder] =
        [running, waiting, unknown].map(|job| folder(&job.to_string()));
    let foreign = folder("not a job");
    let working = fixture.start(WorkerConfig { checkpoints: Some(root.clone()), ..quick_worker("w") });
    fixture.runner.gate.someone_waits().await;
    assert!(!unknown_folder.exists() && running_folder.exists() && waiting_folder.exists());
    fixture.runner.gate.open();
    fixture.reaches(waiting, JobState::Succeeded).await;
    fixture.shutdown.cancel();
    working.await.expect("joined").expect("a clean end");
    assert!(!running_folder.exists() && !waiting_folder.exists());
    assert!(foreign.exists(), "what is no job's is left alone");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_retry_resumes_from_the_checkpoint_of_the_retried_job() {
    let fixture = Fixture::new().await;
    let root = fixture.data.path().join("checkpoints");
    let config = || WorkerConfig { checkpoints: Some(root.clone()), ..quick_worker("w") };
    fixture.start(config());
    let failed = fixture.add("fail").await;
    let folder = |job: tcgs::domain::JobId| root.join(job.to_string());
    std::fs::create_dir_all(folder(failed).join("attempt-1")).expect("made");
    std::fs::write(folder(failed).join("attempt-1/checkpoint.safetensors"), b"state").expect("written");
    fixture.reaches(failed, JobState::Failed).await;
    let repeat = |from_checkpoint| {
        let id = tcgs::domain::JobId(Uuid::now_v7());
        let repeat = RetryRequest { from_checkpoint, ..RetryRequest::of(id) };
        let store = fixture.store.clone();
        async move {
            store.retry_job(failed, repeat).await.expect("answered").expect("known");
            id
        }
    };
    let fresh = repeat(false).await;
    fixture.reaches(fresh, JobState::Failed).await;
    assert!(folder(failed).exists() && !folder(fresh).exists(), "it was not to be used");
    let adopting = repeat(true).await;
    fixture.reaches(adopting, JobState::Failed).await;
    let state = std::fs::read(folder(adopting).join("attempt-1/checkpoint.safetensors")).expect("moved");
    assert_eq!(state, b"state");
    assert!(!folder(failed).exists());
    let second = repeat(true).await;
    fixture.reaches(second, JobState::Failed).await;
    assert!(!folder(second).exists(), "there is one checkpoint, and the first has it");
    let workers = SupervisedWorkers::new(LiveWorkers::default(), root.clone());
    workers.forget(adopting);
    assert!(!folder(adopting).exists());
    workers.forget(adopting);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_does_not_stop_in_time_is_released_anyway() {
    let fixture = Fixture::new().await;
    let working = fixture.start(WorkerConfig { drain: Duration::from_millis(30), ..quick_worker("w") });
    let id = fixture.add("gate").await;
    fixture.runner.gate.someone_waits().await;
    fixture.shutdown.cancel();
    working.await.expect("joined").expect("a clean end");
    assert_eq!(fixture.outcomes(id).await, [Some(AttemptOutcome::Released)]);
    fixture.reaches(id, JobState::Queued).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_stalls_ends_the_worker_and_its_job_is_queued_again() {
    let fixture = Fixture::new().await;
    let working = fixture.start(WorkerConfig { stall_limit: Duration::from_millis(60), ..quick_worker("w") });
    let id = fixture.add("gate").await;
    let ended = working.await.expect("joined");
    assert!(matches!(ended, Err(WorkerError::Stalled { job, attempt: 1, .. }) if job == id), "{ended:?}");
    assert_eq!(fixture.outcomes(id).await, [Some(AttemptOutcome::Retried)]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_lost_its_lease_drops_the_result_and_goes_on() {
    let fixture = Fixture::new().await;
    fixture.start(quick_worker("w"));
    let id = fixture.add("gate").await;
    fixture.runner.gate.someone_waits().await;
    assert_eq!(fixture.store.expire_worker("w", WorkerDeath::Alone).await.expect("taken"), 1);
    // Another worker takes it while the first still runs, and is interrupted.
    let other = fixture.store.claim("other").await.expect("a claim").expect("the job").lease;
    fixture.runner.gate.open();
    let next = fixture.add("succeed next").await;
    fixture.reaches(next, JobState::Succeeded).await;
    let job = fixture.store.job(id).await.expect("read").expect("known").job;
    assert_eq!(
        (job.state, job.attempt),
        (JobState::Running, other.attempt),
        "the late result changed nothing"
    );
    fixture.store.heartbeat(&other).await.expect("still held");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_short_outage_of_the_database_does_not_cost_the_run() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.create("gate").await;
    server.runner.gate.someone_waits().await;
    server.faults.set(Some(Failing::Busy));
    server.runner.gate.open();
    // Long enough for heartbeats, reports and the first try at the end to fail.
    tokio::time::sleep(Duration::from_millis(100)).await;
    server.faults.set(None);
    let done = server.reaches(&job, "succeeded").await;
    assert_eq!(done["attempt"], 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_without_disk_space_is_held_until_there_is_some() {
    let fixture = Fixture::new().await;
    fixture.start(quick_worker("w"));
    let id = fixture.add("hold").await;
    // More often than a job may fail.
    let held = async {
        while fixture.outcomes(id).await.len() < 7 {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    within(held).await;
    fixture.runner.gate.open();
    fixture.reaches(id, JobState::Succeeded).await;
    let mut attempts = fixture.store.attempts(id).await.expect("read");
    assert_eq!(attempts.pop().expect("one").outcome, Some(AttemptOutcome::Succeeded));
    for attempt in attempts {
        assert_eq!(attempt.outcome, Some(AttemptOutcome::Released));
        let cause = attempt.cause.expect("a cause");
        assert_eq!(cause.kind, "urn:tcgs:problem:storage-full");
        assert!(
            cause.detail.contains("continues once there is space") && !cause.detail.contains("/srv"),
            "{cause}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_that_is_full_for_longer_than_a_lease_does_not_cost_the_run() {
    let fixture = Fixture::new().await;
    let lease = Duration::from_millis(40);
    let faults = fixture.start_with_faults(WorkerConfig { lease, ..quick_worker("w") });
    let id = fixture.add("gate").await;
    within(fixture.runner.gate.someone_waits()).await;
    faults.set(Some(Failing::Full));
    // Heartbeats and reports fail for longer than the lease lasts, and so does the end of the attempt.
    tokio::time::sleep(5 * lease).await;
    fixture.runner.gate.open();
    tokio::time::sleep(5 * lease).await;
    faults.set(None);
    let job = fixture.reaches(id, JobState::Succeeded).await;
    assert_eq!(job.attempt, 1);
}

/// A worker whose attempts find no room for their end, and a job that it has run so far.
async fn without_room_for_the_end(
    fixture: &Fixture,
    config: WorkerConfig,
) -> (Arc<PlannedFaults>, tcgs::domain::JobId) {
    let faults = fixture.start_with_faults(config);
    faults.set(Some(Failing::FullForEnds));
    let id = fixture.add("succeed").await;
    eventually("its end is refused", async || faults.failures("finish") > 0).await;
    (faults, id)
}

/// Dates all blobs back, as if their publication had been long ago.
fn date_back(blobs: &Path) {
    for entry in std::fs::read_dir(blobs).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            date_back(&path);
        } else {
            let file = std::fs::File::options().write(true).open(path).expect("writable");
            file.set_modified(std::time::SystemTime::UNIX_EPOCH).expect("dated back");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_is_there_however_long_its_job_had_no_room_to_end() {
    let fixture = Fixture::new().await;
    let config = WorkerConfig { republish_every: Duration::ZERO, ..quick_worker("w") };
    let (faults, id) = without_room_for_the_end(&fixture, config).await;
    let collected = async || {
        let policy = GarbagePolicy::default();
        let collected = collect(&fixture.store, &fixture.blobs, &policy, SystemClock.now()).await;
        collected.expect("collected").blobs
    };
    let renewed = async || {
        // The try that is under way may have published before.
        let enough = faults.failures("finish") + 2;
        eventually("the result is published again", async || faults.failures("finish") >= enough).await;
    };
    date_back(&fixture.data.path().join("blobs"));
    renewed().await;
    assert_eq!(collected().await, 0, "its age was renewed");
    date_back(&fixture.data.path().join("blobs"));
    // Whether or not the worker was faster.
    collected().await;
    renewed().await;
    faults.set(None);
    fixture.reaches(id, JobState::Succeeded).await;
    let artifacts = fixture.store.job(id).await.expect("read").expect("known").artifacts;
    assert_eq!(artifacts.len(), 4);
    for artifact in artifacts {
        fixture.blobs.read(artifact.blob.digest).await.expect("it is there");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_is_renewed_while_there_is_no_room_for_the_end() {
    let fixture = Fixture::new().await;
    let (faults, id) = without_room_for_the_end(&fixture, quick_worker("w")).await;
    let database = Database::DataFolder(fixture.data.path().to_owned());
    let until = async || database.number("SELECT lease_until FROM jobs").await;
    let before = until().await;
    eventually("the lease is renewed", async || until().await > before).await;
    faults.set(None);
    assert_eq!(fixture.reaches(id, JobState::Succeeded).await.attempt, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_missing_archive_fails_the_attempts() {
    let fixture = Fixture::new().await;
    let id = fixture.add("succeed").await;
    let dataset = fixture.store.job(id).await.expect("read").expect("known").dataset;
    let file = fixture.blobs.local_copy(dataset.digest).await.expect("published");
    std::fs::remove_file(file.path()).expect("removed");
    fixture.start(quick_worker("w"));
    let job = fixture.reaches(id, JobState::Failed).await;
    assert_eq!(
        (job.attempt, job.error.expect("a reason").kind.as_str()),
        (3, "urn:tcgs:problem:storage-failed")
    );
}

/// Not a test of its own: the supervisor tests run this binary again with this name, and it becomes a worker whose run
/// waits until the file `go` appears.
#[test]
#[ignore = "the supervisor tests run it as a child process"]
fn child_process() {
    let Some(data) = std::env::var_os(CHILD_DATA).map(PathBuf::from) else { return };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    runtime.block_on(async move {
        let (store, blobs) = open(&data).await;
        let stop = CancellationToken::new();
        worker::stop_when_stdin_closes(stop.clone()).expect("a thread");
        let runner = FakeRunner::default();
        let gate = Arc::clone(&runner.gate);
        let go = data.join("go");
        tokio::spawn(async move {
            while !go.exists() {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            gate.open();
        });
        let id = WorkerConfig::from_environment().id;
        let config = WorkerConfig { drain: Duration::from_millis(50), ..quick_worker(&id) };
        worker::serve(store, blobs, Arc::new(runner), config, stop).await.expect("a clean end");
    });
}

/// Not a test of its own either: runs the queued jobs and logs as the program does, which needs a process of its own.
#[test]
#[ignore = "the test of the logs runs it as a child process"]
fn logging_child_process() {
    let Some(data) = std::env::var_os(CHILD_DATA).map(PathBuf::from) else { return };
    tracing_subscriber::fmt().json().flatten_event(true).with_writer(std::io::stderr).init();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    runtime.block_on(async move {
        let (store, blobs) = open(&data).await;
        let stop = CancellationToken::new();
        let runner = Arc::new(FakeRunner::default());
        let work = worker::serve(store.clone(), blobs, runner, quick_worker("w"), stop.clone());
        let watch = async {
            while store
                .jobs(&tcgs::store::JobFilter::default(), None, 10)
                .await
                .expect("read")
                .iter()
                .any(|record| !record.job.state.is_terminal())
            {
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
            stop.cancel();
        };
        let (worked, ()) = tokio::join!(work, watch);
        worked.expect("a clean end");
    });
}

#[tokio::test]
async fn every_log_line_of_a_job_names_it() {
    let fixture = Fixture::new().await;
    let done = fixture.add("succeed").await;
    let panics = fixture.add("panic").await;
    let without = fixture.add("succeed without").await;
    let dataset = fixture.store.job(without).await.expect("read").expect("known").dataset;
    let file = fixture.blobs.local_copy(dataset.digest).await.expect("published");
    std::fs::remove_file(file.path()).expect("removed");
    let child = tokio::process::Command::new(std::env::current_exe().expect("a program"))
        .args(["worker::supervision::logging_child_process", "--exact", "--ignored", "--test-threads=1"])
        .env(CHILD_DATA, fixture.data.path())
        .kill_on_drop(true)
        .output();
    let output = child.await.expect("the binary runs");
    let log = String::from_utf8(output.stderr).expect("UTF-8");
    assert!(output.status.success(), "{log}");
    let lines = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let of_jobs = |line: &Value| {
        let target = line["target"].as_str().expect("a target");
        ["tcgs::worker::attempt", "tcgs::worker::outcomes", "tcgs::worker::storage"].contains(&target)
            || target.starts_with("it::")
    };
    let lines: Vec<Value> = lines.filter(of_jobs).collect();
    for (job, attempts, said) in [
        (done, 1, "is succeeded"),
        (panics, 3, "panicked: as the test wants it"),
        (panics, 3, "the run begins"),
        (without, 3, "starts"),
    ] {
        let told: Vec<_> = lines
            .iter()
            .filter(|line| line["span"]["job"] == json!(job))
            .filter(|line| line["message"].as_str().expect("a message").contains(said))
            .map(|line| line["span"]["attempt"].as_u64().expect("a number"))
            .collect();
        assert!(told.contains(&attempts), "{job}, {said}: {told:?}\n{log}");
    }
    assert_eq!(lines.iter().find(|line| line["span"]["job"].is_null()), None);
    assert!(
        lines.iter().any(|line| line["level"] == "ERROR" && line["span"]["job"] == json!(without)),
        "{log}"
    );
}

fn child_config(data: &Path) -> SuperviseConfig {
    let arguments = ["worker::supervision::child_process", "--exact", "--ignored", "--test-threads=1"]
        .map(OsString::from);
    let mut config = SuperviseConfig::this_program(arguments.into(), 1).expect("a program");
    config.environment = vec![(CHILD_DATA.into(), data.into())];
    config.backoff_base = Duration::from_millis(5);
    config
}

async fn one_live_worker(live_workers: &LiveWorkers, but_not: u32) -> u32 {
    loop {
        match live_workers.pids().first() {
            Some(&pid) if pid != but_not => return pid,
            _ => tokio::time::sleep(Duration::from_millis(2)).await,
        }
    }
}

fn kill(pid: u32) {
    let status = Command::new("kill").args(["-9", &pid.to_string()]).status().expect("kill runs");
    assert!(status.success());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killing_the_worker_leaves_the_api_answering_and_the_job_is_run_again() {
    let fixture = Fixture::new().await;
    let store = fixture.store.clone();
    let supervisor = supervise(child_config(fixture.data.path()), store, fixture.shutdown.clone());
    let live_workers = supervisor.live_workers();
    let api = api(&fixture, live_workers.clone());
    let id = fixture.add("gate").await;
    let first = one_live_worker(&live_workers, 0).await;
    fixture.reaches(id, JobState::Running).await;

    kill(first);
    let second = one_live_worker(&live_workers, first).await;
    let seen = answer(&api, "/healthz").await;
    assert_eq!(seen, (200, json!({ "status": "ok" })));
    let (status, ready) = answer(&api, "/readyz").await;
    assert_eq!((status, &ready["workers"]["expected"]), (200, &json!(1)));

    std::fs::write(fixture.data.path().join("go"), "").expect("written");
    let job = fixture.reaches(id, JobState::Succeeded).await;
    assert_eq!(job.attempt, 2);
    assert_eq!(fixture.outcomes(id).await, [Some(AttemptOutcome::Lost), Some(AttemptOutcome::Succeeded)]);
    let (_, shown) = answer(&api, &format!("/v1/jobs/{id}")).await;
    assert_eq!(shown["state"], "succeeded");
    assert_eq!(live_workers.pids(), [second], "the second worker is still there for the next job");

    fixture.shutdown.cancel();
    supervisor.stopped().await;
    assert_eq!(live_workers.pids(), [0_u32; 0]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shutdown_lets_the_child_drain_and_release_its_job() {
    let fixture = Fixture::new().await;
    let store = fixture.store.clone();
    let supervisor = supervise(child_config(fixture.data.path()), store, fixture.shutdown.clone());
    let id = fixture.add("wait").await;
    fixture.reaches(id, JobState::Running).await;
    fixture.shutdown.cancel();
    supervisor.stopped().await;
    assert_eq!(fixture.outcomes(id).await, [Some(AttemptOutcome::Released)]);
    fixture.reaches(id, JobState::Queued).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_child_that_does_not_exit_is_killed() {
    let fixture = Fixture::new().await;
    // The shell does not read its input, so closing that tells it nothing.
    let arguments = vec!["-c".into(), "exec sleep 1000".into()];
    let mut config = SuperviseConfig::program("/bin/sh".into(), arguments, 2);
    config.grace = Duration::from_millis(10);
    let supervisor = supervise(config, fixture.store.clone(), fixture.shutdown.clone());
    let live_workers = supervisor.live_workers();
    assert_eq!(live_workers.expected(), 2);
    while live_workers.pids().len() < 2 {
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    fixture.shutdown.cancel();
    supervisor.stopped().await;
    assert!(live_workers.pids().is_empty());
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_that_does_not_start_is_retried_and_does_not_end_the_api() {
    use std::os::unix::fs::PermissionsExt as _;

    let fixture = Fixture::new().await;
    let program = fixture.data.path().join("late.sh");
    let mut config = SuperviseConfig::program(program.clone(), Vec::new(), 1);
    config.backoff_base = Duration::from_millis(1);
    config.grace = Duration::from_millis(10);
    let supervisor = supervise(config, fixture.store.clone(), fixture.shutdown.clone());
    let live_workers = supervisor.live_workers();
    let api = api(&fixture, live_workers.clone());
    let ready = async || {
        let (status, ready) = answer(&api, "/readyz").await;
        assert_eq!(status, 200);
        ready["workers"].clone()
    };
    assert_eq!(ready().await, json!({ "expected": 1, "alive": 0 }));
    // Written elsewhere first: a file that is open for writing cannot be run.
    let draft = fixture.data.path().join("draft.sh");
    std::fs::write(&draft, "#!/bin/sh\nexec sleep 1000\n").expect("written");
    std::fs::set_permissions(&draft, std::fs::Permissions::from_mode(0o700)).expect("made a program");
    std::fs::rename(&draft, &program).expect("in its place");
    within(one_live_worker(&live_workers, 0)).await;
    assert_eq!(ready().await, json!({ "expected": 1, "alive": 1 }));
    fixture.shutdown.cancel();
    within(supervisor.stopped()).await;
}

/// The API as `serve` would wire it, over the fixture's store and a supervisor's live workers.
fn api(fixture: &Fixture, live_workers: LiveWorkers) -> axum::Router {
    use tcgs::http::{AppState, Services};
    let services = Services {
        store: fixture.store.clone(),
        blobs: fixture.blobs.clone(),
        clock: Arc::new(SystemClock),
        entropy: Arc::new(tcgs::domain::SystemRandom),
        engine: Arc::new(crate::support::fakes::FakeEngine::default()),
        workers: Arc::new(SupervisedWorkers::new(live_workers, fixture.data.path().join("checkpoints"))),
    };
    tcgs::http::router(AppState::new(services, Default::default(), CancellationToken::new()))
}

async fn answer(api: &axum::Router, path: &str) -> (u16, serde_json::Value) {
    use tower::ServiceExt as _;
    let request = axum::http::Request::get(path).header("host", "localhost");
    let request = request.body(axum::body::Body::empty()).expect("a request");
    let response = api.clone().oneshot(request).await.expect("an answer");
    let status = response.status().as_u16();
    let body = axum::body::to_bytes(response.into_body(), 1 << 20).await.expect("a body");
    (status, serde_json::from_slice(&body).expect("JSON"))
}
