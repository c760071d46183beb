//! Scenes: created, deduplicated, listed and deleted.

use serde_json::{Value, json};
use tcgs::{
    domain::{Digest, JobId, ProjectLimits, Scope, TrainOptions},
    store::NewJob,
};
use uuid::Uuid;

use super::{
    connections::tight_limits,
    uploads::{begin, part},
};
use crate::support::{
    contract::Coverage,
    eventually::within,
    server::{Answer, Server, Setup},
};

pub(super) async fn keep(server: &Server, query: &str, dataset: &str) -> Answer {
    server
        .send("POST", &format!("/v1/scenes{query}"), |request| {
            request.header("content-type", "application/zip").body(dataset.to_owned())
        })
        .await
}

fn idle() -> Setup {
    Setup { worker: false, ..Setup::default() }
}

pub(super) async fn a_dataset_is_kept_once_and_found_again(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let made = keep(&server, "?name=Garden", "succeed").await.expect(201);
    let path = made.header("location").to_owned();
    let body = made.json();
    assert_eq!(body["links"]["self"], path);
    assert_eq!((&body["name"], &body["state"]), (&json!("Garden"), &json!("ready")));
    let sha256 = Digest::of(b"succeed").to_string();
    assert_eq!(body["dataset"], json!({ "bytes": 7, "sha256": sha256 }));
    assert_eq!(body["summary"]["train"], 1);

    let again = keep(&server, "?name=Other", "succeed").await.expect(200);
    assert_eq!((again.header("location"), again.json()), (path.as_str(), body.clone()));
    let got = server.get(&path).await.expect(200);
    assert_eq!(got.json(), body);
    let etag = got.header("etag").to_owned();
    assert_eq!(made.header("etag"), etag);
    let same = server.send("GET", &path, |request| request.header("if-none-match", &etag)).await;
    same.expect(304);
    assert_eq!(server.get("/v1/scenes").await.expect(200).json()["scenes"], json!([body]));
    let longest = format!("?name={}", "x".repeat(200));
    keep(&server, &longest, "succeed with the longest name").await.expect(201);
}

pub(super) async fn missing_photographs_are_left_out_if_that_is_asked_for(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let post = async |path: &str| {
        let request = server.send("POST", path, |request| {
            request.header("content-type", "application/zip").body("incomplete")
        });
        request.await
    };
    for path in ["/v1/datasets", "/v1/datasets?skip_missing=false", "/v1/jobs", "/v1/jobs?skip_missing=false"]
    {
        let detail = post(path).await.expect_problem(422, "invalid-dataset");
        assert!(detail.contains("are missing"), "{path}: {detail}");
    }
    post("/v1/datasets?skip_missing=yes").await.expect_problem(422, "invalid-parameter");
    let job = post("/v1/jobs?skip_missing=true").await.expect(201).json();
    assert_eq!(job["options"]["skip_missing"], true);
    let dataset = post("/v1/datasets?skip_missing=true").await.expect(201).json();
    let wanted = json!({ "dataset_id": dataset["id"], "skip_missing": true });
    let job = server.post_json("/v1/jobs", &wanted).await.expect(201).json();
    assert_eq!(job["options"]["skip_missing"], true);
}

pub(super) async fn masks_are_read_as_is_asked_for(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let post = async |query: &str| keep(&server, query, "succeed with astray masks").await;
    for query in ["", "?masks=auto", "?masks=my%20masks", "?mask_mode=cut_out"] {
        post(query).await.expect_problem(422, "dataset-rejected");
    }
    for query in ["?masks=../masks", "?mask_mode=cut"] {
        post(query).await.expect_problem(422, "invalid-parameter");
    }
    post("?masks=none&mask_mode=ignore").await.expect(201);

    // An upload's check takes them by the names that jobs have them by.
    let content = b"succeed in parts with astray masks";
    let upload = begin(&server, content.len()).await;
    part(&server, &upload, 0, content).await.expect(204);
    let id = upload.rsplit('/').next();
    let refused = server.post_json("/v1/datasets", &json!({ "upload_id": id })).await;
    refused.expect_problem(422, "dataset-rejected");
    let wanted = json!({ "upload_id": id, "masks": "none", "mask_mode": "auto" });
    server.post_json("/v1/datasets", &wanted).await.expect(201);
}

