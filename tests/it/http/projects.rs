//! Projects: what belongs to them, their keys, limits and usage, and the names, labels and positions of their jobs.

use std::sync::Arc;

use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{
    domain::{Clock as _, ManualClock, ProjectId, Scope},
    store::Outcome,
};

use crate::support::{
    contract::Coverage,
    server::{Answer, Server, Setup, TestKey},
};

const WRITES: [Scope; 3] = [Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite];

fn idle() -> Setup {
    Setup { worker: false, ..Setup::default() }
}

async fn with(server: &Server, key: &TestKey, method: &str, path: &str, body: Option<Value>) -> Answer {
    server
        .send(method, path, |request| {
            let request = request.bearer_auth(&key.key);
            body.iter().fold(request, |request, body| request.json(body))
        })
        .await
}

async fn job_of(server: &Server, key: &TestKey, query: &str, dataset: &'static str) -> Answer {
    server
        .send("POST", &format!("/v1/jobs{query}"), |request| {
            request.bearer_auth(&key.key).header("content-type", "application/zip").body(dataset)
        })
        .await
}

fn ids(list: &Value, of: &str) -> Vec<Value> {
    list[of].as_array().expect("a list").iter().map(|entry| entry["id"].clone()).collect()
}

pub(super) async fn a_leaked_key_is_replaced_and_nothing_is_lost(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let leaked = server.key(&WRITES).await;
    let running =
        job_of(&server, &leaked, "", "succeed running").await.expect(201).header("location").to_owned();
    let lease = server.store.claim("a worker").await.expect("an answer").expect("the job").lease;
    let queued =
        job_of(&server, &leaked, "", "succeed queued").await.expect(201).header("location").to_owned();
    let dataset = b"succeed by parts";
    let tus = |request: reqwest::RequestBuilder, key: &TestKey| {
        request.bearer_auth(&key.key).header("tus-resumable", "1.0.0")
    };
    let begun = server
        .send("POST", "/v1/uploads", |request| tus(request, &leaked).header("upload-length", dataset.len()))
        .await;
    let upload = begun.expect(201).header("location").to_owned();
    let part = async |key: &TestKey, range: std::ops::Range<usize>| {
        server
            .send("PATCH", &upload, |request| {
                let request = tus(request, key).header("content-type", "application/offset+octet-stream");
                request.header("upload-offset", range.start).body(dataset[range].to_vec())
            })
            .await
    };
    part(&leaked, 0..7).await.expect(204);
    let once = async |key: &TestKey| {
        server
            .send("POST", "/v1/scenes", |request| {
                let request = request.bearer_auth(&key.key).header("content-type", "application/zip");
                request.header("idempotency-key", "once").body("succeed once")
            })
            .await
    };
    let scene = once(&leaked).await.expect(201).json()["id"].clone();

    let fresh = server.key_beside(&leaked, &WRITES).await;
    let stranger = server.key(&WRITES).await;
    let admin = server.key(&[Scope::Admin]).await;
    with(&server, &admin, "DELETE", &format!("/v1/keys/{}", leaked.id), None).await.expect(204);
    with(&server, &leaked, "GET", &running, None).await.expect_problem(401, "invalid-key");
    part(&leaked, 7..9).await.expect_problem(401, "invalid-key");

    // The other key has it all, and a third of another project nothing.
    let jobs = with(&server, &fresh, "GET", "/v1/jobs", None).await.expect(200).json();
    assert_eq!(ids(&jobs, "jobs").len(), 2);
    assert!(
        jobs["jobs"].as_array().expect("jobs").iter().all(|job| job["created_by"] == leaked.id.to_string())
    );
    assert_eq!(once(&fresh).await.expect(201).header("idempotency-replayed"), "true");
    part(&stranger, 7..9).await.expect_problem(404, "upload-not-found");
    part(&fresh, 7..dataset.len()).await.expect(204);
    let upload_id = upload.rsplit('/').next().expect("an id");
    let made = with(&server, &fresh, "POST", "/v1/scenes", Some(json!({ "upload_id": upload_id }))).await;
    let by_parts = made.expect(201).json()["id"].clone();
    let scenes = with(&server, &fresh, "GET", "/v1/scenes", None).await.expect(200).json();
    let listed = ids(&scenes, "scenes");
    assert_eq!(
        (&listed[..2], listed.len()),
        (&[by_parts, scene][..], 4),
        "those that came with the jobs are older"
    );
    with(&server, &fresh, "POST", &format!("{queued}/cancel"), None).await.expect(200);
    with(&server, &fresh, "POST", &format!("{running}/cancel"), None).await.expect(202);
    assert!(server.store.heartbeat(&lease).await.expect("still held").cancel_requested);
    server.store.finish(&lease, Outcome::Cancelled).await.expect("ended");
    let retried = with(&server, &fresh, "POST", &format!("{running}/retry"), None).await.expect(201).json();
    assert_eq!(retried["project_id"], leaked.project.to_string());
    assert_eq!(retried["created_by"], fresh.id.to_string());
    with(&server, &fresh, "DELETE", &queued, None).await.expect(204);
    for path in [&running, &queued] {
        with(&server, &stranger, "GET", path, None).await.expect_problem(404, "job-not-found");
    }
    let usage = with(&server, &fresh, "GET", "/v1/usage", None).await.expect(200).json();
    assert_eq!(usage["projects"][0]["project_id"], leaked.project.to_string());
}

