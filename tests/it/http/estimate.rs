//! `POST /v1/estimate`: what a job would take by the finished ones.

use jiff::SignedDuration;
use serde_json::{Value, json};
use std::{sync::Arc, time::Duration};
use tcgs::{
    domain::{JobMetrics, ManualClock, PhaseSeconds, ProjectId, Scope},
    store::{Outcome, QueuePolicy},
};

use crate::support::{
    contract::Coverage,
    fakes,
    server::{Server, Setup, quick_policy},
};

/// A service without workers at a time that stands still, and the path of a dataset of it.
async fn server(coverage: &Coverage) -> (Server, Arc<ManualClock>, String) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    // The clock jumps farther than a lease lasts, and what is over is swept meanwhile.
    let policy = QueuePolicy { lease: Duration::from_secs(86_400), ..quick_policy() };
    let setup = Setup { worker: false, clock: clock.clone(), policy, ..Setup::default() };
    let server = Server::start_with(coverage, setup).await;
    let made = server
        .send("POST", "/v1/datasets", |request| {
            request.header("content-type", "application/zip").body("succeed with a dataset")
        })
        .await
        .expect(201);
    let id = made.json()["id"].as_str().expect("an id").to_owned();
    (server, clock, id)
}

/// A finished job that took `seconds` besides its training.
async fn finish(server: &Server, clock: &ManualClock, query: &str, metrics: JobMetrics, seconds: i64) {
    server.upload(query, "succeed").await.expect(201);
    let lease = server.store.claim("test").await.expect("an answer").expect("a job").lease;
    clock.advance(SignedDuration::from_secs(metrics.seconds.train as i64 + seconds));
    let outcome = Outcome::Succeeded { metrics: Box::new(metrics), artifacts: vec![] };
    server.store.finish(&lease, outcome).await.expect("ended");
}

fn metrics(steps_per_second: f64) -> JobMetrics {
    let seconds = PhaseSeconds { train: 60.0, ..PhaseSeconds::default() };
    JobMetrics { steps_per_second, seconds, view_pixels: Some(40 * 32), ..fakes::metrics() }
}

pub(super) async fn a_job_is_estimated_by_finished_jobs_and_nothing_is_created(coverage: Coverage) {
    let (server, clock, dataset) = server(&coverage).await;
    let request = json!({ "dataset_id": dataset, "iterations": 1000 });
    let estimate = async |request: &Value| server.post_json("/v1/estimate", request).await.expect(200).json();
    let unknown = estimate(&request).await;
    assert_eq!((&unknown["train_seconds"], &unknown["seconds"]), (&Value::Null, &Value::Null));
    assert_eq!(unknown["steps"], 1000);
    assert_eq!(unknown["memory"]["gpu_bytes"], 3 * 40 * 32);
    assert_eq!(unknown["file_bytes"], json!({ "low": 100, "high": 200 }));
    let reason =
        "times are unknown: none of the newest jobs of this service trained model tcgs by preset preview";
    assert_eq!(unknown["notes"], json!(["as the test wants it", reason]));

    for (query, speed, seconds) in
        [("", 20.0, 10), ("", 10.0, 30), ("?preset=standard", 1.0, 10), ("?model=3dgs", 100.0, 10)]
    {
        finish(&server, &clock, query, metrics(speed), seconds).await;
    }
    finish(&server, &clock, "", JobMetrics { view_pixels: None, ..metrics(1000.0) }, 10).await;
    let known = estimate(&request).await;
    // Two jobs: their range is widened by a quarter.
    assert_eq!(known["finished_jobs"]["steps_per_second"], json!({ "low": 8.0, "high": 25.0 }));
    assert_eq!(known["train_seconds"], json!({ "low": 40.0, "high": 130.0 }));
    assert_eq!(known["seconds"], json!({ "low": 48.0, "high": 170.0 }));
    assert_eq!(
        (&known["finished_jobs"]["count"], &known["finished_jobs"]["adapters"]),
        (&json!(2), &json!(["fake"]))
    );
    assert_eq!(known["notes"], json!(["as the test wants it"]));
    let plain = estimate(&json!({ "dataset_id": dataset, "model": "3dgs", "name": "as for a job" })).await;
    assert_eq!(plain["finished_jobs"]["steps_per_second"], json!({ "low": 66.0, "high": 150.0 }));

    let listed = server.get("/v1/jobs").await.expect(200).json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(5), "no estimate made a job");
    let key = server.key_with(&[Scope::Read, Scope::DatasetsWrite], Default::default()).await;
    assert_ne!(key.project, ProjectId::DEFAULT);
    let asked = server
        .send("POST", "/v1/estimate", |http| {
            let http = http.bearer_auth(&key.key).header("content-type", "application/json");
            http.body(request.to_string())
        })
        .await;
    asked.expect_problem(404, "scene-not-found");
}

pub(super) async fn what_cannot_be_estimated_is_refused_or_noted(coverage: Coverage) {
    let (server, _, dataset) = server(&coverage).await;
    for (fields, kind, named) in [
        (json!({ "preset": "standard" }), "invalid-parameter", "dataset_id"),
        (json!({ "dataset_id": dataset, "preset": "fast" }), "invalid-option", "preset"),
        (json!({ "dataset_id": dataset, "color": "red" }), "invalid-option", "color"),
    ] {
        let detail = server.post_json("/v1/estimate", &fields).await.expect_problem(422, kind);
        assert!(detail.starts_with(named), "{fields}: {detail}");
    }
    let asked = async |media_type: &'static str, body: &'static str| {
        server.send("POST", "/v1/estimate", |http| http.header("content-type", media_type).body(body)).await
    };
    asked("application/zip", "PK").await.expect_problem(415, "unsupported-media-type");
    asked("application/json", "{").await.expect(400);
    let long = json!({ "dataset_id": dataset, "name": "x".repeat(2 << 20) });
    server.post_json("/v1/estimate", &long).await.expect_problem(413, "body-too-large");
}
