//! Jobs: created from a dataset, listed, followed and cancelled.

use serde_json::{Value, json};

use super::connections::tight_limits;
use crate::support::{
    contract::Coverage,
    fakes,
    server::{Server, Setup},
};

pub(super) async fn a_dataset_becomes_a_file_with_metrics_and_history(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let created = server.upload("?preset=standard&iterations=7&seed=3&background=white", "succeed").await;
    let job = created.expect(201);
    let path = job.header("location").to_owned();
    let body = job.json();
    assert_eq!((&body["state"], &body["attempt"]), (&json!("queued"), &json!(0)));
    assert_eq!(body["options"]["iterations"], 7);
    assert_eq!(body["links"]["self"], path);
    let done = server.reaches(&path, "succeeded").await;
    assert_eq!(done["phase"], "done");
    assert_eq!(done["attempt"], 1);
    assert_eq!(done["progress"]["step"], 7, "the last report must not be lost: {done:#}");
    assert_eq!(done["metrics"], serde_json::to_value(fakes::metrics()).expect("JSON"));
    let artifact = &done["artifacts"][0];
    assert_eq!(done["artifacts"].as_array().map(Vec::len), Some(1), "the cameras are not for clients");
    assert_eq!(artifact["kind"], "tcgs");
    assert_eq!(artifact["bytes"], fakes::FILE.len());
    let file = server.get(artifact["href"].as_str().expect("a path")).await.expect(200);
    assert_eq!(file.body, fakes::FILE);
    for (name, link) in done["links"].as_object().expect("links") {
        // What takes another method or a parameter says so; every address is one.
        let status = server.get(link.as_str().expect("a path")).await.status;
        let is_action = ["cancel", "retry", "views"].contains(&&**name);
        assert_eq!((status == 405, status == 404), (is_action, false), "{name}: {status}");
    }

    let mut next = format!("{path}/events?limit=2");
    let mut events = Vec::new();
    loop {
        let page = server.get(&next).await.expect(200).json();
        let part = page["events"].as_array().expect("events").clone();
        if part.is_empty() {
            break;
        }
        assert!(part.len() <= 2);
        events.extend(part);
        next = page["next"].as_str().expect("a path").to_owned();
    }
    let numbers: Vec<u64> = events.iter().map(|event| event["seq"].as_u64().expect("a number")).collect();
    assert_eq!(numbers, (1..=events.len() as u64).collect::<Vec<_>>());
    let states: Vec<&Value> =
        events.iter().filter(|event| event["kind"] == "state").map(|event| &event["data"]["state"]).collect();
    assert_eq!(states, ["queued", "running", "succeeded"]);
    assert!(events.iter().any(|event| event["data"]["phase"] == "publish"), "{events:#?}");

    let baseline = server.upload("?model=scaffold", "succeed baseline").await.expect(201);
    let path = baseline.header("location").to_owned();
    let artifact = server.reaches(&path, "succeeded").await["artifacts"][0].clone();
    assert_eq!(artifact["kind"], "safetensors");
    let file = server.get(artifact["href"].as_str().expect("a path")).await.expect(200);
    assert_eq!(file.header("content-type"), "application/octet-stream");
    assert!(file.header("content-disposition").ends_with(".safetensors\""), "{:?}", file.headers);
    server.get(&format!("{path}/view?frame=test/r_0")).await.expect(200);

    let failed = server.create("fail").await;
    let failed = server.reaches(&failed, "failed").await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:worker-panicked");
    assert_eq!(failed["artifacts"], json!([]));
    let history = server.get(failed["links"]["events"].as_str().expect("a path")).await.expect(200).json();
    let last = history["events"].as_array().and_then(|events| events.last()).expect("an event").clone();
    assert_eq!(last["data"]["error"], failed["error"]);
}