pub(super) async fn projects_are_made_changed_and_listed_by_administrators(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let admin = server.key(&[Scope::Admin]).await;
    let plain = server.key(&WRITES).await;
    let ask =
        async |method: &str, path: &str, body: Value| with(&server, &admin, method, path, Some(body)).await;
    let wanted = json!({ "name": " survey ", "max_bytes": 1000, "max_active_jobs": 3, "max_running_jobs": 2, "max_priority": 7 });
    let made = ask("POST", "/v1/projects", wanted).await.expect(201);
    let (path, body) = (made.header("location").to_owned(), made.json());
    assert_eq!(
        (&body["name"], &body["max_bytes"], &body["max_running_jobs"]),
        (&json!("survey"), &json!(1000), &json!(2))
    );
    let shown = with(&server, &admin, "GET", &path, None).await.expect(200);
    assert_eq!(shown.header("etag"), made.header("etag"));
    let etag = made.header("etag").to_owned();
    let same = |request: reqwest::RequestBuilder| {
        request.bearer_auth(&admin.key).header("if-none-match", etag.clone())
    };
    server.send("GET", &path, same).await.expect(304);
    with(&server, &plain, "GET", &path, None).await.expect_problem(404, "project-not-found");
    with(&server, &plain, "PATCH", &path, Some(json!({}))).await.expect_problem(403, "insufficient-scope");

    let changed = ask("PATCH", &path, json!({ "max_bytes": null, "max_active_jobs": 4 })).await.expect(200);
    let now = changed.json();
    assert_eq!(
        (&now["max_bytes"], &now["max_active_jobs"], &now["max_running_jobs"], &now["name"]),
        (&json!(null), &json!(4), &json!(2), &json!("survey"))
    );
    let stale = |request: reqwest::RequestBuilder| {
        request.bearer_auth(&admin.key).header("if-match", etag.clone()).json(&json!({ "name": "late" }))
    };
    server.send("PATCH", &path, stale).await.expect_problem(412, "precondition-failed");

    for (method, place) in [("POST", "/v1/projects"), ("PATCH", &*path)] {
        for (error, named) in [
            (json!({ "name": "" }), "name"),
            (json!({ "name": "a\nb" }), "name"),
            (json!({ "name": "x", "max_bytes": 1_u64 << 63 }), "max_bytes"),
            (json!({ "name": "x", "max_priority": 101 }), "max_priority"),
            (json!({ "name": "x", "max_running_jobs": -1 }), "-1"),
            (json!({ "name": "x", "color": "red" }), "color"),
        ] {
            let detail =
                ask(method, place, error.clone()).await.expect_problem(422, "invalid-project-request");
            assert!(detail.contains(named), "{error}: {detail}");
        }
    }
    for absent in ["/v1/projects/17", "/v1/projects/0190a5d8-0000-7000-8000-000000000000"] {
        with(&server, &admin, "GET", absent, None).await.expect_problem(404, "project-not-found");
        ask("PATCH", absent, json!({})).await.expect_problem(404, "project-not-found");
    }

    let own = with(&server, &plain, "GET", "/v1/projects", None).await.expect(200).json();
    assert_eq!(ids(&own, "projects"), [plain.project.to_string()]);
    let list = async |path: &str| with(&server, &admin, "GET", path, None).await.expect(200).json();
    let (mut all, mut next) = (Vec::new(), Some("/v1/projects?limit=3".to_owned()));
    while let Some(path) = next {
        let page = list(&path).await;
        all.extend(ids(&page, "projects"));
        next = page["next"].as_str().map(str::to_owned);
    }
    assert_eq!(all.len(), 4, "the administrator's, the other key's, the one made here, and the default one");
    assert_eq!((&all[0], &all[3]), (&body["id"], &json!(ProjectId::DEFAULT.to_string())));
    for query in ["?limit=0", "?cursor=17", "?color=red"] {
        let answer = with(&server, &admin, "GET", &format!("/v1/projects{query}"), None).await;
        answer.expect_problem(422, "invalid-parameter");
    }

    // A key of the project shares its limits.
    let key = json!({ "name": "k", "scopes": ["read", "jobs:write"], "project_id": body["id"] });
    let first = ask("POST", "/v1/keys", key.clone()).await.expect(201).json();
    assert_eq!(first["project_id"], body["id"]);
    let limited = json!({ "name": "k", "scopes": ["read"], "project_id": body["id"], "max_active_jobs": 9 });
    let detail = ask("POST", "/v1/keys", limited).await.expect_problem(422, "invalid-key-request");
    assert!(detail.contains("PATCH /v1/projects/"), "{detail}");
    let nowhere =
        json!({ "name": "k", "scopes": ["read"], "project_id": "0190a5d8-0000-7000-8000-000000000000" });
    ask("POST", "/v1/keys", nowhere).await.expect_problem(404, "project-not-found");
    let of_project = list(&format!("/v1/keys?project_id={}", body["id"].as_str().expect("an id"))).await;
    assert_eq!(ids(&of_project, "keys"), [first["id"].clone()]);
    ask("PATCH", &path, json!({ "max_active_jobs": 1 })).await.expect(200);
    let second = ask("POST", "/v1/keys", key).await.expect(201).json();
    let upload = async |key: &Value| {
        let token = key["key"].as_str().expect("a key").to_owned();
        let send = |request: reqwest::RequestBuilder| {
            request.bearer_auth(token).header("content-type", "application/zip").body("succeed")
        };
        server.send("POST", "/v1/jobs", send).await
    };
    upload(&first).await.expect(201);
    upload(&second).await.expect_problem(429, "too-many-jobs");
}

