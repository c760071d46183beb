//! The service itself: version, request ids, unknown paths and internal errors.

use serde_json::json;
use tower::ServiceExt as _;

use crate::support::{
    contract::Coverage,
    eventually::eventually,
    faults::Failing,
    server::{Answer, Server},
};

pub(super) async fn the_service_describes_itself(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    assert_eq!(server.get("/healthz").await.expect(200).json(), json!({ "status": "ok" }));
    let ready = server.get("/readyz").await.expect(200).json();
    assert_eq!(ready["workers"], json!({ "expected": 1, "alive": 1 }));
    assert_eq!(server.get("/version").await.expect(200).json()["version"], env!("CARGO_PKG_VERSION"));
    let contract = server.get("/openapi.yaml").await.expect(200).body;
    let file = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml")).expect("readable");
    assert_eq!(contract, file);
    let as_json = server.get("/openapi.json").await.expect(200).json();
    let as_yaml: serde_json::Value = yaml_serde::from_slice(&file).expect("YAML");
    assert_eq!(as_json, as_yaml);
}

pub(super) async fn unknown_jobs_frames_paths_and_methods_are_problems(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let done = server.succeeded().await;
    let absent = "/v1/jobs/0190a5d8-0000-7000-8000-000000000000";
    for job in [absent, "/v1/jobs/17", "/v1/jobs/..%2F..%2Fetc%2Fpasswd", "/v1/jobs/%00"] {
        server.get(job).await.expect_problem(404, "job-not-found");
        server.post(&format!("{job}/cancel")).await.expect_problem(404, "job-not-found");
        for part in ["events", "series", "artifact", "report", "view?frame=test/r_0"] {
            server.get(&format!("{job}/{part}")).await.expect_problem(404, "job-not-found");
        }
        let views = json!({ "views": [{ "frame": "test/r_0" }] });
        server.post_json(&format!("{job}/views"), &views).await.expect_problem(404, "job-not-found");
    }
    for frame in ["test/r_9", "", "..", &"x".repeat(3000)] {
        let detail =
            server.get(&format!("{done}/view?frame={frame}")).await.expect_problem(404, "frame-not-found");
        assert!(detail.contains("3 frames") && detail.len() < 500, "{detail}");
    }
    for path in ["/", "/v2/jobs", "/v1", "/v1/jobs/", "/v1/jobs/a/b/c"] {
        server.get(path).await.expect_problem(404, "not-found");
    }
    for (method, path, allow) in [
        ("DELETE", "/v1/jobs", "GET,HEAD,POST"),
        ("PUT", &done, "GET,HEAD,PATCH,DELETE"),
        ("GET", &format!("{done}/cancel"), "POST"),
    ] {
        let answer = server.send(method, path, |request| request).await.expect(405);
        assert_eq!(answer.header("allow"), allow);
    }
    let events = format!("{done}/events");
    let picture = server.send("GET", &events, |request| request.header("accept", "image/png"));
    picture.await.expect_problem(406, "not-acceptable");
    for (query, named) in
        [("?after=x", "after"), ("?limit=0", "limit"), ("?limit=1001", "limit"), ("?since=1", "since")]
    {
        let detail =
            server.get(&format!("{done}/events{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

pub(super) async fn a_database_that_fails_is_a_problem_not_a_crash(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    let tus = |request: reqwest::RequestBuilder| {
        request
            .header("tus-resumable", "1.0.0")
            .header("upload-length", 9)
            .header("upload-offset", 0)
            .header("content-type", "application/offset+octet-stream")
    };
    let upload = server.send("POST", "/v1/uploads", |request| {
        request.header("tus-resumable", "1.0.0").header("upload-length", 9)
    });
    let upload = upload.await.expect(201).header("location").to_owned();
    let scene = super::scenes::keep(&server, "", "succeed").await.expect(201).header("location").to_owned();
    let endpoints = "/v1/webhook-endpoints";
    let endpoint = format!("{endpoints}/0190a5d8-0000-7000-8000-000000000000");
    for (failing, status, kind) in [(Failing::Busy, 503, "busy"), (Failing::Gone, 500, "internal")] {
        server.faults.set(Some(failing));
        let answers: Vec<Answer> = vec![
            server.upload("", "succeed").await,
            server.get("/v1/jobs").await,
            server.get(&job).await,
            server.post(&format!("{job}/cancel")).await,
            server.get(&format!("{job}/events")).await,
            server.get(&format!("{job}/series")).await,
            server.get(&format!("{job}/artifact")).await,
            server.get(&format!("{job}/report")).await,
            server.get(&format!("{job}/view?frame=test/r_0")).await,
            server.post_json(&format!("{job}/views"), &views).await,
            super::scenes::keep(&server, "", "succeed").await,
            server.get("/v1/scenes").await,
            server.get(&scene).await,
            server.send("DELETE", &scene, |request| request).await,
            server.send("OPTIONS", "/v1/uploads", |request| request).await,
            server.send("POST", "/v1/uploads", tus).await,
            server.send("PATCH", &upload, tus).await,
            server.send("DELETE", &upload, tus).await,
            server.post_json(endpoints, &json!({ "url": "https://example.com/" })).await,
            server.get(endpoints).await,
            server.get(&endpoint).await,
            server.send("DELETE", &endpoint, |request| request).await,
            server.get(&format!("{endpoint}/deliveries")).await,
            server.post(&format!("{endpoint}/deliveries/17/replay")).await,
        ];
        server.send("HEAD", &upload, tus).await.expect(status);
        for answer in answers {
            let detail = answer.expect_problem(status, kind);
            assert!(!detail.to_lowercase().contains("pool"), "what is inside stays inside: {detail}");
        }
        eventually("it is not ready", async || server.get("/readyz").await.status == 503).await;
        server.get("/readyz").await.expect_problem(503, "not-ready");
        server.get("/healthz").await.expect(200);
        server.faults.set(None);
        server.until_ready().await;
    }
}

pub(super) async fn a_handler_that_panics_answers_500_and_the_server_lives(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    server.upload("", "bomb").await.expect_problem(500, "internal");
    server.succeeded().await;
}

#[tokio::test]
async fn request_ids_are_kept_if_fit_and_made_if_not() {
    let server = Server::start(&Coverage::default()).await;
    let given =
        server.send("GET", "/v1/jobs/17", |request| request.header("x-request-id", "my-id_1.2")).await;
    assert_eq!(given.header("x-request-id"), "my-id_1.2");
    assert_eq!(given.json()["instance"], "my-id_1.2");
    assert_eq!(given.header("cache-control"), "no-store", "the next problem has another id");
    let longest = "x".repeat(128);
    let kept = server.send("GET", "/healthz", |request| request.header("x-request-id", &longest)).await;
    assert_eq!(kept.header("x-request-id"), longest);
    for unfit in ["", "two words", "<script>", &"x".repeat(129)] {
        let answer = server.send("GET", "/healthz", |request| request.header("x-request-id", unfit)).await;
        assert_eq!(answer.header("x-request-id").len(), 36, "a fresh UUID instead of '{unfit}'");
    }
}

#[tokio::test]
async fn a_server_that_drains_is_not_ready() {
    let server = Server::start(&Coverage::default()).await;
    let draining = tokio_util::sync::CancellationToken::new();
    draining.cancel();
    let state = tcgs::http::AppState::new(server.services.clone(), Default::default(), draining);
    let request = axum::http::Request::get("/readyz").header("host", "localhost");
    let request = request.body(axum::body::Body::empty()).expect("a request");
    let answer = tcgs::http::router(state).oneshot(request).await.expect("an answer");
    assert_eq!(answer.status(), 503);
}
