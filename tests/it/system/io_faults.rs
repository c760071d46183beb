//! Each call of the file system in turn fails, in the real service, for want of space or by a fault of the disk: the blob store's and
//! SQLite's alike. The request is answered by a problem or succeeds, nothing refers to what is not there, and afterwards the same request
//! succeeds.

use std::env;

use reqwest::RequestBuilder;
use serde_json::json;

use crate::support::{
    dataset,
    deployment::Deployment,
    eventually::eventually,
    io_faults::{IoFault, IoFaults},
    server::Answer,
    service::Service,
};

/// More calls than any request makes.
const MAX_CALLS: i32 = 600;

const FAULTS: [IoFault; 4] = [IoFault::Full, IoFault::StaysFull, IoFault::Failed, IoFault::ReadOnly];

/// The dataset with a comment, so that archives differ.
fn archive(base: &[u8], number: u32) -> Vec<u8> {
    // The last two bytes are the comment's length.
    let (all, length) = base.split_at(base.len() - 2);
    assert_eq!(length, [0; 2], "it has no comment yet");
    [all, &4_u16.to_le_bytes(), &number.to_le_bytes()].concat()
}

/// Bytes of a dataset whose halves come in several pieces each: a server reads a body through a buffer that is small at first.
const SEVERAL_PIECES: usize = 256 << 10;

/// From one call that fails to the next that is tried.
fn stride(fault: IoFault) -> i32 {
    match fault {
        // A request waits ten seconds for a connection to the database that can be written to.
        IoFault::ReadOnly => 16,
        _ => 1,
    }
}

/// A service whose calls can fail.
struct Fixture {
    faults: IoFaults,
    deployment: Deployment,
    service: Service,
}

impl Fixture {
    async fn new(workers: usize) -> Option<Self> {
        let faults = IoFaults::new()?;
        let mut deployment = Deployment::local().with("TCGS_MIN_FREE_SPACE", "0");
        // As the kernel names it.
        let root = deployment.data().canonicalize().expect("a path");
        for (name, value) in faults.variables(&root) {
            deployment = deployment.with(name, value.to_str().expect("UTF-8"));
        }
        let service = deployment.start(workers).await;
        Some(Self { faults, deployment, service })
    }

    /// Holds the answer to what may come of a fault; returns whether the request has succeeded.
    fn check(&self, fault: IoFault, what: &str, answer: &Answer) -> bool {
        match (fault, answer.status) {
            (_, 200..300) => true,
            // SQLite reports a full disk as a failed one where only a sync finds out.
            (IoFault::Full | IoFault::StaysFull, 507 | 503)
            | (IoFault::Failed | IoFault::ReadOnly, 500 | 503) => {
                // The answer to HEAD has no body.
                assert!(answer.body.is_empty() || answer.json()["type"].is_string(), "{what}");
                false
            }
            (_, status) => {
                let body = String::from_utf8_lossy(&answer.body);
                panic!("{what}: {status} {body}\n{}", self.service.log())
            }
        }
    }

    async fn is_ready(&self) {
        eventually("the service is ready", async || self.service.get("/readyz").await.status == 200).await;
    }