pub(super) async fn keys_expire_and_are_changed(coverage: Coverage) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let setup = Setup { clock: clock.clone(), ..idle() };
    let server = Server::start_with(&coverage, setup).await;
    let admin = server.key(&[Scope::Admin]).await;
    let ask =
        async |method: &str, path: &str, body: Value| with(&server, &admin, method, path, Some(body)).await;
    let soon = (clock.now() + SignedDuration::from_mins(10)).to_string();
    let made =
        ask("POST", "/v1/keys", json!({ "name": "short", "scopes": ["read"], "expires_at": soon })).await;
    let made = made.expect(201);
    let (path, body) = (made.header("location").to_owned(), made.json());
    assert_eq!(body["expires_at"], soon);
    let token = body["key"].as_str().expect("a key").to_owned();
    let jobs = async || server.send("GET", "/v1/jobs", |request| request.bearer_auth(&token)).await;
    jobs().await.expect(200);
    clock.advance(SignedDuration::from_mins(10));
    jobs().await.expect_problem(401, "invalid-key");

    let later = (clock.now() + SignedDuration::from_mins(1)).to_string();
    let change = json!({ "expires_at": later, "name": "longer", "requests_per_minute": 600 });
    let changed = ask("PATCH", &path, change).await.expect(200).json();
    assert_eq!((&changed["name"], &changed["requests_per_minute"]), (&json!("longer"), &json!(600)));
    assert!(changed.get("key").is_none());
    jobs().await.expect(200);
    clock.advance(SignedDuration::from_mins(2));
    jobs().await.expect_problem(401, "invalid-key");
    let forever = ask("PATCH", &path, json!({ "expires_at": null, "requests_per_minute": null })).await;
    let forever = forever.expect(200).json();
    assert_eq!((&forever["expires_at"], &forever["requests_per_minute"]), (&json!(null), &json!(null)));
    jobs().await.expect(200);

    let past = clock.now().to_string();
    for (error, named) in [
        (json!({ "expires_at": past }), "expires_at"),
        (json!({ "expires_at": "tomorrow" }), "year"),
        (json!({ "name": " " }), "name"),
        (json!({ "max_active_jobs": 1 }), "max_active_jobs"),
        (json!({ "requests_per_minute": 0 }), "nonzero"),
        (json!([null, null]), "array"),
    ] {
        let detail = ask("PATCH", &path, error.clone()).await.expect_problem(422, "invalid-key-request");
        assert!(detail.contains(named), "{error}: {detail}");
    }
    let new = json!({ "name": "x", "scopes": ["read"], "expires_at": past });
    ask("POST", "/v1/keys", new).await.expect_problem(422, "invalid-key-request");
    with(&server, &admin, "DELETE", &path, None).await.expect(204);
    ask("PATCH", &path, json!({})).await.expect_problem(404, "key-not-found");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn concurrent_changes_of_a_key_keep_each_others_fields() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let admin = server.key(&[Scope::Admin]).await;
    let key = server.key(&[Scope::Read]).await;
    let path = format!("/v1/keys/{}", key.id);
    let change = async |body: Value| {
        with(&server, &admin, "PATCH", &path, Some(body)).await.expect(200);
    };
    for round in 1..=30 {
        let name = round.to_string();
        tokio::join!(change(json!({ "name": name })), change(json!({ "requests_per_minute": round })));
        let now = with(&server, &admin, "GET", &path, None).await.expect(200).json();
        assert_eq!((&now["name"], &now["requests_per_minute"]), (&json!(name), &json!(round)));
    }
}

