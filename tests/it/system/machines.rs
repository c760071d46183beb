//! Machines that share nothing but a PostgreSQL database and a bucket: API replicas and workers, each with a data folder of its own.

#![cfg(unix)]

use std::{
    path::Path,
    process::{ExitStatus, Stdio},
    sync::{Arc, Mutex},
};

use serde_json::{Value, json};
use tcgs::{domain::Digest, store::BucketUrl};
use tempfile::TempDir;
use tokio::{
    io::{AsyncBufReadExt as _, BufReader},
    process::Child,
};

use crate::support::{
    bucket::{S3Server, SECRET, variables},
    dataset,
    eventually::{eventually, within},
    gate::{Gate, GateState},
    postgres::{Cluster, PASSWORD, PostgresDatabase},
    program,
    service::{Service, kill},
};

/// What all machines are told.
pub(super) struct Shared {
    pub(super) database: PostgresDatabase,
    pub(super) bucket: BucketUrl,
    pub(super) variables: Vec<(String, String)>,
}

impl Shared {
    pub(super) fn environment(&self) -> Vec<(&str, String)> {
        let mut all: Vec<(&str, String)> =
            self.variables.iter().map(|(name, value)| (name.as_str(), value.clone())).collect();
        all.push(("TCGS_DATABASE", self.database.url().expose().to_owned()));
        all.push(("TCGS_BLOBS", self.bucket.to_string()));
        all
    }

    async fn replica(&self, data: &Path) -> Service {
        Service::start_in(data, ["--workers", "0"], &self.environment()).await
    }
}

/// A worker or a viewer on a machine of its own. Dropping it kills it.
pub(super) struct Machine {
    child: Child,
    log: Arc<Mutex<String>>,
    _data: TempDir,
}

impl Machine {
    pub(super) fn start(shared: &Shared, arguments: &[&str]) -> Self {
        let data = tempfile::tempdir().expect("a folder");
        let mut command = tokio::process::Command::from(program::command());
        command.args(arguments).arg("--data").arg(data.path()).envs(shared.environment());
        command.stdin(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
        let mut child = command.spawn().expect("the binary runs");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let log: Arc<Mutex<String>> = Arc::default();
        let kept = Arc::clone(&log);
        tokio::spawn(async move {
            while let Ok(Some(line)) = lines.next_line().await {
                *kept.lock().expect("not poisoned") += &(line + "\n");
            }
        });
        Self { child, log, _data: data }
    }

    pub(super) fn log(&self) -> String {
        self.log.lock().expect("not poisoned").clone()
    }

    /// Ends it as a power cut would.
    pub(super) async fn cut_power(&mut self) {
        self.child.kill().await.expect("killed");
    }

    pub(super) async fn stop(&mut self) -> ExitStatus {
        kill("-TERM", self.child.id().expect("running"));
        within("the process has ended", self.child.wait()).await.expect("ended")
    }
}

/// Sends bytes of an upload to one replica.
async fn send_part(replica: &Service, upload: &str, from: usize, part: &[u8]) -> usize {
    let sent = replica.send("PATCH", upload, |request| {
        let request = request.header("tus-resumable", "1.0.0").header("upload-offset", from);
        request.header("content-type", "application/offset+octet-stream").body(part.to_vec())
    });
    sent.await.expect(204).header("upload-offset").parse().expect("a number")
}

/// Uploads an archive in turns over two replicas, and makes a scene of it.
async fn upload(one: &Service, other: &Service, archive: &[u8]) -> String {
    let begun = one.send("POST", "/v1/uploads", |request| {
        request.header("tus-resumable", "1.0.0").header("upload-length", archive.len())
    });
    let upload = begun.await.expect(201).header("location").to_owned();
    let (first, second) = (archive.len() / 3, archive.len() / 2);
    assert_eq!(send_part(one, &upload, 0, &archive[..first]).await, first);
    assert_eq!(send_part(other, &upload, first, &archive[first..second]).await, second);
    assert_eq!(send_part(one, &upload, second, &archive[second..]).await, archive.len());
    let id = upload.rsplit('/').next().expect("an id");
    let scene = other.post_json("/v1/scenes", &json!({ "upload_id": id })).await.expect(201).json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(archive).to_string(), "{scene:#}");
    scene["id"].as_str().expect("an id").to_owned()
}

async fn create_job(replica: &Service, scene: &str) -> String {
    let options = json!({ "scene_id": scene, "preset": "preview", "iterations": 400, "seed": 3 });
    replica.post_json("/v1/jobs", &options).await.expect(201).header("location").to_owned()
}