pub(super) async fn both_names_of_datasets_mean_the_same(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let made = server.send("POST", "/v1/datasets?name=Garden", |request| {
        request.header("content-type", "application/zip").body("succeed")
    });
    let made = made.await.expect(201);
    let dataset = made.json();
    let id = dataset["id"].as_str().expect("an id");
    let links = json!({ "self": format!("/v1/datasets/{id}"), "jobs": format!("/v1/jobs?dataset_id={id}") });
    assert_eq!((made.header("location"), &dataset["links"]), (&*format!("/v1/datasets/{id}"), &links));
    assert_eq!(server.get(made.header("location")).await.expect(200).json(), dataset);
    assert_eq!(server.get("/v1/datasets").await.expect(200).json()["datasets"], json!([dataset]));

    let mut scene = server.get(&format!("/v1/scenes/{id}")).await.expect(200).json();
    let earlier = json!({ "self": format!("/v1/scenes/{id}"), "jobs": format!("/v1/jobs?scene_id={id}") });
    assert_eq!(std::mem::replace(&mut scene["links"], links), earlier);
    assert_eq!(scene, dataset, "but for its links");

    for name in ["dataset_id", "scene_id"] {
        let job = server.post_json("/v1/jobs", &json!({ name: id })).await.expect(201).json();
        assert_eq!((&job["dataset_id"], &job["scene_id"]), (&json!(id), &json!(id)));
    }
    for name in ["dataset_id", "scene_id"] {
        let jobs = server.get(&format!("/v1/jobs?{name}={id}")).await.expect(200).json();
        assert_eq!(jobs["jobs"].as_array().map(Vec::len), Some(2), "{name}");
    }
    let two = format!("/v1/jobs?dataset_id={id}&scene_id={}", Uuid::now_v7());
    let detail = server.get(&two).await.expect_problem(422, "invalid-parameter");
    assert!(detail.contains("another dataset"), "{detail}");
    server
        .send("DELETE", &format!("/v1/datasets/{id}"), |request| request)
        .await
        .expect_problem(409, "scene-in-use");
}

pub(super) async fn a_scope_on_datasets_is_that_on_scenes(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let admin = server.key(&[Scope::Admin]).await;
    let body = json!({ "name": "sender", "scopes": ["datasets:write"] });
    let made = server.send("POST", "/v1/keys", |request| request.bearer_auth(&admin.key).json(&body));
    let made = made.await.expect(201).json();
    assert_eq!(made["scopes"], json!(["scenes:write"]));
    let key = made["key"].as_str().expect("the key");
    for path in ["/v1/datasets", "/v1/scenes"] {
        let sent = server.send("POST", path, |request| {
            request.bearer_auth(key).header("content-type", "application/zip").body("succeed")
        });
        let status = sent.await;
        status.expect(if path == "/v1/datasets" { 201 } else { 200 });
        let listed = server.send("GET", path, |request| request.bearer_auth(key));
        listed.await.expect_problem(403, "insufficient-scope");
    }
}