pub(super) async fn usage_is_shown_by_project(coverage: Coverage) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let server = Server::start_with(&coverage, Setup { clock: clock.clone(), ..idle() }).await;
    let (mine, other) = (server.key(&WRITES).await, server.key(&WRITES).await);
    let admin = server.key(&[Scope::Admin]).await;
    job_of(&server, &mine, "", "succeed").await.expect(201);
    job_of(&server, &mine, "", "succeed").await.expect(201);
    let lease = server.store.claim("a worker").await.expect("an answer").expect("the job").lease;
    clock.advance(SignedDuration::from_secs(20));
    let get = async |key: &TestKey, query: &str| {
        with(&server, key, "GET", &format!("/v1/usage{query}"), None).await
    };
    let usage = get(&mine, "").await.expect(200).json();
    let own = &usage["projects"][0];
    assert_eq!(own["project_id"], mine.project.to_string());
    assert_eq!(
        own["bytes"],
        json!({ "total": 7, "datasets": 7, "artifacts": 0, "exports": 0, "uploads": 0 })
    );
    assert_eq!((&own["jobs"]["queued"], &own["jobs"]["running"]), (&json!(1), &json!(1)));
    assert_eq!(own["worker_seconds"], 20.0, "what runs counts up to now");
    server.store.finish(&lease, Outcome::Released).await.expect("ended");
    let begun = server.send("POST", "/v1/uploads", |request| {
        request.bearer_auth(&mine.key).header("tus-resumable", "1.0.0").header("upload-length", 5)
    });
    begun.await.expect(201);
    let after = get(&mine, &format!("?project_id={}", mine.project)).await.expect(200).json();
    assert_eq!(after["projects"][0]["worker_seconds"], 20.0);
    assert_eq!(
        after["projects"][0]["bytes"],
        json!({ "total": 12, "datasets": 7, "artifacts": 0, "exports": 0, "uploads": 5 }),
        "what is promised to an upload is used"
    );
    let nothing = get(&other, "").await.expect(200).json();
    assert_eq!(nothing["projects"][0]["bytes"]["total"], 0);
    get(&other, &format!("?project_id={}", mine.project)).await.expect_problem(404, "project-not-found");
    get(&admin, "?project_id=0190a5d8-0000-7000-8000-000000000000")
        .await
        .expect_problem(404, "project-not-found");
    get(&mine, "?color=red").await.expect_problem(422, "invalid-parameter");
    let (mut seen, mut next) = (Vec::new(), Some("/v1/usage?limit=3".to_owned()));
    while let Some(path) = next {
        let page = with(&server, &admin, "GET", &path, None).await.expect(200).json();
        seen.extend(
            page["projects"].as_array().expect("a page").iter().map(|usage| usage["project_id"].clone()),
        );
        next = page["next"].as_str().map(str::to_owned);
    }
    assert_eq!(seen.len(), 4);
    assert!(
        seen.contains(&json!(mine.project.to_string())) && seen.contains(&json!(other.project.to_string()))
    );
}