/// The scene's file as a replica sends it.
async fn file(replica: &Service, job: &str) -> Vec<u8> {
    replica.get(&format!("{job}/artifact")).await.expect(200).body.to_vec()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machines_share_a_database_and_a_bucket_and_nothing_else() {
    let (Some(cluster), Some(server)) = (Cluster::shared(), S3Server::shared()) else { return };
    let gate = Gate::start(server.address).await;
    let shared = Shared {
        database: cluster.empty_database().await,
        bucket: server.prefix(),
        variables: variables(gate.address),
    };
    let [one_data, other_data] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    let one = shared.replica(one_data.path()).await;
    let other = shared.replica(other_data.path()).await;
    let archive = dataset::zip();
    let scene = upload(&one, &other, &archive).await;

    let job = create_job(&one, &scene).await;
    let mut first = Machine::start(&shared, &["worker"]);
    let under_way = |now: &Value| now["progress"]["step"].as_u64().is_some_and(|step| step >= 20);
    other.job_until(&job, under_way).await;
    assert!(first.stop().await.success(), "{}", first.log());
    let stopped = one.get(&job).await.expect(200).json();
    assert_eq!(stopped["state"], "queued", "{stopped:#}");

    let second = Machine::start(&shared, &["worker"]);
    one.succeeded(&job).await;
    let said = second.log();
    assert!(said.contains("goes on with a checkpoint of another machine"), "{said}");

    // The bucket is gone for a while.
    let by_pose = format!("{job}/view?width=32&height=32&position=3,0,0&look_at=0,0,0");
    gate.set(GateState::Shut);
    let again = async || other.get(&format!("{job}/artifact")).await.status;
    eventually("the bucket is missed", async || again().await == 503).await;
    other.get(&by_pose).await.expect(503);
    eventually("the replica is not ready", async || other.get("/readyz").await.status == 503).await;
    let undisturbed = create_job(&other, &scene).await;
    let is_held = |attempt: &Value| attempt["outcome"] == "released";
    let waits = |now: &Value| now["attempts"].as_array().is_some_and(|attempts| attempts.iter().any(is_held));
    other.job_until(&undisturbed, waits).await;
    gate.set(GateState::Open);
    eventually("the replica is ready again", async || other.get("/readyz").await.status == 200).await;

    other.succeeded(&undisturbed).await;
    let expected = file(&one, &undisturbed).await;
    assert!(file(&other, &job).await == expected, "the interrupted job gave another file");
    let view = one.get(&format!("{job}/view?width=32&height=32&frame=images/view_06.png")).await.expect(200);
    assert_eq!(view.header("content-type"), "image/png");

    for data in [&one_data, &other_data] {
        let kept = |name: &str| std::fs::read_dir(data.path().join(name)).map_or(0, Iterator::count);
        assert_eq!((kept("blobs"), kept("uploads"), kept("checkpoints")), (0, 0, 0), "all is in the bucket");
    }
    for unwanted in ["panicked", PASSWORD, SECRET] {
        for log in [one.log(), other.log(), first.log(), second.log()] {
            assert!(!log.contains(unwanted), "a log shows '{unwanted}'");
        }
    }
    assert!(one.stop().await.success() && other.stop().await.success());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_whose_machine_dies_is_replaced_by_another_once_its_lease_has_expired() {
    let (Some(cluster), Some(server)) = (Cluster::shared(), S3Server::shared()) else { return };
    let shared = Shared {
        database: cluster.empty_database().await,
        bucket: server.prefix(),
        variables: variables(server.address),
    };
    let data = tempfile::tempdir().expect("a folder");
    let replica = shared.replica(data.path()).await;
    let create = async || {
        let made = replica.upload("?preset=preview&iterations=60&seed=3", dataset::zip());
        made.await.expect(201).header("location").to_owned()
    };
    let job = create().await;

    let mut first = Machine::start(&shared, &["worker"]);
    let under_way = |now: &Value| now["progress"]["step"].as_u64().is_some_and(|step| step >= 10);
    replica.job_until(&job, under_way).await;
    first.cut_power().await;
    let mut second = Machine::start(&shared, &["worker"]);
    replica.succeeded(&job).await;
    let attempts = replica.get(&job).await.expect(200).json()["attempts"].clone();
    let outcomes: Vec<&Value> =
        attempts.as_array().expect("a list").iter().map(|one| &one["outcome"]).collect();
    assert_eq!(outcomes, ["lost", "succeeded"], "{attempts:#}");

    let undisturbed = create().await;
    replica.succeeded(&undisturbed).await;
    assert!(file(&replica, &job).await == file(&replica, &undisturbed).await, "the job gave another file");
    assert!(second.stop().await.success(), "{}", second.log());
    assert!(replica.stop().await.success());
}