    async fn end(self, after: &str) {
        let Self { deployment, service, .. } = self;
        assert!(!service.log().contains("panicked"), "{}", service.log());
        assert!(service.stop().await.success());
        // Processes that only look have no faults.
        let collected = deployment.without("LD_PRELOAD").assert_tidy(after).await;
        println!("I/O faults: {} unreferenced blobs collected", collected.blobs);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fault_of_any_call_while_a_job_is_created_loses_nothing() {
    let Some(fixture) = Fixture::new(0).await else { return };
    let (base, mut number) = (dataset::zip(), 0);
    for fault in FAULTS {
        let (mut calls, mut tried, mut refused) = (0, 0, 0);
        loop {
            calls += stride(fault);
            tried += 1;
            number += 1;
            assert!(calls < MAX_CALLS, "the request has no end");
            let (archive, key) = (archive(&base, number), format!("job-{number}"));
            let create = async || {
                let create = fixture.service.send("POST", "/v1/jobs", |request| {
                    let request = request.header("content-type", "application/zip");
                    request.header("idempotency-key", &key).body(archive.clone())
                });
                create.await
            };
            fixture.faults.plan(fault, calls);
            let answer = create().await;
            let failed = fixture.faults.relieve();
            let what = format!("call {calls} of a job's creation, {fault:?}");
            let succeeded = fixture.check(fault, &what, &answer);
            let again = create().await;
            assert_eq!(again.status, 201, "{what}: {}", again.json());
            refused += u32::from(!succeeded);
            if failed == 0 {
                break;
            }
        }
        println!("I/O faults: {fault:?} at {} calls of a job's creation, {refused} refused", tried - 1);
        fixture.is_ready().await;
    }
    let jobs = fixture.deployment.database.number("SELECT count(*) FROM jobs").await;
    assert_eq!(jobs, i64::from(number), "one for each key");
    fixture.end("faults while jobs are created").await;
}

/// An upload, which goes on where it was.
struct Upload {
    archive: Vec<u8>,
    path: Option<String>,
}

impl Upload {
    /// Does what is left to do, up to the first request that fails, which is returned.
    async fn go_on(&mut self, service: &Service) -> Result<(), Answer> {
        let tus = |request: RequestBuilder| request.header("tus-resumable", "1.0.0");
        let path = match &self.path {
            Some(path) => path.clone(),
            None => {
                let begin = service.send("POST", "/v1/uploads", |request| {
                    tus(request).header("upload-length", self.archive.len())
                });
                let path = succeeded(begin.await)?.header("location").to_owned();
                self.path.insert(path).clone()
            }
        };
        let id = path.rsplit('/').next().expect("an id");
        let head = service.send("HEAD", &path, tus).await;
        // An upload that has become a scene is gone.
        if head.status != 410 {
            let mut offset: usize = succeeded(head)?.header("upload-offset").parse().expect("a number");
            for end in [self.archive.len() / 2, self.archive.len()] {
                if offset >= end {
                    continue;
                }
                let part = self.archive[offset..end].to_vec();
                let sent = service.send("PATCH", &path, |request| {
                    let request = tus(request).header("upload-offset", offset);
                    request.header("content-type", "application/offset+octet-stream").body(part)
                });
                succeeded(sent.await)?;
                offset = end;
            }
        }
        succeeded(service.post_json("/v1/scenes", &json!({ "upload_id": id })).await).map(drop)
    }
}

fn succeeded(answer: Answer) -> Result<Answer, Answer> {
    if (200..300).contains(&answer.status) { Ok(answer) } else { Err(answer) }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fault_of_any_call_during_a_resumable_upload_loses_nothing() {
    let Some(fixture) = Fixture::new(0).await else { return };
    let (base, mut number) = (dataset::padded_zip(SEVERAL_PIECES), 0);
    for fault in FAULTS {
        let (mut calls, mut tried, mut refused) = (0, 0, 0);
        loop {
            calls += stride(fault);
            tried += 1;
            number += 1;
            assert!(calls < MAX_CALLS, "the upload has no end");
            let mut upload = Upload { archive: archive(&base, number), path: None };
            fixture.faults.plan(fault, calls);
            let answer = upload.go_on(&fixture.service).await;
            let failed = fixture.faults.relieve();
            let what = format!("call {calls} of an upload, {fault:?}");
            if let Err(answer) = &answer {
                fixture.check(fault, &what, answer);
                refused += 1;
                if let Err(again) = upload.go_on(&fixture.service).await {
                    panic!("{what}: {} {}", again.status, String::from_utf8_lossy(&again.body));
                }
            }
            if failed == 0 {
                break;
            }
        }
        println!("I/O faults: {fault:?} at {} calls of an upload, {refused} refused", tried - 1);
        fixture.is_ready().await;
    }
    let scenes = fixture.deployment.database.number("SELECT count(*) FROM scenes").await;
    assert_eq!(scenes, i64::from(number), "one for each archive");
    fixture.end("faults during uploads").await;
}

/// Calls of a whole job at which something fails in a run of all tests, and in a soak.
const A_HANDFUL: [i32; 2] = [40, 90];
const MANY: std::ops::RangeInclusive<i32> = 1..=12;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fault_of_a_call_during_a_job_costs_at_most_an_attempt() {
    let Some(fixture) = Fixture::new(1).await else { return };
    let Fixture { service, deployment, faults } = &fixture;
    let run = async |call: Option<(IoFault, i32)>| {
        let query = "?model=3dgs&iterations=12&seed=5";
        let created = service.upload(query, dataset::zip()).await.expect(201);
        if let Some((fault, call)) = call {
            faults.plan(fault, call);
        }
        let job = created.header("location").to_owned();
        let job = job.trim_start_matches("/v1/jobs/").to_owned();
        // The service could be the one whose call fails.
        let succeeded = format!("SELECT count(*) FROM jobs WHERE id = '{job}' AND state = 'succeeded'");
        eventually("the job has succeeded", async || deployment.database.number(&succeeded).await == 1).await;
        (job, faults.relieve())
    };
    let (undisturbed, _) = run(None).await;
    let calls: Vec<i32> = match env::var_os("TCGS_SOAK_KILLS") {
        Some(_) => MANY.map(|number| 10 * number).collect(),
        None => A_HANDFUL.into(),
    };
    for call in calls {
        for fault in [IoFault::Full, IoFault::Failed] {
            let what = format!("{fault:?} at call {call} of a job");
            let (job, failed) = run(Some((fault, call))).await;
            let artifacts = deployment.artifacts().await;
            assert_eq!(artifacts[&job], artifacts[&undisturbed], "{what}");
            let outcomes = format!("SELECT outcome FROM attempts WHERE job_id = '{job}' ORDER BY number");
            let outcomes: Vec<String> =
                deployment.database.rows(&outcomes, 1).await.into_iter().flatten().collect();
            println!("I/O faults: {what}: {failed} calls failed, attempts {outcomes:?}");
            assert!(outcomes.len() <= 2, "{what}: {outcomes:?}\n{}", service.log());
        }
    }
    deployment.checkpoints_are_gone().await;
    fixture.end("faults during jobs").await;
}