pub(super) async fn jobs_have_names_labels_attempts_and_places_in_the_queue(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let first = server.upload("?name=%20garden%20&metadata[site]=north&metadata[run.no]=1", "succeed").await;
    let first = first.expect(201);
    let (path, body) = (first.header("location").to_owned(), first.json());
    assert_eq!(
        (&body["name"], &body["metadata"]),
        (&json!("garden"), &json!({ "site": "north", "run.no": "1" }))
    );
    assert_eq!((&body["queue_position"], &body["attempts"]), (&json!(1), &json!([])));
    let tag = first.header("etag").to_owned();
    let scene = server.send("POST", "/v1/scenes", |request| {
        request.header("content-type", "application/zip").body("succeed")
    });
    let scene = scene.await.expect(201).json()["id"].clone();
    let wanted =
        json!({ "scene_id": scene, "name": "garden", "metadata": { "site": "a&b=c" }, "priority": 9 });
    let second = server.post_json("/v1/jobs", &wanted).await.expect(201).json();
    assert_eq!((&second["metadata"], &second["queue_position"]), (&json!({ "site": "a&b=c" }), &json!(1)));

    // Another job came before it: its representation is another, though nothing of its own has changed.
    let again =
        server.send("GET", &path, |request| request.header("if-none-match", tag.clone())).await.expect(200);
    assert_eq!(again.json()["queue_position"], 2);
    let tag = again.header("etag").to_owned();
    server.send("GET", &path, |request| request.header("if-none-match", tag.clone())).await.expect(304);

    for (query, found) in [
        ("name=garden", 2),
        ("name=Garden", 0),
        ("metadata[site]=north", 1),
        ("metadata[site]=a%26b%3Dc&name=garden", 1),
        ("metadata[site]=north&metadata[run.no]=2", 0),
        ("created_from=2000-01-01T00:00:00Z&created_before=2100-01-01T00:00:00%2B01:00", 2),
        ("created_before=2000-01-01T00:00:00Z", 0),
        ("project_id=00000000-0000-0000-0000-000000000000", 2),
    ] {
        let list = server.get(&format!("/v1/jobs?{query}")).await.expect(200).json();
        assert_eq!(list["jobs"].as_array().map(Vec::len), Some(found), "{query}");
    }
    let page =
        server.get("/v1/jobs?limit=1&name=garden&created_from=2000-01-01T00:00:00Z").await.expect(200).json();
    let rest = server.get(page["next"].as_str().expect("another page")).await.expect(200).json();
    assert_eq!((&rest["jobs"][0]["id"], &rest["next"]), (&body["id"], &json!(null)));
    let page = server.get("/v1/jobs?limit=1&metadata[site]=a%26b%3Dc").await.expect(200).json();
    assert_eq!((&page["jobs"][0]["id"], &page["next"]), (&second["id"], &json!(null)));

    let lease = server.store.claim("host-7/worker").await.expect("an answer").expect("a job").lease;
    let shown = server.get(second["links"]["self"].as_str().expect("a path")).await.expect(200).json();
    assert_eq!((&shown["queue_position"], &shown["attempts"][0]["number"]), (&json!(null), &json!(1)));
    assert!(!shown.to_string().contains("host-7"), "the service's machines are not its users'");
    server.store.finish(&lease, Outcome::Released).await.expect("ended");
    let shown = server.get(second["links"]["self"].as_str().expect("a path")).await.expect(200).json();
    assert_eq!(shown["attempts"][0]["outcome"], "released");

    for (query, named) in [
        ("name=", "name"),
        ("metadata[]=x", "metadata"),
        ("metadata[a%20b]=x", "metadata"),
        ("metadata[a]=x%0Ay", "metadata"),
        ("metadata=x", "metadata"),
    ] {
        let error = server.upload(&format!("?{query}"), "succeed").await;
        assert_eq!(error.status, 422, "{query}");
        assert!(String::from_utf8_lossy(&error.body).contains(named), "{query}");
    }
    for error in [
        json!({ "scene_id": scene, "name": 7 }),
        json!({ "scene_id": scene, "name": "n".repeat(101) }),
        json!({ "scene_id": scene, "metadata": { "a": 1 } }),
        json!({ "scene_id": scene, "metadata": { "a": "v".repeat(513) } }),
        json!({ "scene_id": scene, "metadata": ["a"] }),
    ] {
        server.post_json("/v1/jobs", &error).await.expect_problem(422, "invalid-parameter");
    }
    for query in ["created_from=yesterday", "created_before=1", "project_id=17", "metadata[]=x"] {
        server.get(&format!("/v1/jobs?{query}")).await.expect_problem(422, "invalid-parameter");
    }
    let key = server.key(&WRITES).await;
    let other = format!("/v1/jobs?project_id={}", ProjectId::DEFAULT);
    with(&server, &key, "GET", &other, None).await.expect_problem(404, "project-not-found");
}

