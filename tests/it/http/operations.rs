//! What operators read: metrics and readiness.

use std::{sync::Arc, time::Duration};

use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{
    domain::{JobMetrics, ManualClock, Phase, PhaseSeconds, SceneFormat},
    store::{AfterAttempt, Artifact, ArtifactKind, DeliveryResult, Outcome},
};

use crate::support::{
    contract::Coverage,
    database::Database,
    fakes,
    faults::Failing,
    server::{Server, Setup},
};

/// The value of a series, `name{labels}` as it is written.
fn series(text: &str, name: &str) -> f64 {
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("no {name} in\n{text}")).parse().expect("a number")
}

/// Asks on a connection of its own.
async fn afresh(url: &str) -> reqwest::Response {
    let client = tcgs::https::client_builder().expect("a provider").build().expect("a client");
    client.get(url).send().await.expect("an answer")
}

async fn metrics(server: &Server) -> String {
    String::from_utf8(server.get("/metrics").await.expect(200).body.to_vec()).expect("UTF-8")
}

/// Asks until what the database said last is no longer told again.
async fn metrics_until(server: &Server, mut done: impl FnMut(&str) -> bool) -> String {
    loop {
        let text = metrics(server).await;
        if done(&text) {
            return text;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

pub(super) async fn metrics_tell_of_requests_jobs_and_the_machine(coverage: Coverage) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let setup = Setup { worker: false, clock: clock.clone(), ..Setup::default() };
    let server = Server::start_with(&coverage, setup).await;
    let [first, _, _] =
        [server.create("succeed").await, server.create("succeed 2").await, server.create("bytes").await];
    let store = &server.services.store;
    for outcome in [
        Outcome::Failed(tcgs::domain::Problem::new(
            tcgs::domain::ProblemType::DatasetRejected,
            "as the test wants it",
        )),
        Outcome::Retry(tcgs::domain::Problem::new(
            tcgs::domain::ProblemType::DeviceLost,
            "as the test wants it",
        )),
    ] {
        let claim = store.claim("test").await.expect("an answer").expect("a job");
        store.finish(&claim.lease, outcome).await.expect("ended");
    }
    let running = store.claim("test").await.expect("an answer").expect("a job");
    let progress = tcgs::domain::Progress { steps_per_second: Some(12.5), ..Default::default() };
    store.report(&running.lease, Phase::Train, &progress).await.expect("reported");
    server.get(&first).await.expect(200);
    // The third job has been waiting since.
    clock.advance(SignedDuration::from_millis(12_500));

    let text = metrics(&server).await;
    assert!(text.ends_with("# EOF\n"), "{text}");
    let of_jobs = |what: &str| format!("http_request_duration_seconds_count{{{what}}}");
    assert_eq!(series(&text, &of_jobs("method=\"POST\",route=\"/v1/jobs\",status=\"201\"")), 3.0);
    assert_eq!(series(&text, &of_jobs("method=\"GET\",route=\"/v1/jobs/{id}\",status=\"200\"")), 1.0);
    assert_eq!(series(&text, "http_active_requests"), 1.0, "the one that asks");
    assert!(series(&text, "http_connections") >= 1.0);
    assert_eq!(series(&text, "http_request_body_bytes_total{route=\"/v1/jobs\"}"), 7.0 + 9.0 + 5.0);
    for (state, count) in [("queued", 1), ("running", 1), ("failed", 1), ("succeeded", 0), ("cancelled", 0)] {
        assert_eq!(series(&text, &format!("tcgs_jobs{{state=\"{state}\"}}")), f64::from(count), "{state}");
    }
    assert_eq!(series(&text, "tcgs_oldest_queued_job_age_seconds"), 12.5);
    assert_eq!(series(&text, "tcgs_claims_total"), 3.0);
    for (outcome, cause) in [("failed", "dataset-rejected"), ("retried", "device-lost")] {
        let name = format!("tcgs_attempts_ended_total{{outcome=\"{outcome}\",cause=\"{cause}\"}}");
        assert_eq!(series(&text, &name), 1.0);
    }
    assert_eq!(series(&text, "tcgs_training_steps_per_second"), 12.5);
    assert_eq!(series(&text, "tcgs_workers{state=\"expected\"}"), 1.0);
    assert_eq!(series(&text, "tcgs_blobs"), 3.0);
    assert_eq!(series(&text, "tcgs_blob_bytes"), 21.0);
    assert!(series(&text, "tcgs_disk_free_bytes") > 0.0);
    assert_eq!(series(&text, "tcgs_render_queue{state=\"waiting\"}"), 0.0);
    assert_eq!(series(&text, "tcgs_event_streams"), 0.0);
    assert_eq!(series(&text, &format!("tcgs_build_info{{version=\"{}\"}}", env!("CARGO_PKG_VERSION"))), 1.0);

    // A job's end is told once what was told before is a second old; until then a database that fails does no harm.
    let seconds = PhaseSeconds { ingest: 1.5, train: 60.25, encode: 2.5, decode: 0.125 };
    let figures = JobMetrics { seconds, ..fakes::metrics() };
    let blob = server.services.blobs.put(fakes::FILE.into()).await.expect("published");
    let file = Artifact { kind: ArtifactKind::Scene(SceneFormat::Tcgs), lambda: None, blob };
    let end = Outcome::Succeeded { metrics: Box::new(figures), artifacts: vec![file] };
    store.finish(&running.lease, end).await.expect("ended");
    let text = metrics_until(&server, |text| series(text, "tcgs_jobs{state=\"succeeded\"}") == 1.0).await;
    for (phase, seconds) in [("ingest", 1.5), ("train", 60.25), ("encode", 2.5), ("decode", 0.125)] {
        assert_eq!(
            series(&text, &format!("tcgs_phase_seconds_total{{phase=\"{phase}\"}}")),
            seconds,
            "{phase}"
        );
    }
    for (state, count) in [("queued", 1), ("running", 0), ("failed", 1), ("succeeded", 1), ("cancelled", 0)] {
        assert_eq!(series(&text, &format!("tcgs_jobs{{state=\"{state}\"}}")), f64::from(count), "{state}");
    }
    assert_eq!(series(&text, "tcgs_training_steps_per_second"), 0.0, "no job runs any more");
    assert_eq!(series(&text, "tcgs_blobs"), 4.0);
    assert_eq!(series(&text, "tcgs_blob_bytes"), 21.0 + fakes::FILE.len() as f64);
    for (failing, status) in [(Failing::Busy, 503), (Failing::Gone, 500)] {
        server.faults.set(Some(failing));
        while server.get("/metrics").await.status == 200 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        server.get("/metrics").await.expect(status);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn open_event_streams_are_counted() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let events = format!("{job}/events");
    let open = async |count: f64| {
        metrics_until(&server, |text| series(text, "tcgs_event_streams") == count).await;
    };
    let (first, mut second) = (server.stream(&events, None).await, server.stream(&events, None).await);
    assert_eq!(series(&metrics(&server).await, "tcgs_event_streams"), 2.0);
    server.get(&events).await.expect(200);
    assert_eq!(series(&metrics(&server).await, "tcgs_event_streams"), 2.0, "a page is no stream");
    drop(first);
    open(1.0).await;
    server.post(&format!("{job}/cancel")).await.expect(200);
    while second.next().await.is_some() {}
    open(0.0).await;
}

#[tokio::test]
async fn messages_to_webhooks_are_counted_by_what_became_of_them() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let request_body = json!({ "url": "https://example.com/hook", "events": ["job.queued"] });
    server.post_json("/v1/webhook-endpoints", &request_body).await.expect(201);
    for dataset in ["succeed", "succeed 2", "succeed 3"] {
        server.create(dataset).await;
    }
    let error = Some("as the test wants it".to_owned());
    for settled in [
        DeliveryResult { response_status: Some(204), error: None, next: AfterAttempt::Done },
        DeliveryResult { response_status: Some(500), error, next: AfterAttempt::GiveUp },
    ] {
        let due =
            server.store.take_delivery(Duration::from_secs(60)).await.expect("an answer").expect("a message");
        server.store.finish_delivery(due.id, due.attempt, settled).await.expect("settled");
    }
    let text = metrics(&server).await;
    for state in ["pending", "delivered", "failed"] {
        assert_eq!(series(&text, &format!("tcgs_webhook_deliveries{{state=\"{state}\"}}")), 1.0, "{state}");
    }
}

#[tokio::test]
async fn paths_that_clients_invent_make_no_series() {
    let server = Server::start(&Coverage::default()).await;
    let count = |text: &str| text.lines().filter(|line| !line.starts_with('#')).count();
    server.get("/nowhere").await.expect(404);
    server.get("/v1/jobs/17").await.expect(404);
    let before = metrics(&server).await;
    for number in 0..20 {
        server.get(&format!("/nowhere/{number}?and={number}")).await.expect(404);
        server.get(&format!("/v1/jobs/{number}")).await.expect(404);
    }
    let after = metrics(&server).await;
    // The first answer is counted once it has begun, which is one more series of its own.
    let own = "http_request_duration_seconds";
    let of_metrics = after.lines().filter(|line| line.starts_with(own) && line.contains("/metrics")).count();
    assert_eq!(count(&after), count(&before) + of_metrics, "{after}");
    assert!(!after.contains("nowhere"), "{after}");
}

pub(super) async fn metrics_have_a_listener_of_their_own_where_one_is_given(coverage: Coverage) {
    let tune = |config: &mut tcgs::http::HttpConfig| {
        config.metrics_listen = Some("127.0.0.1:0".parse().expect("an address"));
        config.max_connections = 1;
    };
    let server = Server::start_with(&coverage, Setup { tune, ..Setup::default() }).await;
    server.get("/metrics").await.expect_problem(404, "not-found");
    let address = server.metrics_address.expect("an address");
    // The one place of the API is taken by the client's own connection, and scrapers get in all the same.
    let ask = async |path: &str| afresh(&format!("http://{address}{path}")).await;
    let answer = ask("/metrics").await;
    assert_eq!(
        answer.headers()["content-type"],
        "application/openmetrics-text; version=1.0.0; charset=utf-8"
    );
    assert!(answer.text().await.expect("a body").contains("tcgs_jobs{state=\"queued\"} 0"));
    assert_eq!(ask("/healthz").await.status(), 200);
    assert_eq!(ask("/v1/jobs").await.status(), 404, "the API is not there");
}

pub(super) async fn readiness_names_what_is_wrong(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let ok = json!({
        "blobs": "ok", "database": "ok", "draining": "ok", "free_space": "ok", "migrations": "ok",
    });
    assert_eq!(server.get("/readyz").await.expect(200).json()["checks"], ok);
    for (failing, checks) in
        [(Failing::Gone, &["database", "migrations"][..]), (Failing::Busy, &["database", "migrations"])]
    {
        server.faults.set(Some(failing));
        let problem = until_wrong(&server).await;
        assert_eq!(wrong(&problem), checks, "{problem:#}");
        server.faults.set(None);
        server.until_ready().await;
    }
    let database = Database::DataFolder(server.data.path().to_owned());
    let newest = "version = (SELECT max(version) FROM _sqlx_migrations)";
    database.run(&format!("UPDATE _sqlx_migrations SET version = version + 1 WHERE {newest}")).await;
    let problem = until_wrong(&server).await;
    assert_eq!(wrong(&problem), ["migrations"], "{problem:#}");
    database.run(&format!("UPDATE _sqlx_migrations SET version = version - 1 WHERE {newest}")).await;
    server.until_ready().await;
    let before = server.faults.calls("ping");
    futures_util::future::join_all((0..50).map(|_| server.get("/readyz"))).await;
    assert!(
        server.faults.calls("ping") - before < 50,
        "requests at a time wait for one answer of the database"
    );
    // A staging folder that is gone is one that cannot be written, also for root.
    let [staging, gone] = ["staging", "gone"].map(|name| server.data.path().join(name));
    std::fs::rename(&staging, &gone).expect("moved");
    let problem = until_wrong(&server).await;
    assert_eq!(wrong(&problem), ["blobs"], "{problem:#}");
    std::fs::rename(&gone, &staging).expect("moved back");
    server.until_ready().await;
}

/// The names of checks that found something.
fn wrong(problem: &Value) -> Vec<&str> {
    assert_eq!(problem["type"], "urn:tcgs:problem:not-ready");
    let checks = problem["checks"].as_object().expect("checks");
    let wrong: Vec<&str> =
        checks.iter().filter(|(_, found)| **found != "ok").map(|(name, _)| &**name).collect();
    for name in &wrong {
        assert!(problem["detail"].as_str().expect("a detail").contains(&format!("{name}: ")), "{problem:#}");
    }
    wrong
}

/// Asks until what was said last is no longer told again.
async fn until_wrong(server: &Server) -> Value {
    loop {
        let answer = server.get("/readyz").await;
        if answer.status == 503 {
            return answer.json();
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test]
async fn a_disk_with_less_room_than_the_floor_makes_the_service_unready() {
    let tune = |config: &mut tcgs::http::HttpConfig| config.limits.min_free_space = u64::MAX;
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let problem = server.get("/readyz").await.expect(503).json();
    assert_eq!(wrong(&problem), ["free_space"], "{problem:#}");
}

#[tokio::test]
async fn a_database_that_can_be_read_and_not_written_makes_the_service_unready() {
    let server = Server::start(&Coverage::default()).await;
    server.faults.set(Some(Failing::FullForProbes));
    let problem = server.get("/readyz").await.expect(503).json();
    assert_eq!(wrong(&problem), ["database"], "{problem:#}");
    assert_eq!(problem["checks"]["database"], "no room is left on its disk");
}

#[tokio::test]
async fn readiness_fails_before_connections_are_refused() {
    let tune = |config: &mut tcgs::http::HttpConfig| config.drain_notice = Duration::from_secs(3600);
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    server.get("/readyz").await.expect(200);
    server.shutdown.cancel();
    let fresh = afresh(&format!("http://{}/readyz", server.address)).await;
    assert_eq!(fresh.status(), 503);
    let problem: Value = fresh.json().await.expect("a problem");
    assert_eq!(wrong(&problem), ["draining"], "{problem:#}");
    server.get("/v1/jobs").await.expect(200);
}
