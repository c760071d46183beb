//! Jobs of scenes, with priority and deadline: filtered, retried and deleted.

use std::sync::Arc;

use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{
    domain::{DatasetId, DatasetSummary, Layout, ManualClock, Problem, ProblemType, ProjectId},
    store::{NewDataset, Outcome},
};
use uuid::Uuid;

use crate::support::{
    contract::Coverage,
    eventually::{eventually, within},
    fakes::FakeWorkers,
    faults::Failing,
    server::{Server, Setup},
};

/// Keeps a dataset as a scene and returns its id.
async fn scene(server: &Server, dataset: &'static str) -> DatasetId {
    let dataset = server.services.blobs.put(bytes::Bytes::from_static(dataset.as_bytes())).await;
    let new = NewDataset {
        id: DatasetId(Uuid::now_v7()),
        project: ProjectId::DEFAULT,
        name: None,
        dataset: dataset.expect("published"),
        summary: DatasetSummary {
            layout: Layout::Colmap,
            train: 2,
            test: 1,
            pixels: 3,
            points: None,
            notes: Vec::new(),
        },
        upload: None,
        intent: None,
    };
    server.store.create_dataset(new).await.expect("kept").record().id
}

pub(super) async fn a_job_is_made_of_a_scene_by_json(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let scene = scene(&server, "succeed").await;
    let request_body = json!({
        "scene_id": scene, "preset": "standard", "iterations": 7, "seed": 3, "without": ["masks"], "priority": 5,
        "deadline_s": 3600, "rd_curve": [0.004, 0.0005],
    });
    let made = server.post_json("/v1/jobs", &request_body).await.expect(201);
    let job = made.json();
    assert_eq!((&job["scene_id"], &job["priority"]), (&json!(scene), &json!(5)));
    assert_eq!(job["options"]["rd_curve"], json!([0.004, 0.0005]));
    let [made_at, deadline] = ["created_at", "deadline_at"]
        .map(|name| job[name].as_str().expect("an instant").parse::<jiff::Timestamp>().expect("an instant"));
    let seconds = deadline.duration_since(made_at).as_secs_f64();
    assert!((seconds - 3600.0).abs() < 60.0, "{seconds}");
    let done = server.reaches(made.header("location"), "succeeded").await;
    assert_eq!(done["artifacts"].as_array().map(Vec::len), Some(2));

    let other = json!({ "scene_id": Uuid::now_v7() });
    let detail = server.post_json("/v1/jobs", &other).await.expect_problem(404, "scene-not-found");
    assert!(detail.contains(other["scene_id"].as_str().expect("an id")), "{detail}");
    for (fields, kind, named) in [
        (json!({}), "invalid-parameter", "dataset_id"),
        (json!({ "scene_id": "mine" }), "invalid-parameter", "scene_id"),
        (json!({ "scene_id": scene, "priority": 101 }), "invalid-parameter", "priority"),
        (json!({ "scene_id": scene, "deadline_s": 0 }), "invalid-parameter", "deadline_s"),
        (json!({ "scene_id": scene, "seed": "3" }), "invalid-option", "seed"),
        (json!({ "scene_id": scene, "color": "red" }), "invalid-option", "color"),
        (json!({ "scene_id": scene, "max_bytes": 1, "model": "3dgs" }), "invalid-option", "max_bytes"),
        (json!([scene]), "invalid-parameter", "body"),
    ] {
        let detail = server.post_json("/v1/jobs", &fields).await.expect_problem(422, kind);
        assert!(detail.starts_with(named), "{fields}: {detail}");
    }
    let mixed = server.post_json("/v1/jobs?seed=1", &json!({ "scene_id": scene })).await;
    mixed.expect_problem(422, "invalid-parameter");
    for (query, named) in
        [("?priority=high", "priority"), ("?priority=-101", "priority"), ("?deadline_s=-1", "deadline_s")]
    {
        let detail = server.upload(query, "succeed").await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
    let broken = server
        .send("POST", "/v1/jobs", |request| request.header("content-type", "application/json").body("{\"sc"));
    broken.await.expect_problem(400, "malformed-json");

    let keyed = |request_body: &Value| {
        let (server, request_body) = (&server, request_body.clone());
        async move {
            let fill =
                |request: reqwest::RequestBuilder| request.json(&request_body).header("idempotency-key", "k");
            server.send("POST", "/v1/jobs", fill).await
        }
    };
    let request_body = json!({ "scene_id": scene });
    let [first, again] = [keyed(&request_body).await.expect(201), keyed(&request_body).await.expect(201)];
    assert_eq!(first.header("location"), again.header("location"));
    keyed(&json!({ "scene_id": scene, "seed": 1 })).await.expect_problem(422, "idempotency-key-reused");
    server.reaches(first.header("location"), "succeeded").await;
    server.send("DELETE", first.header("location"), |request| request).await.expect(204);
    let detail = keyed(&request_body).await.expect_problem(404, "job-not-found");
    assert!(detail.contains("fresh key"), "{detail}");
}

pub(super) async fn jobs_are_listed_by_state_scene_and_model(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let scene = scene(&server, "succeed").await;
    let made = |answer: crate::support::server::Answer| answer.expect(201).json()["id"].clone();
    let of_scene = made(server.post_json("/v1/jobs", &json!({ "scene_id": scene })).await);
    let baseline = made(server.upload("?model=3dgs", "succeed as a baseline").await);
    let cancelled = made(server.upload("", "succeed later").await);
    let path = format!("/v1/jobs/{}/cancel", cancelled.as_str().expect("an id"));
    server.post(&path).await.expect(200);
    let ids = |page: &Value| -> Vec<Value> {
        page["jobs"].as_array().expect("jobs").iter().map(|job| job["id"].clone()).collect()
    };
    for (query, expected) in [
        ("?state=cancelled".to_owned(), vec![&cancelled]),
        ("?state=queued".to_owned(), vec![&baseline, &of_scene]),
        ("?state=running,cancelled".to_owned(), vec![&cancelled]),
        ("?state=succeeded".to_owned(), vec![]),
        (format!("?scene_id={scene}"), vec![&of_scene]),
        (format!("?scene_id={scene}&state=failed"), vec![]),
        ("?model=3dgs".to_owned(), vec![&baseline]),
    ] {
        let page = server.get(&format!("/v1/jobs{query}")).await.expect(200);
        assert!(!page.headers.contains_key("link"));
        assert_eq!(ids(&page.json()).iter().collect::<Vec<_>>(), expected, "{query}");
    }
    let first = server.get("/v1/jobs?state=queued,running&limit=1").await.expect(200);
    let next = first.json()["next"].as_str().expect("a path").to_owned();
    assert_eq!(first.header("link"), format!("<{next}>; rel=\"next\""));
    let second = server.get(&next).await.expect(200).json();
    assert_eq!((ids(&second), &second["next"]), (vec![of_scene], &Value::Null), "the filter stays");
    for (query, named) in
        [("?state=done", "state"), ("?state=", "state"), ("?scene_id=1", "scene_id"), ("?model=x", "model")]
    {
        let detail = server.get(&format!("/v1/jobs{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_filter_of_a_list_is_in_the_path_of_its_next_page() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let scene = scene(&server, "succeed").await;
    let body = json!({ "scene_id": scene, "name": "a&b", "metadata": { "site": "north" }, "model": "3dgs" });
    for _ in 0..2 {
        server.post_json("/v1/jobs", &body).await.expect(201);
    }
    let filters = [
        ("project_id", ProjectId::DEFAULT.to_string()),
        ("state", "queued,running".to_owned()),
        ("scene_id", scene.to_string()),
        ("model", "3dgs".to_owned()),
        ("name", "a&b".to_owned()),
        ("created_from", "2000-01-01T00:00:00Z".to_owned()),
        ("created_before", "2100-01-01T00:00:00Z".to_owned()),
        ("metadata[site]", "north".to_owned()),
    ];
    let query = serde_urlencoded::to_string(&filters).expect("a query");
    let page = server.get(&format!("/v1/jobs?{query}&limit=1")).await.expect(200).json();
    let next = page["next"].as_str().expect("a second page").to_owned();
    let pairs: Vec<(String, String)> =
        serde_urlencoded::from_str(next.split_once('?').expect("a query").1).expect("pairs");
    for (name, value) in filters {
        assert!(pairs.contains(&(name.to_owned(), value)), "{name} is not in {next}");
    }
    let second = server.get(&next).await.expect(200).json();
    assert_eq!((second["jobs"].as_array().map(Vec::len), &second["next"]), (Some(1), &Value::Null));
    // A filter that was not given is not in it either.
    let page = server.get("/v1/jobs?limit=1").await.expect(200).json();
    assert!(page["next"].as_str().expect("a second page").starts_with("/v1/jobs?limit=1&cursor="), "{page}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_retry_resumes_from_the_checkpoint_unless_it_is_told_not_to() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let mut path = server.create("succeed").await;
    for (body, resumes) in [
        (json!({}), true),
        (json!({ "from_checkpoint": false }), false),
        (json!({ "from_checkpoint": true }), true),
        (json!({ "from_checkpoint": null }), true),
    ] {
        let lease = server.store.claim("test").await.expect("an answer").expect("a job").lease;
        let lost = Problem::new(ProblemType::DeviceLost, "as the test wants it");
        server.store.finish(&lease, Outcome::Failed(lost)).await.expect("ended");
        let again = server.post_json(&format!("{path}/retry"), &body).await.expect(201);
        path = again.header("location").to_owned();
        let claim = server.store.claim("test").await.expect("an answer").expect("the retry");
        assert_eq!(claim.resume_from, resumes.then_some(lease.job), "{body}");
        server.store.finish(&claim.lease, Outcome::Released).await.expect("ended");
    }
}

pub(super) async fn a_job_is_given_up_at_its_deadline_begun_or_not(coverage: Coverage) {
    let idle = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let never = idle.upload("?deadline_s=1", "succeed").await.expect(201);
    let failed = idle.reaches(never.header("location"), "failed").await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:deadline-exceeded");
    assert!(failed["error"]["detail"].as_str().expect("a detail").contains("never started"), "{failed:#}");
    assert_eq!(failed["attempt"], 0);

    let server = Server::start(&coverage).await;
    let begun = server.upload("?deadline_s=1", "wait").await.expect(201);
    let failed = server.reaches(begun.header("location"), "failed").await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:deadline-exceeded");
    assert_eq!(failed["attempt"], 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_taken_from_a_silent_worker_though_no_other_looks_for_it() {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let setup = Setup { worker: false, clock: clock.clone(), ..Setup::default() };
    let server = Server::start_with(&Coverage::default(), setup).await;
    let job = server.create("succeed").await;
    server.store.claim("silent").await.expect("an answer").expect("the job");
    eventually("the attempt is lost", async || {
        clock.advance(SignedDuration::from_secs(60));
        let now = server.get(&job).await.expect(200).json();
        now["state"] == "queued" && now["attempts"][0]["outcome"] == "lost"
    })
    .await;
}

pub(super) async fn a_failed_or_cancelled_job_is_retried_as_a_new_one(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let failed = server
        .upload("?seed=9&priority=3&deadline_s=600&name=statue&metadata[site]=hall", "fail")
        .await
        .expect(201);
    let path = failed.header("location").to_owned();
    server.reaches(&path, "failed").await;
    let retry = format!("{path}/retry");
    let again = server.post(&retry).await.expect(201);
    let new = again.json();
    assert_eq!(new["retry_of"], failed.json()["id"]);
    assert_eq!((&new["options"]["seed"], &new["priority"]), (&json!(9), &json!(3)));
    assert_eq!(new["deadline_at"], Value::Null, "time begins anew");
    assert_eq!(new["dataset"], failed.json()["dataset"]);
    assert_eq!((&new["name"], &new["metadata"]), (&json!("statue"), &json!({ "site": "hall" })));
    server.reaches(again.header("location"), "failed").await;

    let request_body = json!({ "from_checkpoint": false, "deadline_s": 600 });
    let keyed = || {
        server.send("POST", &retry, |request| {
            request.json(&request_body).header("idempotency-key", "k").header("prefer", "wait=60")
        })
    };
    let third = keyed().await.expect(201);
    assert_eq!(third.json()["state"], "failed", "the answer waits if it may");
    assert!(third.json()["deadline_at"].is_string());
    let same = keyed().await.expect(201);
    assert_eq!(same.header("idempotency-replayed"), "true");
    assert_eq!(same.header("location"), third.header("location"));
    let other = server.send("POST", &retry, |request| request.header("idempotency-key", "k")).await;
    other.expect_problem(422, "idempotency-key-reused");

    server.send("DELETE", &path, |request| request).await.expect(204);
    let after = keyed().await.expect(201);
    assert_eq!(
        after.header("idempotency-replayed"),
        "true",
        "the retried job is deleted, its repetition is not"
    );
    assert_eq!(after.header("location"), third.header("location"));
    server.post(&retry).await.expect_problem(404, "job-not-found");
    let path = third.header("location").to_owned();
    let retry = format!("{path}/retry");

    let done = server.succeeded().await;
    let detail = server.post(&format!("{done}/retry")).await.expect_problem(409, "job-not-retryable");
    assert!(detail.contains("succeeded"), "{detail}");
    server.post("/v1/jobs/17/retry").await.expect_problem(404, "job-not-found");
    for (fields, named) in [
        (json!({ "deadline_s": 0 }), "deadline_s"),
        (json!({ "from_checkpoint": "yes" }), "body"),
        (json!({ "from_checkpoint": true, "seed": 1 }), "from_checkpoint"),
        (json!({ "name": "" }), "name"),
        (json!({ "metadata": { "": "x" } }), "metadata"),
    ] {
        let detail = server.post_json(&retry, &fields).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
    server.send("POST", &retry, |request| request.body("{}")).await.expect(415);
    let typed = |body: String| {
        server.send("POST", &retry, |request| request.header("content-type", "application/json").body(body))
    };
    typed(String::new()).await.expect(201);
    typed("{\"from".into()).await.expect_problem(400, "malformed-json");
    typed(" ".repeat(2 << 20)).await.expect_problem(413, "body-too-large");
    for (failing, status) in [(Failing::Busy, 503), (Failing::Gone, 500)] {
        server.faults.set(Some(failing));
        server.post(&retry).await.expect(status);
        server.send("DELETE", &path, |request| request).await.expect(status);
        server.faults.set(None);
    }
}

pub(super) async fn a_job_is_repeated_with_other_options(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let first =
        server.upload("?seed=9&lambda=0.004&priority=3&name=statue&metadata[site]=hall", "succeed").await;
    let first = first.expect(201);
    let path = first.header("location").to_owned();
    server.reaches(&path, "succeeded").await;
    let retry = format!("{path}/retry");
    for same in [json!({}), json!({ "lambda": 0.004, "seed": 9 }), json!({ "name": "other" })] {
        let detail = server.post_json(&retry, &same).await.expect_problem(409, "job-not-retryable");
        assert!(detail.contains("only with other options"), "{detail}");
    }
    let again =
        server.post_json(&retry, &json!({ "lambda": 0.002, "from_checkpoint": false })).await.expect(201);
    let new = again.json();
    let before = first.json();
    assert_eq!((&new["options"]["lambda"], &new["options"]["seed"]), (&json!(0.002), &json!(9)));
    for kept in ["dataset", "dataset_id", "priority", "name", "metadata", "project_id"] {
        assert_eq!(new[kept], before[kept], "{kept}");
    }
    assert_eq!(new["retry_of"], before["id"]);
    server.reaches(again.header("location"), "succeeded").await;

    let renamed = json!({ "lambda": null, "iterations": 7, "name": null, "metadata": { "try": "3" } });
    let third = server.post_json(&retry, &renamed).await.expect(201).json();
    assert_eq!((&third["options"]["lambda"], &third["options"]["iterations"]), (&Value::Null, &json!(7)));
    assert_eq!((&third["name"], &third["metadata"]), (&Value::Null, &json!({ "try": "3" })));
    for (fields, named) in [
        (json!({ "color": "red" }), "color"),
        (json!({ "model": "3dgs" }), "lambda"),
        (json!({ "iterations": 0 }), "iterations"),
    ] {
        let detail = server.post_json(&retry, &fields).await.expect_problem(422, "invalid-option");
        assert!(detail.contains(named), "{fields}: {detail}");
    }

    let idle = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let queued = idle.create("succeed").await;
    let detail = idle.post_json(&format!("{queued}/retry"), &json!({ "seed": 1 })).await;
    let detail = detail.expect_problem(409, "job-not-retryable");
    assert!(detail.contains("queued"), "{detail}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_checkpoint_of_other_options_is_not_resumed() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let path = server.create("succeed").await;
    let lease = server.store.claim("test").await.expect("an answer").expect("a job").lease;
    let lost = Problem::new(ProblemType::DeviceLost, "as the test wants it");
    server.store.finish(&lease, Outcome::Failed(lost)).await.expect("ended");
    for (body, resumes) in [(json!({ "seed": 5 }), false), (json!({ "seed": 0, "name": "again" }), true)] {
        server.post_json(&format!("{path}/retry"), &body).await.expect(201);
        let claim = server.store.claim("test").await.expect("an answer").expect("the retry");
        assert_eq!(claim.resume_from, resumes.then_some(lease.job), "{body}");
        let lost = Problem::new(ProblemType::DeviceLost, "as the test wants it");
        server.store.finish(&claim.lease, Outcome::Failed(lost)).await.expect("ended");
    }
}

pub(super) async fn the_name_and_labels_of_a_job_are_changed(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let made = server.upload("?name=statue&metadata[site]=hall&metadata[run]=1", "succeed").await.expect(201);
    let path = made.header("location").to_owned();
    let patch = |body: Value, tag: Option<String>| {
        server.send("PATCH", &path, move |request| {
            let request = request.json(&body);
            tag.into_iter().fold(request, |request, tag| request.header("if-match", tag))
        })
    };
    let tag = made.header("etag").to_owned();
    let changed = patch(json!({ "name": "garden" }), Some(tag.clone())).await.expect(200);
    assert_ne!(changed.header("etag"), tag);
    let mut expected = made.json();
    expected["name"] = json!("garden");
    assert_eq!(changed.json(), expected, "all else stays");
    let detail = patch(json!({ "name": "late" }), Some(tag)).await.expect_problem(412, "precondition-failed");
    assert!(detail.contains("has changed"), "{detail}");
    let tagged = patch(json!({ "metadata": { "site": "north" } }), None).await.expect(200).json();
    assert_eq!((&tagged["name"], &tagged["metadata"]), (&json!("garden"), &json!({ "site": "north" })));
    let current = server.get(&path).await.expect(200);
    let same = patch(json!({ "name": "garden" }), None).await.expect(200);
    assert_eq!(same.header("etag"), current.header("etag"), "nothing changed");
    let found = server.get("/v1/jobs?metadata[site]=north&name=garden").await.expect(200).json();
    assert_eq!(found["jobs"], json!([current.json()]));
    let bare = patch(json!({ "name": null, "metadata": null }), None).await.expect(200).json();
    assert_eq!((&bare["name"], &bare["metadata"]), (&Value::Null, &json!({})));
    for (body, named) in [
        (json!({ "name": "" }), "name"),
        (json!({ "metadata": { "a": 1 } }), "body"),
        (json!({ "metadata": { "": "x" } }), "metadata"),
        (json!({ "state": "succeeded" }), "body"),
        (json!([]), "body"),
    ] {
        let detail = patch(body.clone(), None).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{body}: {detail}");
    }
    let raw = |media_type: &'static str, body: String| {
        server.send("PATCH", &path, move |request| request.header("content-type", media_type).body(body))
    };
    raw("application/json", "{\"na".into()).await.expect_problem(400, "malformed-json");
    raw("text/plain", "{}".into()).await.expect_problem(415, "unsupported-media-type");
    raw("application/json", " ".repeat(2 << 20)).await.expect_problem(413, "body-too-large");
}

pub(super) async fn a_client_names_the_fields_that_it_wants(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let path = server.succeeded().await;
    let whole = server.get(&path).await.expect(200).json();
    for (name, value) in whole.as_object().expect("an object") {
        let part = server.get(&format!("{path}?fields={name}")).await.expect(200).json();
        assert_eq!(part, json!({ name: value }));
    }
    let part = server.get(&format!("{path}?fields=id,metrics.test.psnr,progress.step")).await.expect(200);
    let psnr = &whole["metrics"]["test"]["psnr"];
    let expected = json!({
        "id": whole["id"], "metrics": { "test": { "psnr": psnr } }, "progress": { "step": whole["progress"]["step"] },
    });
    assert_eq!(part.json(), expected);
    server.succeeded().await;
    let page = server.get("/v1/jobs?fields=id,state&limit=1").await.expect(200).json();
    let names: Vec<_> = page["jobs"][0].as_object().expect("an object").keys().collect();
    assert_eq!(names, ["id", "state"]);
    let next = page["next"].as_str().expect("a second page");
    let second = server.get(next).await.expect(200).json();
    assert_eq!(second["jobs"], json!([{ "id": whole["id"], "state": "succeeded" }]), "{next}");
    for path in [&path, "/v1/jobs"] {
        for (query, named) in [("fields=id,size", "size"), ("fields=", "fields"), ("color=red", "color")] {
            let detail = server.get(&format!("{path}?{query}")).await;
            let detail = detail.expect_problem(422, "invalid-parameter");
            assert!(detail.contains(named), "{detail}");
        }
    }
}

pub(super) async fn a_job_that_has_ended_is_deleted_with_its_files(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let tag = server.get(&job).await.expect(200).header("etag").to_owned();
    let delete = |path: String, tag: Option<String>| {
        let server = &server;
        async move {
            let fill = |request: reqwest::RequestBuilder| match tag {
                Some(tag) => request.header("if-match", tag),
                None => request,
            };
            server.send("DELETE", &path, fill).await
        }
    };
    delete(job.clone(), Some("\"0\"".into())).await.expect_problem(412, "precondition-failed");
    delete(job.clone(), Some(format!("\"0\", {tag}"))).await.expect(204);
    let requested = server.services.blobs.collection_requested();
    within("its files are collected at once", requested).await;
    for part in ["", "/events", "/artifact", "/view?frame=test/r_0"] {
        server.get(&format!("{job}{part}")).await.expect_problem(404, "job-not-found");
    }
    delete(job, None).await.expect_problem(404, "job-not-found");

    let running = server.create("gate").await;
    server.runner.gate.someone_waits().await;
    let detail = delete(running.clone(), None).await.expect_problem(409, "job-active");
    assert!(detail.contains("running"), "{detail}");
    server.runner.gate.open();
    server.reaches(&running, "succeeded").await;
    delete(running, Some("*".into())).await.expect(204);

    let failed = server.create("fail").await;
    server.reaches(&failed, "failed").await;
    let retry = server.post(&format!("{failed}/retry")).await.expect(201).header("location").to_owned();
    let before = server.reaches(&retry, "failed").await;
    assert!(before["retry_of"].is_string());
    let tag = server.get(&retry).await.expect(200).header("etag").to_owned();
    delete(failed, None).await.expect(204);
    let after = server.get(&retry).await.expect(200);
    assert_eq!(after.json()["retry_of"], Value::Null);
    assert_ne!(after.header("etag"), tag, "what is shown has changed");

    // The same over a server that tells what it was asked to forget.
    let workers = Arc::new(FakeWorkers::default());
    let state = {
        let services = tcgs::http::Services { workers: workers.clone(), ..server.services.clone() };
        tcgs::http::AppState::new(services, Setup::default().limits, server.shutdown.clone())
    };
    use tower::ServiceExt as _;
    let request = axum::http::Request::delete(&retry).header("host", "localhost");
    let request = request.body(axum::body::Body::empty()).expect("a request");
    let answer = tcgs::http::router(state).oneshot(request).await.expect("an answer");
    assert_eq!(answer.status(), 204);
    let forgotten: Vec<String> =
        workers.forgotten.lock().expect("not poisoned").iter().map(|job| format!("/v1/jobs/{job}")).collect();
    assert_eq!(forgotten, [retry]);
}