#[tokio::test]
async fn the_expiry_of_a_key_is_judged_by_the_clock_of_the_database() {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let database_clock = Arc::new(ManualClock::new(clock.now()));
    let clocks = Setup { clock: clock.clone(), database_clock: Some(database_clock.clone()), ..idle() };
    let server = Server::start_with(&Coverage::default(), clocks).await;
    let admin = server.key(&[Scope::Admin]).await;
    let at = |minutes: i64| (clock.now() + SignedDuration::from_mins(minutes)).to_string();
    for (ahead, past, future) in [(10, 5, 15), (-10, -15, -5)] {
        database_clock.set_by(SignedDuration::from_mins(ahead));
        let body = |minutes| json!({ "name": "short", "scopes": ["read"], "expires_at": at(minutes) });
        let refused = with(&server, &admin, "POST", "/v1/keys", Some(body(past))).await;
        refused.expect_problem(422, "invalid-key-request");
        let made = with(&server, &admin, "POST", "/v1/keys", Some(body(future))).await.expect(201);
        let path = made.header("location").to_owned();
        let change = json!({ "expires_at": at(past) });
        let refused = with(&server, &admin, "PATCH", &path, Some(change)).await;
        refused.expect_problem(422, "invalid-key-request");
        database_clock.set_by(SignedDuration::from_mins(-ahead));
    }
}

