//! Checkpoints that a job resumes from on another machine.

use std::{
    fs,
    io::ErrorKind,
    path::Path,
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::Bytes;
use object_store::memory::InMemory;
use tcgs::{
    domain::{CancelFlag, JobId, Phase, Problem, ProblemType, Progress, SystemClock, TrainOptions},
    pipeline::{CheckpointPlan, JobError, JobOutput, Resume, RunJob},
    store::{Blobs, NewJob, QueuePolicy, Store},
    worker::{self, WorkerConfig},
};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::support::{
    database::Database,
    faulty_bucket::{FaultyBucket, Side},
    server::quick_worker,
};

/// Notes whether it finds a checkpoint, leaves one of two files, and ends with its worker.
struct OneRun {
    found: Arc<Mutex<Vec<bool>>>,
    shutdown: CancellationToken,
}

impl RunJob for OneRun {
    fn run(
        &self,
        _dataset: &Path,
        _options: &TrainOptions,
        checkpoints: &CheckpointPlan,
        _report: &mut dyn FnMut(Phase, &Progress),
        _cancel: &CancelFlag,
    ) -> Result<JobOutput, JobError> {
        let Resume::IfPossible(resume) = &checkpoints.resume else { panic!("{checkpoints:?}") };
        self.found.lock().expect("not poisoned").push(resume.join("step").exists());
        let keep = checkpoints.keep.as_ref().expect("they are kept");
        fs::create_dir_all(keep.join("branch-0")).expect("made");
        fs::write(keep.join("step"), "400").expect("written");
        fs::write(keep.join("branch-0").join("step"), "400").expect("written");
        self.shutdown.cancel();
        Err(JobError::Hold(Problem::new(ProblemType::StorageFull, "as the test wants it")))
    }
}

struct Fixture {
    store: Store,
    blobs: Blobs,
    faults: FaultyBucket,
    found: Arc<Mutex<Vec<bool>>>,
    folder: tempfile::TempDir,
    _database: Database,
}

impl Fixture {
    async fn new() -> Self {
        let database = Database::sqlite();
        let policy = QueuePolicy { hold_delay: Duration::ZERO, ..QueuePolicy::default() };
        let store = database.open(Arc::new(SystemClock), policy).await;
        let faults = FaultyBucket::new(Arc::new(InMemory::new()));
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open_bucket(folder.path(), Arc::new(faults.clone()), store.clone());
        let blobs = blobs.await.expect("a bucket");
        Self { store, blobs, faults, found: Arc::default(), folder, _database: database }
    }

    /// A worker on a machine of its own, until it has run a job.
    async fn machine(&self, name: &str) {
        let shutdown = CancellationToken::new();
        let runner = OneRun { found: Arc::clone(&self.found), shutdown: shutdown.clone() };
        let checkpoints = Some(self.folder.path().join(name));
        let config = WorkerConfig { checkpoints, ..quick_worker(name) };
        let worker =
            worker::serve(self.store.clone(), self.blobs.clone(), Arc::new(runner), config, shutdown);
        worker.await.expect("an orderly end");
    }

    /// A queued job.
    async fn job(&self) -> JobId {
        let dataset = self.blobs.put(Bytes::from_static(b"dataset")).await.expect("published");
        let job = JobId(Uuid::from_u128(1));
        self.store.create_job(NewJob::new(job, TrainOptions::default(), dataset)).await.expect("queued");
        job
    }

    /// The attempts of a job that have copies in the bucket.
    async fn copied_attempts(&self, job: JobId) -> Vec<String> {
        let files = self.blobs.shared_files().expect("a bucket");
        files.folders(&format!("checkpoints/{job}")).await.expect("listed")
    }
}

#[tokio::test]
async fn of_a_job_that_is_held_again_and_again_one_copy_is_kept() {
    let fixture = Fixture::new().await;
    let job = fixture.job().await;
    for attempt in 1..=5 {
        fixture.machine("one").await;
        assert_eq!(fixture.copied_attempts(job).await, [format!("attempt-{attempt}")]);
    }
}

#[tokio::test]
async fn a_copy_that_lacks_a_file_is_completed_by_the_one_before() {
    let fixture = Fixture::new().await;
    let job = fixture.job().await;
    fixture.machine("first").await;
    let cut = format!("put checkpoints/{job}/attempt-2/step");
    fixture.faults.plan_of(&cut, Side::Request, ErrorKind::Other, 1);
    fixture.machine("second").await;
    assert!(fixture.faults.relieve(), "the second machine copies the other file alone");
    assert_eq!(fixture.copied_attempts(job).await, ["attempt-1", "attempt-2"]);
    fixture.machine("third").await;
    assert_eq!(*fixture.found.lock().expect("not poisoned"), [false, true, true]);
    assert_eq!(fixture.copied_attempts(job).await, ["attempt-3"]);
}

#[tokio::test]
async fn a_job_whose_checkpoint_cannot_be_fetched_now_waits_instead_of_beginning_again() {
    let fixture = Fixture::new().await;
    let job = fixture.job().await;
    fixture.machine("first").await;
    let mut held = 1;
    for request in ["list", "get"] {
        for kind in [ErrorKind::Other, ErrorKind::StorageFull] {
            fixture.faults.plan_of(&format!("{request} checkpoints/{job}"), Side::Request, kind, 1);
            fixture.machine(&format!("{request} {kind:?}")).await;
            assert!(fixture.faults.relieve(), "{request}: {kind:?}");
            held += 2;
            let attempts = fixture.store.attempts(job).await.expect("read").len();
            assert_eq!(attempts, held, "{request}: {kind:?}: one attempt is held, and the next one runs");
        }
    }
    assert_eq!(*fixture.found.lock().expect("not poisoned"), [false, true, true, true, true]);
}
