//! A disk that is full during a job costs that job time and nothing else.

#![cfg(target_os = "linux")]

use std::{os::unix::fs::symlink, time::Duration};

use serde_json::Value;

use crate::support::{dataset, service::Service, small_disk::SmallDisk};

/// Longest wait for a job.
const LONGEST: Duration = Duration::from_secs(240);

/// The events of attempts that ended without ending the job.
async fn ended_attempts(service: &Service, job: &str) -> Vec<Value> {
    let events = service.get(&format!("{job}/events?limit=1000")).await.expect(200).json();
    let events = events["events"].as_array().expect("events");
    events.iter().filter(|event| event["kind"] == "attempt").map(|event| event["data"].clone()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_without_disk_space_for_checkpoints_and_files_is_held_until_there_is_some() {
    let Some(disk) = SmallDisk::mount(8) else { return };
    let data = tempfile::tempdir().expect("a folder");
    for folder in ["blobs", "checkpoints"] {
        std::fs::create_dir(disk.path().join(folder)).expect("made");
        symlink(disk.path().join(folder), data.path().join(folder)).expect("linked");
    }
    let service = Service::start_with(data.path(), ["--min-free-space", "1"]).await;
    let made = service.upload("?iterations=200", dataset::zip()).await.expect(201);
    let job = made.header("location").to_owned();
    let wait = async |done: fn(&Value) -> bool| {
        let waiting = tokio::time::timeout(LONGEST, service.job_until(&job, done)).await;
        waiting.unwrap_or_else(|_| panic!("it takes too long:\n{}", service.log()))
    };
    wait(|now| now["phase"] == "train").await;
    disk.fill();
    let held = wait(|now| now["state"] == "queued").await;
    assert_eq!(held["error"], Value::Null, "{held:#}");
    disk.make_room();
    let done = wait(|now| now["state"] == "succeeded").await;
    let ended = ended_attempts(&service, &job).await;
    assert_eq!(done["attempt"].as_u64(), Some(ended.len() as u64 + 1));
    for end in &ended {
        assert_eq!(end["outcome"], "released", "{end:#}");
        assert_eq!(end["cause"]["type"], "urn:tcgs:problem:storage-full", "{end:#}");
        let detail = end["cause"]["detail"].as_str().expect("a detail");
        assert!(!detail.contains('/'), "no path of the server: {detail}");
    }
    let log = service.log();
    assert!(log.contains("checkpoint of step"), "{log}");
    service.get(&format!("{job}/artifact")).await.expect(200);
    assert!(service.stop().await.success());
}