pub(super) async fn what_an_administrator_makes_of_a_projects_things_is_the_projects(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let owner = server.key(&WRITES).await;
    let admin = server.key(&[Scope::Admin]).await;
    let dataset = b"succeed for another";
    let begun = server.send("POST", "/v1/uploads", |request| {
        let request = request.bearer_auth(&owner.key).header("tus-resumable", "1.0.0");
        request.header("upload-length", dataset.len())
    });
    let upload = begun.await.expect(201).header("location").to_owned();
    let part = server.send("PATCH", &upload, |request| {
        let request = request.bearer_auth(&owner.key).header("tus-resumable", "1.0.0");
        let request = request.header("content-type", "application/offset+octet-stream");
        request.header("upload-offset", 0).body(dataset.to_vec())
    });
    part.await.expect(204);
    let id = upload.rsplit('/').next().expect("an id");
    let scene = with(&server, &admin, "POST", "/v1/scenes", Some(json!({ "upload_id": id }))).await;
    let scene = scene.expect(201).header("location").to_owned();
    let id = scene.rsplit('/').next().expect("an id");
    let job = with(&server, &admin, "POST", "/v1/jobs", Some(json!({ "scene_id": id }))).await;
    let job = job.expect(201).header("location").to_owned();
    for made in [&scene, &job] {
        with(&server, &owner, "GET", made, None).await.expect(200);
    }
    job_of(&server, &admin, "", "succeed").await.expect(201);
    for (project, count) in [(owner.project, 1), (admin.project, 1), (ProjectId::DEFAULT, 0)] {
        let list = format!("/v1/jobs?project_id={project}");
        let list = with(&server, &admin, "GET", &list, None).await.expect(200).json();
        assert_eq!(ids(&list, "jobs").len(), count, "{list}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_an_administrator_made_for_another_project_is_not_shown_to_a_key_of_its_own() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let owner = server.key(&WRITES).await;
    let admin = server.key(&[Scope::Admin]).await;
    let beside = server.key_beside(&admin, &WRITES).await;
    let scene = server.send("POST", "/v1/scenes", |request| {
        request.bearer_auth(&owner.key).header("content-type", "application/zip").body("succeed")
    });
    let once = async |key: &TestKey, path: &str, body: &Value| {
        let fill = |request: reqwest::RequestBuilder| request.bearer_auth(&key.key).json(body);
        server.send("POST", path, |request| fill(request).header("idempotency-key", path)).await
    };
    let body = json!({ "scene_id": scene.await.expect(201).json()["id"] });
    once(&admin, "/v1/jobs", &body).await.expect(201);
    assert_eq!(once(&admin, "/v1/jobs", &body).await.expect(201).header("idempotency-replayed"), "true");
    once(&beside, "/v1/jobs", &body).await.expect_problem(404, "job-not-found");

    let begun = server.send("POST", "/v1/uploads", |request| {
        request.bearer_auth(&owner.key).header("tus-resumable", "1.0.0").header("upload-length", 0)
    });
    let upload = begun.await.expect(201).header("location").to_owned();
    let body = json!({ "upload_id": upload.rsplit('/').next() });
    once(&admin, "/v1/scenes", &body).await.expect(201);
    assert_eq!(once(&admin, "/v1/scenes", &body).await.expect(201).header("idempotency-replayed"), "true");
    once(&beside, "/v1/scenes", &body).await.expect_problem(404, "scene-not-found");
}
