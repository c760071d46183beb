//! The real service and its worker are killed together, as by a power cut, or the worker alone, again and again.

#![cfg(target_os = "linux")]

use std::{path::Path, time::Duration};

use serde_json::Value;

use crate::support::{
    dataset,
    service::{Service, kill},
};

/// Longest wait for a job; without a mend a lease of a minute would have to run out each time.
const LONGEST: Duration = Duration::from_secs(240);

async fn start(data: &Path) -> Service {
    Service::start(data).await
}

async fn until(service: &Service, job: &str, done: impl FnMut(&Value) -> bool) -> Value {
    let waiting = tokio::time::timeout(LONGEST, service.job_until(job, done)).await;
    waiting.unwrap_or_else(|_| panic!("it takes too long:\n{}", service.log()))
}

/// Waits until an attempt trains.
async fn trains(service: &Service, job: &str, attempt: u32) {
    until(service, job, |now| now["attempt"] == attempt && now["phase"] == "train").await;
}

/// How the attempts at a job ended, with the details of their causes.
async fn ends(service: &Service, job: &str) -> Vec<(String, String)> {
    let events = service.get(&format!("{job}/events?limit=1000")).await.expect(200).json();
    let events = events["events"].as_array().expect("events");
    let ended = events.iter().filter(|event| event["kind"] == "attempt").map(|event| &event["data"]);
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    ended.map(|end| (text(&end["outcome"]), text(&end["cause"]["detail"]))).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_survives_power_cuts_before_its_first_checkpoint() {
    let data = tempfile::tempdir().expect("a folder");
    let mut service = start(data.path()).await;
    let made = service.upload("?iterations=300", dataset::zip()).await.expect(201);
    let job = made.header("location").to_owned();
    for attempt in 1..=3 {
        trains(&service, &job, attempt).await;
        service.cut_power().await;
        service = start(data.path()).await;
    }
    let done = until(&service, &job, |now| now["state"] == "succeeded").await;
    assert_eq!(done["attempt"], 4);
    let ends = ends(&service, &job).await;
    assert_eq!(ends.len(), 3, "{ends:#?}");
    for (outcome, cause) in &ends {
        assert_eq!(outcome, "lost");
        assert!(cause.contains("does not count against the job"), "{cause}");
    }
    assert!(service.stop().await.success());
    let left = std::fs::read_dir(data.path().join("workers")).expect("a folder").count();
    assert_eq!(left, 0, "workers that ended have left no sign of life");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_worker_alone_dies_twice_at_the_same_step_is_given_up_and_says_so() {
    let data = tempfile::tempdir().expect("a folder");
    let service = start(data.path()).await;
    let made = service.upload("?iterations=300", dataset::zip()).await.expect(201);
    let job = made.header("location").to_owned();
    for attempt in 1..=2 {
        trains(&service, &job, attempt).await;
        let workers = service.workers();
        assert_eq!(workers.len(), 1, "{}", service.log());
        kill("-KILL", workers[0]);
    }
    let failed = until(&service, &job, |now| !now["finished_at"].is_null()).await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:resource-exhausted", "{failed:#}");
    let detail = failed["error"]["detail"].as_str().expect("a detail");
    assert!(detail.contains("2 attempts in a row ended before its first checkpoint"), "{detail}");
    assert!(service.stop().await.success());
}
