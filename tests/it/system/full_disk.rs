//! The real program on a disk that is full for a while: what needs room is refused with 507, the service says that it is not ready,
//! and once there is room everything goes on without a restart.

use std::{
    fs::File,
    path::Path,
    process::{Child, Stdio},
    time::Duration,
};

use serde_json::{Value, json};
use tcgs::{
    ingest,
    sample::{self, Settings},
};

use crate::support::{
    dataset, program,
    service::{Service, kill},
    small_disk::SmallDisk,
};

const ENDPOINTS: &str = "/v1/webhook-endpoints";
/// How often something is looked at until it has to be as wanted, and how long apart.
const LOOKS: usize = 600;
const PAUSE: Duration = Duration::from_millis(100);

/// Asks until the status is the wanted one.
async fn until(service: &Service, path: &str, status: u16) -> Value {
    for _ in 0..LOOKS {
        let answer = service.get(path).await;
        if answer.status == status {
            return answer.json();
        }
        tokio::time::sleep(PAUSE).await;
    }
    panic!("{path} never answered {status}:\n{}", service.log());
}

async fn add_endpoint(service: &Service) -> crate::support::server::Answer {
    service.post_json(ENDPOINTS, &json!({ "url": "https://example.com/" })).await
}

async fn cancel(service: &Service, job: &str) -> crate::support::server::Answer {
    service.send("POST", &format!("{job}/cancel"), |request| request).await
}

/// A dataset that is let in and cannot be trained on: its pictures are cut off.
fn damaged_zip() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = folder.path().join("scene");
    sample::write(&scene, &Settings { points: 100, ..Settings::square(16) }).expect("writes");
    let mut folders = vec![scene.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|name| name == "png") {
                let content = std::fs::read(&path).expect("readable");
                std::fs::write(&path, &content[..content.len() * 2 / 3]).expect("written");
            }
        }
    }
    let path = folder.path().join("damaged.zip");
    ingest::pack(&scene, &mut File::create(&path).expect("a file")).expect("packed");
    std::fs::read(path).expect("readable")
}

/// `tcgs worker` in a process of its own.
struct Worker {
    child: Child,
    log: tempfile::NamedTempFile,
}

impl Worker {
    fn start(data: &Path) -> Self {
        let log = tempfile::NamedTempFile::new().expect("a file");
        let child = program::command()
            .args(["worker", "--log-format", "json", "--data"])
            .arg(data)
            .stdout(Stdio::null())
            .stderr(log.reopen().expect("a file"))
            .spawn()
            .expect("the binary runs");
        Self { child, log }
    }

    fn signal(&self, signal: &str) {
        kill(signal, self.child.id());
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.log.path()).expect("readable")
    }

    async fn says(&self, what: &str, times: usize) {
        for _ in 0..LOOKS {
            if self.log().matches(what).count() >= times {
                return;
            }
            tokio::time::sleep(PAUSE).await;
        }
        panic!("the worker never said '{what}' {times} times:\n{}", self.log());
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_goes_on_once_a_full_disk_has_room_again() {
    let Some(disk) = SmallDisk::mount(16) else { return };
    // The bound on free room is off: the probes alone have to notice.
    let service = Service::start_with(disk.path(), ["--workers", "0", "--min-free-space", "0"]).await;
    let first = service.upload("", dataset::zip()).await.expect(201).header("location").to_owned();
    let second = service.upload("?seed=2", dataset::zip()).await.expect(201).header("location").to_owned();
    until(&service, "/readyz", 200).await;

    for _ in 0..2 {
        disk.fill();
        for _ in 0..2 {
            add_endpoint(&service).await.expect_problem(507, "storage-full");
            cancel(&service, &first).await.expect_problem(507, "storage-full");
        }
        service.upload("", dataset::zip()).await.expect_problem(507, "storage-full");
        let problem = until(&service, "/readyz", 503).await;
        assert_eq!(problem["checks"]["database"], "no room is left on its disk", "{problem:#}");
        assert_eq!(problem["checks"]["blobs"], "no room is left on their disk", "{problem:#}");
        assert_eq!(problem["checks"]["free_space"], "ok", "{problem:#}");
        service.get(&first).await.expect(200);
        assert!(service.log().contains("database or disk is full"), "{}", service.log());

        disk.make_room();
        add_endpoint(&service).await.expect(201);
        until(&service, "/readyz", 200).await;
    }
    cancel(&service, &first).await.expect(200);
    cancel(&service, &second).await.expect(200);
    service.upload("", dataset::zip()).await.expect(201);
    assert!(service.stop().await.success());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_goes_on_once_a_full_disk_has_room_again() {
    let Some(disk) = SmallDisk::mount(16) else { return };
    let service = Service::start_with(disk.path(), ["--workers", "0", "--min-free-space", "0"]).await;
    let worker = Worker::start(disk.path());
    worker.says("is ready", 1).await;
    // The job and the full disk are there before it looks again.
    worker.signal("-STOP");
    let job = service.upload("", damaged_zip()).await.expect(201).header("location").to_owned();
    disk.fill();
    worker.signal("-CONT");
    worker.says("database or disk is full", 2).await;
    let waiting = service.get(&job).await.expect(200).json();
    assert_eq!(waiting["state"], "queued", "{waiting:#}");

    disk.make_room();
    let ended = service.job_until(&job, |now| !now["finished_at"].is_null()).await;
    assert_eq!(ended["state"], "failed", "{ended:#}");
    let kind = ended["error"]["type"].as_str().expect("a problem");
    assert!(
        !kind.ends_with("storage-full") && ended["error"]["status"] == 422,
        "it was taken and read: {ended:#}"
    );
    drop(worker);
    assert!(service.stop().await.success());
}