pub(super) async fn what_cannot_be_a_scene_is_refused_before_there_is_one(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let bad = keep(&server, "", "bad zip").await.expect(422).json();
    assert_eq!(bad["file"], "transforms.json");
    for (query, named) in [("?name=", "name"), ("?name=a%07", "name"), ("?preset=preview", "preset")] {
        let detail = keep(&server, query, "succeed").await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{query}: {detail}");
    }
    let long = "x".repeat(201);
    keep(&server, &format!("?name={long}"), "succeed").await.expect_problem(422, "invalid-parameter");
    let mixed = server.post_json("/v1/scenes?name=x", &json!({ "upload_id": "7" })).await;
    mixed.expect_problem(422, "invalid-parameter");
    let text = server.send("POST", "/v1/scenes", |request| request.header("content-type", "text/plain"));
    text.await.expect_problem(415, "unsupported-media-type");
    for (body, status, kind) in [
        ("{", 400, "malformed-json"),
        ("{}", 422, "invalid-parameter"),
        (r#"{"upload_id": 7}"#, 422, "invalid-parameter"),
        (r#"{"upload_id": "7", "color": 1}"#, 422, "invalid-parameter"),
        (r#"{"upload_id": "7", "name": ""}"#, 422, "invalid-parameter"),
        (r#"{"upload_id": "7"}"#, 404, "upload-not-found"),
    ] {
        let answer = server.send("POST", "/v1/scenes", |request| {
            request.header("content-type", "application/json").body(body)
        });
        answer.await.expect_problem(status, kind);
    }
    assert_eq!(server.get("/v1/scenes").await.expect(200).json()["scenes"], json!([]), "none is a scene");
    for scene in ["/v1/scenes/0190a5d8-0000-7000-8000-000000000000", "/v1/scenes/17", "/v1/scenes/%00"] {
        server.get(scene).await.expect_problem(404, "scene-not-found");
        let deleted = server.send("DELETE", scene, |request| request).await;
        deleted.expect_problem(404, "scene-not-found");
    }
    keep(&server, "", "bomb").await.expect_problem(500, "internal");

    let server = Server::start_with(&coverage, Setup { limits: tight_limits(), ..idle() }).await;
    keep(&server, "", "succeed but too long").await.expect_problem(413, "body-too-large");
    let busy = tcgs::http::config::RequestLimits { uploads: 0, ..tight_limits() };
    let server = Server::start_with(&coverage, Setup { limits: busy, ..idle() }).await;
    keep(&server, "", "succeed").await.expect_problem(503, "busy");
}

pub(super) async fn a_body_is_held_to_its_announced_digest(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let send = |digest: &'static str| {
        server.send("POST", "/v1/scenes", move |request| {
            request.header("content-type", "application/zip").header("content-digest", digest).body("abc")
        })
    };
    let of_abd = "sha-256=:qVLRhsIJC1d+3WH/F6w6CqQbQ6sVj6F9zl7YnZ9zq2Y=:";
    let detail = send(of_abd).await.expect_problem(400, "digest-mismatch");
    assert!(detail.contains(&Digest::of(b"abc").to_string()), "{detail}");
    send("sha-256=abc").await.expect_problem(400, "invalid-header");
    send("sha-256=:ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=:").await.expect(201);
    send("unixsum=:AAA=:").await.expect(200);
}

pub(super) async fn a_scene_sent_twice_with_one_key_is_made_once(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let send = |body: &'static str| {
        server.send("POST", "/v1/scenes", move |request| {
            request.header("content-type", "application/zip").header("idempotency-key", "k1").body(body)
        })
    };
    let first = send("succeed").await.expect(201);
    assert!(!first.headers.contains_key("idempotency-replayed"));
    let second = send("succeed").await.expect(201);
    assert_eq!((second.header("idempotency-replayed"), second.json()), ("true", first.json()));
    send("succeed other").await.expect_problem(422, "idempotency-key-reused");
    let known = async || {
        let sent = server.send("POST", "/v1/scenes", |request| {
            request.header("content-type", "application/zip").header("idempotency-key", "k2").body("succeed")
        });
        sent.await.expect(200)
    };
    assert!(!known().await.headers.contains_key("idempotency-replayed"), "the project had the scene");
    assert_eq!(known().await.header("idempotency-replayed"), "true", "with the status of then");
    let path = first.header("location").to_owned();
    server.send("DELETE", &path, |request| request).await.expect(204);
    let requested = server.services.blobs.collection_requested();
    within("its dataset is collected at once", requested).await;
    let detail = send("succeed").await.expect_problem(404, "scene-not-found");
    assert!(detail.contains("deleted"), "{detail}");
}

pub(super) async fn scenes_are_listed_newest_first_page_by_page(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let mut made = Vec::new();
    for index in 0..5 {
        made.push(keep(&server, "", &format!("succeed {index}")).await.expect(201).json());
    }
    made.reverse();
    let mut next = Some("/v1/scenes?limit=2".to_owned());
    let (mut listed, mut pages) = (Vec::new(), 0);
    while let Some(path) = next {
        let page = server.get(&path).await.expect(200);
        assert_eq!(page.header("cache-control"), "no-store");
        let body = page.json();
        listed.extend(body["scenes"].as_array().expect("scenes").clone());
        next = body["next"].as_str().map(str::to_owned);
        let link = page.headers.get("link").map(|link| link.to_str().expect("ASCII").to_owned());
        assert_eq!(link, next.as_ref().map(|next| format!("<{next}>; rel=\"next\"")));
        pages += 1;
    }
    assert_eq!((listed, pages), (made, 3));
    for (query, named) in [("?limit=0", "limit"), ("?cursor=abc", "cursor"), ("?page=2", "page")] {
        let detail = server.get(&format!("/v1/scenes{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

pub(super) async fn a_scene_is_deleted_once_no_job_needs_it(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let made = keep(&server, "", "succeed").await.expect(201);
    let path = made.header("location").to_owned();
    let id = made.json()["id"].as_str().expect("an id").parse().expect("a UUID");
    let scene = server.store_scene(id).await;
    let job = JobId(Uuid::from_u128(1));
    let new = NewJob::new(job, TrainOptions::default(), scene.dataset);
    let store = &server.services.store;
    store.create_job(NewJob { dataset_id: Some(scene.id), ..new }).await.expect("queued");
    let delete = |tag: &'static str| {
        server.send("DELETE", &path, move |request| match tag {
            "" => request,
            tag => request.header("if-match", tag),
        })
    };
    let detail = delete("").await.expect_problem(409, "scene-in-use");
    assert!(detail.starts_with("1 "), "{detail}");
    store.cancel(job).await.expect("cancelled");
    let of_job = format!("/v1/jobs/{job}");
    let shown = server.get(&of_job).await.expect(200);
    assert_eq!(shown.json()["scene_id"], json!(scene.id));
    delete("\"2\"").await.expect_problem(412, "precondition-failed");
    delete("\"1\"").await.expect(204);
    server.get(&path).await.expect_problem(404, "scene-not-found");
    let tag = shown.header("etag").to_owned();
    let now = server.send("GET", &of_job, |request| request.header("if-none-match", tag)).await.expect(200);
    assert_eq!(now.json()["scene_id"], Value::Null);
}

pub(super) async fn scenes_of_another_key_are_not_there_and_bytes_have_a_quota(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let scopes = [Scope::Read, Scope::DatasetsWrite];
    let one =
        server.key_with(&scopes, ProjectLimits { quota_bytes: Some(16), ..ProjectLimits::default() }).await;
    let other = server.key(&scopes).await;
    let admin = server.key(&[Scope::Admin]).await;
    let send = |key: &str, dataset: &'static str| {
        let key = key.to_owned();
        server.send("POST", "/v1/scenes", move |request| {
            request.bearer_auth(key).header("content-type", "application/zip").body(dataset)
        })
    };
    let as_key = |method: &'static str, path: String, key: &str| {
        let key = key.to_owned();
        let server = &server;
        async move { server.send(method, &path, |request| request.bearer_auth(key)).await }
    };
    let mine = send(&one.key, "succeed").await.expect(201);
    let path = mine.header("location").to_owned();
    for method in ["GET", "DELETE"] {
        as_key(method, path.clone(), &other.key).await.expect_problem(404, "scene-not-found");
    }
    let theirs = send(&other.key, "succeed").await.expect(201);
    assert_ne!(theirs.header("location"), path, "another owner's scene is not given away");
    let listed = |answer: Answer| answer.expect(200).json()["scenes"].as_array().map_or(0, Vec::len);
    assert_eq!(listed(as_key("GET", "/v1/scenes".into(), &one.key).await), 1);
    assert_eq!(listed(as_key("GET", "/v1/scenes".into(), &admin.key).await), 2);
    as_key("GET", path.clone(), &admin.key).await.expect(200);

    send(&one.key, "succeed").await.expect(200);
    let detail = send(&one.key, "succeed ten").await.expect_problem(507, "quota-exceeded");
    assert!(detail.contains("quota of 16") && detail.contains("7 are stored"), "{detail}");
    as_key("DELETE", path, &one.key).await.expect(204);
    send(&one.key, "succeed ten").await.expect(201);
    let usage: Value =
        serde_json::to_value(server.services.store.usage(one.project).await.expect("read").stored)
            .expect("a number");
    assert_eq!(usage, 11);
}