pub(super) async fn what_is_wrong_with_a_dataset_or_an_option_is_said_before_a_job_is_made(
    coverage: Coverage,
) {
    let server = Server::start(&coverage).await;
    let bad = server.upload("", "bad zip").await.expect(422).json();
    assert_eq!(bad["file"], "transforms.json");
    assert!(bad["detail"].as_str().expect("a detail").contains("focal length"));

    for (query, named) in [
        ("?preset=fast", "preset"),
        ("?iterations=0", "iterations"),
        ("?iterations=many", "iterations"),
        ("?color=red", "color"),
        ("?model=nerf", "model"),
        ("?until=converged", "iterations"),
        ("?max_bytes=0", "max_bytes"),
        ("?max_bytes=10", "max_bytes"),
        ("?max_bytes=800", "max_bytes"),
        ("?max_bytes=1000&preset=standard", "max_bytes"),
        ("?max_bytes=1000&model=scaffold", "max_bytes"),
        ("?max_bytes=1000&rd_curve=0.001", "max_bytes"),
        ("?target_gaussians=1000", "target_gaussians"),
        ("?model=3dgs&target_gaussians=1000&max_gaussians=10", "target_gaussians"),
        ("?model=scaffold&max_gaussians=10", "max_gaussians"),
        ("?rd_curve=", "rd_curve"),
        ("?rd_curve=0.001,0.001", "rd_curve"),
        ("?rd_curve=0.001,-1", "rd_curve"),
        ("?rd_curve=1,2,3,4,5,6,7,8,9", "rd_curve"),
        ("?rd_curve=0.001&model=3dgs", "rd_curve"),
        ("?rd_curve=0.001&lambda=0.1", "rd_curve"),
    ] {
        let detail = server.upload(query, "succeed").await.expect_problem(422, "invalid-option");
        assert!(detail.contains(named), "{query}: {detail}");
    }
    let twice = server.upload("?seed=1&seed=2", "succeed").await.expect_problem(422, "invalid-parameter");
    assert!(twice.contains("seed"), "{twice}");

    for content_type in ["application/xml", "text/plain"] {
        let wrong = server
            .send("POST", "/v1/jobs", |request| request.header("content-type", content_type).body("{}"));
        let detail = wrong.await.expect_problem(415, "unsupported-media-type");
        assert!(detail.contains("application/zip"), "{detail}");
    }
    server.post("/v1/jobs").await.expect_problem(415, "unsupported-media-type");
    assert_eq!(server.get("/v1/jobs").await.expect(200).json()["jobs"], json!([]), "none of these is a job");

    let tight = Setup { limits: tight_limits(), ..Setup::default() };
    let server = Server::start_with(&coverage, tight).await;
    let announced = server.upload("", "succeed but too long").await;
    assert!(announced.expect_problem(413, "body-too-large").contains("10 bytes"));
    let streamed = server.send("POST", "/v1/jobs", |request| {
        let pieces = ["succeed ", "but too ", "long"].map(Ok::<_, std::io::Error>);
        let body = reqwest::Body::wrap_stream(futures_util::stream::iter(pieces));
        request.header("content-type", "application/zip").body(body)
    });
    assert!(streamed.await.expect_problem(413, "body-too-large").contains("10 bytes"));
    server.upload("", "succeed ok").await.expect(201);
}

pub(super) async fn jobs_are_listed_newest_first_page_by_page(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let mut made = Vec::new();
    for index in 0..5 {
        made.push(server.create(&format!("succeed {index}")).await);
    }
    made.reverse();
    let mut next = Some("/v1/jobs?limit=2".to_owned());
    let (mut listed, mut pages) = (Vec::new(), 0);
    while let Some(path) = next {
        let page = server.get(&path).await.expect(200).json();
        listed.extend(page["jobs"].as_array().expect("jobs").iter().map(|job| job["links"]["self"].clone()));
        next = page["next"].as_str().map(str::to_owned);
        pages += 1;
    }
    assert_eq!((listed, pages), (made.into_iter().map(Value::from).collect(), 3));
    for (query, named) in [
        ("?limit=0", "limit"),
        ("?limit=101", "limit"),
        ("?cursor=abc", "cursor"),
        ("?cursor=9223372036854775807.x", "cursor"),
        ("?page=2", "page"),
    ] {
        let detail = server.get(&format!("/v1/jobs{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

pub(super) async fn a_queued_job_is_cancelled_at_once_and_a_running_one_soon(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let queued = server.create("succeed").await;
    let cancelled = server.post(&format!("{queued}/cancel")).await.expect(200).json();
    assert_eq!((&cancelled["state"], &cancelled["attempt"]), (&json!("cancelled"), &json!(0)));
    let asked = server.post(&format!("{running}/cancel")).await.expect(202).json();
    assert_eq!(asked["cancel_requested"], true);
    server.reaches(&running, "cancelled").await;
    for job in [&queued, &running] {
        server.post(&format!("{job}/cancel")).await.expect(200);
    }
    let done = server.succeeded().await;
    let late = server.post(&format!("{done}/cancel")).await.expect_problem(409, "job-finished");
    assert!(late.contains("succeeded"), "{late}");
}

pub(super) async fn too_many_uploads_at_once_are_put_off(coverage: Coverage) {
    let limits = tcgs::http::config::RequestLimits { uploads: 0, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let detail = server.upload("", "succeed").await.expect_problem(503, "busy");
    assert!(detail.starts_with("too many datasets are being received"), "{detail}");
}
