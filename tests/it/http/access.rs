//! Keys: authentication, scopes and rate limits.

use std::{num::NonZeroU32, sync::Arc};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{
    domain::{ManualClock, ProjectLimits, Scope},
    http::config::{AccessRules, RequestLimits},
    store::QueuePolicy,
};

use crate::support::{
    contract::{self, Coverage},
    eventually::eventually,
    faults::Failing,
    server::{Answer, Server, Setup, TestKey, quick_policy},
};

/// A key of the right form that no service knows.
pub(super) const UNKNOWN: &str = "tcgs_000102030405060708090a0b0c0d0e0f10111213b57d5e69";

/// A service whose time stands still, so that no bucket fills while a test takes its time.
pub(super) fn stopped_clock() -> (Setup, Arc<ManualClock>) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let access = AccessRules { failures_per_minute: NonZeroU32::MAX, ..AccessRules::default() };
    let limits = RequestLimits { access, ..RequestLimits::default() };
    (Setup { clock: clock.clone(), worker: false, limits, ..Setup::default() }, clock)
}

pub(super) async fn with_key(server: &Server, method: &str, path: &str, key: &str) -> Answer {
    server.send(method, path, |request| request.bearer_auth(key)).await
}

pub(super) async fn no_operation_answers_without_the_right_key(coverage: Coverage) {
    let server = Server::start_with(&coverage, stopped_clock().0).await;
    for operation in contract::guarded() {
        let answer = server.send(operation.method, &operation.path(), |request| request).await;
        assert_ne!(
            answer.status, 401,
            "{}: without any key in the database, everybody is let in",
            operation.id
        );
    }

    let revoked = server.key(&Scope::ALL).await;
    server.revoke(&revoked).await;
    let spent = server.key_at_rate(&Scope::ALL, NonZeroU32::MIN).await;
    with_key(&server, "GET", "/v1/jobs", &spent.key).await.expect(200);

    for operation in contract::guarded() {
        let (method, path, id) = (operation.method, operation.path(), &operation.id);
        let refused = |answer: Answer, status: u16, kind: &str| {
            assert_eq!(answer.status, status, "{id}: {}", String::from_utf8_lossy(&answer.body));
            let challenge =
                answer.headers.get("www-authenticate").map(|value| value.to_str().expect("ASCII"));
            assert!(
                challenge.is_none_or(|challenge| challenge.starts_with("Bearer ")),
                "{id}: {challenge:?}"
            );
            if method != "HEAD" {
                answer.expect_problem(status, kind);
            }
        };
        refused(server.send(method, &path, |request| request).await, 401, "no-key");
        for bad in [UNKNOWN, &revoked.key, "tcgs_17", "", &revoked.key[5..]] {
            refused(with_key(&server, method, &path, bad).await, 401, "invalid-key");
        }
        for header in [format!("Basic {}", spent.key), spent.key.clone(), "Bearer".to_owned()] {
            let answer = server.send(method, &path, |request| request.header("authorization", header)).await;
            refused(answer, 401, "invalid-key");
        }
        for scope in Scope::ALL.into_iter().filter(|scope| *scope != Scope::Admin) {
            let key = server.key(&[scope]).await;
            let answer = with_key(&server, method, &path, &key.key).await;
            if scope == operation.scope {
                assert!(!matches!(answer.status, 401 | 403), "{id} needs {}: {answer:?}", scope.name());
            } else {
                refused(answer, 403, "insufficient-scope");
            }
        }
        let admin = server.key(&[Scope::Admin]).await;
        let answer = with_key(&server, method, &path, &admin.key).await;
        assert!(!matches!(answer.status, 401 | 403), "{id}: an administrator may do everything: {answer:?}");
        refused(with_key(&server, method, &path, &spent.key).await, 429, "too-many-requests");
    }

    for path in ["/v1", "/v1/", "/v1/nothing", "/v1/jobs/a/b/c"] {
        server.get(path).await.expect_problem(401, "no-key");
        with_key(&server, "GET", path, UNKNOWN).await.expect_problem(401, "invalid-key");
    }
    server.send("DELETE", "/v1/jobs", |request| request).await.expect_problem(401, "no-key");
    let reader = server.key(&[Scope::Read]).await;
    with_key(&server, "GET", "/v1/nothing", &reader.key).await.expect_problem(404, "not-found");
    with_key(&server, "DELETE", "/v1/jobs", &reader.key).await.expect_problem(405, "method-not-allowed");
    for path in ["/healthz", "/readyz", "/version", "/openapi.yaml"] {
        server.get(path).await.expect(200);
        with_key(&server, "GET", path, "nonsense").await.expect(200);
    }
    server.get("/elsewhere").await.expect_problem(404, "not-found");
}

pub(super) async fn the_first_key_closes_the_service_and_revoking_the_last_does_not_open_it(
    coverage: Coverage,
) {
    let server = Server::start(&coverage).await;
    server.get("/v1/jobs").await.expect(200);
    let key = server.key(&[Scope::Read]).await;
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    let lower =
        |request: reqwest::RequestBuilder| request.header("authorization", format!("bearer  {}", key.key));
    server.send("GET", "/v1/jobs", lower).await.expect(200);
    let twice = |request: reqwest::RequestBuilder| request.bearer_auth(&key.key).bearer_auth(&key.key);
    server.send("GET", "/v1/jobs", twice).await.expect_problem(401, "invalid-key");
    server.revoke(&key).await;
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect_problem(401, "invalid-key");
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
}

/// The header of HTTP Basic for a user's name and a password.
fn basic(name: &[u8], password: &str) -> String {
    format!("Basic {}", STANDARD.encode([name, b":", password.as_bytes()].concat()))
}

async fn with_header(server: &Server, method: &str, path: &str, header: &str) -> Answer {
    server.send(method, path, |request| request.header("authorization", header)).await
}

/// What an answer asks its client for.
fn challenges(answer: &Answer) -> Vec<&str> {
    let all = answer.headers.get_all("www-authenticate").into_iter();
    all.map(|challenge| challenge.to_str().expect("ASCII")).collect()
}

pub(super) async fn a_browser_shows_its_key_by_basic_and_changes_nothing_by_it(coverage: Coverage) {
    let (mut setup, _) = stopped_clock();
    setup.worker = true;
    let server = Server::start_with(&coverage, setup).await;
    let report = format!("{}/report", server.succeeded().await);
    let key = server.key(&Scope::ALL).await;
    let by_basic = basic(b"", &key.key);

    for operation in contract::guarded() {
        let (method, path, id) = (operation.method, operation.path(), &operation.id);
        let reads = matches!(method, "GET" | "HEAD");
        let answer = with_header(&server, method, &path, &by_basic).await;
        if reads {
            assert!(!matches!(answer.status, 401 | 403), "{id}: {answer:?}");
        } else {
            assert_eq!(challenges(&answer), ["Bearer realm=\"tcgs\""], "{id}");
            answer.expect_problem(401, "bearer-needed");
        }
        let asked = server.send(method, &path, |request| request).await;
        let schemes: &[&str] = if reads {
            &["Bearer realm=\"tcgs\"", "Basic realm=\"tcgs\""]
        } else {
            &["Bearer realm=\"tcgs\""]
        };
        assert_eq!((asked.status, challenges(&asked)), (401, schemes.to_vec()), "{id}");
    }
    with_header(&server, "HEAD", "/v1/jobs", &by_basic).await.expect(200);
    with_header(&server, "GET", "/v1/nothing", &by_basic).await.expect_problem(404, "not-found");
    with_header(&server, "DELETE", "/v1/jobs", &by_basic).await.expect_problem(401, "bearer-needed");

    for name in [&b"me"[..], b"tcgs", b"two words", "Zo\u{eb}".as_bytes(), b"Zo\xeb"] {
        let page = with_header(&server, "GET", &report, &basic(name, &key.key)).await.expect(200);
        assert!(page.header("content-type").starts_with("text/html"));
    }
    with_header(&server, "GET", &report, &by_basic.replace("Basic", "bASIC")).await.expect(200);

    let revoked = server.key(&Scope::ALL).await;
    server.revoke(&revoked).await;
    let encoded = by_basic.trim_start_matches("Basic ");
    for wrong in [
        basic(b"me", UNKNOWN),
        basic(b"me", &revoked.key),
        basic(b"me", ""),
        basic(b"me", &format!("{} ", key.key)),
        basic(b"me", &format!("x:{}", key.key)),
        basic(key.key.as_bytes(), ""),
        format!("Basic {}", STANDARD.encode(&key.key)),
        format!("Basic {}", key.key),
        "Basic".to_owned(),
        "Basic ".to_owned(),
        "Basic !".to_owned(),
        format!("Bearer {encoded}"),
        format!("Digest {encoded}"),
    ] {
        let answer = with_header(&server, "GET", &report, &wrong).await;
        let asked = ["Bearer realm=\"tcgs\", error=\"invalid_token\"", "Basic realm=\"tcgs\""];
        assert_eq!(challenges(&answer), asked, "{wrong}");
        answer.expect_problem(401, "invalid-key");
    }
    let both = server
        .send("GET", &report, |request| request.header("authorization", &by_basic).bearer_auth(&key.key));
    both.await.expect_problem(401, "invalid-key");

    let narrow = server.key(&[Scope::DatasetsWrite]).await;
    let answer = with_header(&server, "GET", "/v1/jobs", &basic(b"me", &narrow.key)).await;
    answer.expect_problem(403, "insufficient-scope");
    let other = server.key(&[Scope::Read]).await;
    let answer = with_header(&server, "GET", &report, &basic(b"me", &other.key)).await;
    answer.expect_problem(404, "job-not-found");
    let once = server.key_at_rate(&[Scope::Read], NonZeroU32::MIN).await;
    with_header(&server, "GET", "/v1/jobs", &basic(b"me", &once.key)).await.expect(200);
    with_key(&server, "GET", "/v1/jobs", &once.key).await.expect_problem(429, "too-many-requests");
}

pub(super) async fn a_key_has_its_rate_and_an_address_a_few_failures(coverage: Coverage) {
    let (mut setup, clock) = stopped_clock();
    setup.limits.access.failures_per_minute = NonZeroU32::new(3).expect("three");
    let server = Server::start_with(&coverage, setup).await;
    let key = server.key_at_rate(&[Scope::Read], NonZeroU32::new(4).expect("four")).await;
    for _ in 0..4 {
        with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    }
    let answer = with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(429);
    assert_eq!(answer.header("retry-after"), "15");
    with_key(&server, "GET", "/healthz", &key.key).await.expect(200);
    clock.advance(SignedDuration::from_secs(15));
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(429);

    for _ in 0..3 {
        with_key(&server, "GET", "/v1/jobs", UNKNOWN).await.expect_problem(401, "invalid-key");
    }
    let answer = server.get("/v1/jobs").await.expect(429);
    assert_eq!(answer.header("retry-after"), "20");
    assert_eq!(challenges(&answer), ["Bearer realm=\"tcgs\"", "Basic realm=\"tcgs\""]);
    answer.expect_problem(429, "too-many-failures");
    let answer = server.post("/v1/jobs").await.expect(429);
    assert_eq!(challenges(&answer), ["Bearer realm=\"tcgs\""]);
    for (method, header) in [("GET", "nonsense"), ("POST", &*basic(b"me", UNKNOWN))] {
        with_header(&server, method, "/v1/jobs", header).await.expect_problem(429, "too-many-failures");
    }
    let form = server.send("POST", "/v1/jobs", |request| request.header("sec-fetch-mode", "navigate"));
    form.await.expect_problem(429, "too-many-failures");
    // Browsers ask for a key where they are answered 401 and nowhere else.
    for (name, value) in [("accept", "text/html,*/*;q=0.8"), ("sec-fetch-mode", "navigate")] {
        let page = server.send("GET", "/v1/jobs", |request| request.header(name, value)).await;
        assert_eq!(challenges(&page), ["Bearer realm=\"tcgs\"", "Basic realm=\"tcgs\""]);
        page.expect_problem(401, "no-key");
        let wrong = server.send("GET", "/v1/jobs", |request| {
            request.header(name, value).header("authorization", basic(b"me", UNKNOWN))
        });
        wrong.await.expect_problem(429, "too-many-failures");
    }
    let other = server.key(&[Scope::Read]).await;
    with_key(&server, "GET", "/v1/jobs", &other.key).await.expect(200);
    clock.advance(SignedDuration::from_secs(20));
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
}

/// Fails to show a key, as a client of a proxy's.
async fn fail_behind(server: &Server, forwarded: &str) -> u16 {
    server.send("GET", "/v1/jobs", |request| request.header("x-forwarded-for", forwarded)).await.status
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_of_a_trusted_proxy_have_their_failures_each_to_themselves() {
    for is_trusted in [false, true] {
        let (mut setup, _clock) = stopped_clock();
        let access = &mut setup.limits.access;
        access.failures_per_minute = NonZeroU32::new(2).expect("two");
        if is_trusted {
            let network = "127.0.0.0/8".parse().expect("a network");
            access.trusted_proxies = tcgs::http::TrustedProxies(vec![network]);
        }
        let server = Server::start_with(&Coverage::default(), setup).await;
        server.key(&[Scope::Read]).await;
        for expected in [401, 401, 429] {
            // What the client itself has put there, before the proxy added its address, makes no difference.
            let made_up = format!("10.0.0.{expected}, 203.0.113.1");
            assert_eq!(fail_behind(&server, &made_up).await, expected);
        }
        let other = if is_trusted { 401 } else { 429 };
        assert_eq!(fail_behind(&server, "203.0.113.2").await, other, "trusted: {is_trusted}");
        assert_eq!(fail_behind(&server, "203.0.113.1").await, 429);
    }
}

pub(super) async fn keys_are_made_listed_and_revoked_by_administrators(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let request_body = json!({ "name": "CI", "scopes": ["jobs:write", "read"], "max_active_jobs": 3 });
    let first = server.post_json("/v1/keys", &request_body).await.expect_problem(409, "no-keys-yet");
    assert!(first.contains("tcgs keys create"), "{first}");
    server.get("/v1/jobs").await.expect(200);

    let admin = server.key(&[Scope::Admin]).await.key;
    let post = async |body: Value| {
        server.send("POST", "/v1/keys", |request| request.bearer_auth(&admin).json(&body)).await
    };
    let made = post(request_body).await.expect(201);
    let (path, body) = (made.header("location").to_owned(), made.json());
    let key = body["key"].as_str().expect("a key").to_owned();
    assert_eq!(body["prefix"], key[..13]);
    assert_eq!(body["scopes"], json!(["read", "jobs:write"]));
    let project = format!("/v1/projects/{}", body["project_id"].as_str().expect("a project"));
    let project = with_key(&server, "GET", &project, &key).await.expect(200).json();
    assert_eq!((&project["name"], &project["max_active_jobs"]), (&json!("CI"), &json!(3)));
    with_key(&server, "GET", "/v1/jobs", &key).await.expect(200);
    with_key(&server, "GET", &path, &key).await.expect_problem(403, "insufficient-scope");

    let mut shown = json!(null);
    eventually("the key's use is noted", async || {
        shown = with_key(&server, "GET", &path, &admin).await.expect(200).json();
        shown["last_used_at"].is_string()
    })
    .await;
    assert_eq!(shown["id"], body["id"]);
    assert!(shown.get("key").is_none(), "the key itself is shown once");

    for (request_body, named) in [
        (json!({ "name": "", "scopes": ["read"] }), "name"),
        (json!({ "name": "a\nb", "scopes": ["read"] }), "name"),
        (json!({ "name": "x".repeat(101), "scopes": ["read"] }), "name"),
        (json!({ "name": "x", "scopes": [] }), "scope"),
        (json!({ "name": "x", "scopes": ["read"], "max_bytes": 1_u64 << 63 }), "max_bytes"),
        (json!({ "name": "x", "scopes": ["write"] }), "write"),
        (json!({ "name": "x", "scopes": ["read"], "requests_per_minute": 0 }), "nonzero"),
        (json!({ "name": "x", "scopes": ["read"], "max_bytes": -1 }), "-1"),
        (json!({ "name": "x", "scopes": ["read"], "color": "red" }), "color"),
        (json!({ "scopes": ["read"] }), "name"),
    ] {
        let detail = post(request_body.clone()).await.expect_problem(422, "invalid-key-request");
        assert!(detail.contains(named), "{request_body}: {detail}");
    }
    let text = async |kind: &str, body: &'static str| {
        server
            .send("POST", "/v1/keys", |request| {
                request.bearer_auth(&admin).header("content-type", kind).body(body)
            })
            .await
    };
    text("application/json", "{").await.expect_problem(400, "malformed-json");
    text("text/plain", "{}").await.expect_problem(415, "unsupported-media-type");

    let list = async |path: &str| with_key(&server, "GET", path, &admin).await.expect(200).json();
    let page = list("/v1/keys?limit=1").await;
    assert_eq!(page["keys"].as_array().map(Vec::len), Some(1));
    let rest = list(page["next"].as_str().expect("another page")).await;
    assert_eq!((rest["keys"].as_array().map(Vec::len), &rest["next"]), (Some(1), &Value::Null));
    for query in ["?limit=0", "?cursor=17", "?revoked=maybe", "?color=red"] {
        with_key(&server, "GET", &format!("/v1/keys{query}"), &admin)
            .await
            .expect_problem(422, "invalid-parameter");
    }

    with_key(&server, "DELETE", &path, &admin).await.expect(204);
    with_key(&server, "GET", "/v1/jobs", &key).await.expect_problem(401, "invalid-key");
    for absent in [&path, "/v1/keys/17", "/v1/keys/0190a5d8-0000-7000-8000-000000000000"] {
        for method in ["GET", "DELETE"] {
            with_key(&server, method, absent, &admin).await.expect_problem(404, "key-not-found");
        }
    }
    assert_eq!(list("/v1/keys").await["keys"].as_array().map(Vec::len), Some(1));
    let all = list("/v1/keys?revoked=true").await;
    assert_eq!(all["keys"].as_array().map(Vec::len), Some(2));
    assert!(all["keys"].as_array().expect("keys").iter().any(|key| key["revoked_at"].is_string()));
}

pub(super) async fn a_key_has_room_for_some_jobs_and_bytes(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let limits =
        ProjectLimits { max_active_jobs: Some(1), quota_bytes: Some(20), ..ProjectLimits::default() };
    let scopes = [Scope::Read, Scope::JobsWrite];
    let (key, other) = (server.key_with(&scopes, limits).await, server.key(&scopes).await);
    let upload = async |key: &TestKey, dataset: &'static str| {
        server
            .send("POST", "/v1/jobs", |request| {
                request.bearer_auth(&key.key).header("content-type", "application/zip").body(dataset)
            })
            .await
    };
    let job = upload(&key, "succeed 1").await.expect(201).header("location").to_owned();
    let second = upload(&key, "succeed 2").await.expect(429);
    assert!(!second.header("retry-after").is_empty());
    second.expect_problem(429, "too-many-jobs");
    upload(&other, "succeed 2").await.expect(201);
    with_key(&server, "POST", &format!("{job}/cancel"), &key.key).await.expect(200);
    upload(&key, "succeed 1").await.expect(201);
    let next = with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200).json();
    let active = next["jobs"][0]["links"]["cancel"].as_str().expect("a path").to_owned();
    with_key(&server, "POST", &active, &key.key).await.expect(200);
    let detail = upload(&key, "succeed with more").await.expect_problem(507, "quota-exceeded");
    assert!(detail.contains("quota of 20") && detail.contains("9 are"), "{detail}");
    upload(&key, "succeed 3").await.expect(201);

    let limits = ProjectLimits { max_active_jobs: Some(0), ..ProjectLimits::default() };
    let policy = QueuePolicy { limits, ..quick_policy() };
    let server = Server::start_with(&coverage, Setup { worker: false, policy, ..Setup::default() }).await;
    server.create("succeed").await;
    let (plain, own) = (
        server.key(&scopes).await,
        server
            .key_with(&scopes, ProjectLimits { max_active_jobs: Some(1), ..ProjectLimits::default() })
            .await,
    );
    let upload = async |key: &TestKey| {
        server
            .send("POST", "/v1/jobs", |request| {
                request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
            })
            .await
    };
    upload(&plain).await.expect_problem(429, "too-many-jobs");
    upload(&own).await.expect(201);
}

/// Something of a key's for each kind of thing that paths name: its path, and what lists show it by.
async fn possessions(server: &Server, key: &TestKey) -> Vec<(String, String)> {
    let created = server
        .send("POST", "/v1/jobs", |request| {
            request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
        })
        .await
        .expect(201);
    let job = created.header("location").to_owned();
    let mut done = json!(null);
    eventually("the job has succeeded", async || {
        done = with_key(server, "GET", &job, &key.key).await.expect(200).json();
        assert!(done["finished_at"].is_null() || done["state"] == "succeeded", "{done:#}");
        done["state"] == "succeeded"
    })
    .await;
    let id = |path: &str| path.rsplit('/').next().expect("an id").to_owned();
    let mut all = vec![("/v1/jobs/{".to_owned(), id(&job))];
    let digest = done["artifacts"][0]["sha256"].as_str().expect("a digest").to_owned();
    all.push(("/v1/artifacts/{".to_owned(), digest));
    all.push(("/v1/projects/{".to_owned(), done["project_id"].as_str().expect("a project").to_owned()));
    for (prefix, media_type, body) in [
        ("/v1/datasets", "application/zip", "succeed with a dataset"),
        ("/v1/scenes", "application/zip", "succeed with a scene"),
        ("/v1/uploads", "application/offset+octet-stream", ""),
        ("/v1/webhook-endpoints", "application/json", r#"{"url": "https://example.com/hook"}"#),
    ] {
        let template = format!("{prefix}/{{");
        if !contract::guarded().iter().any(|operation| operation.template.starts_with(&template)) {
            continue;
        }
        let made = server
            .send("POST", prefix, |request| {
                let request = request.bearer_auth(&key.key).header("content-type", media_type);
                request.header("tus-resumable", "1.0.0").header("upload-length", "9").body(body)
            })
            .await
            .expect(201);
        all.push((template, id(made.header("location"))));
    }
    all
}

pub(super) async fn what_is_anothers_is_not_there(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let all_but_admin = [Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite];
    let owner = server.key(&all_but_admin).await;
    let things = possessions(&server, &owner).await;
    let other = server.key(&all_but_admin).await;
    let admin = server.key(&[Scope::Admin]).await;

    let ask = async |operation: &contract::Guarded, path: &str, key: &TestKey| {
        let media_type = match operation.template.as_str() {
            "/v1/uploads/{id}" => "application/offset+octet-stream",
            _ => "application/json",
        };
        server
            .send(operation.method, path, |request| {
                let request = request.bearer_auth(&key.key);
                let request = request.header("tus-resumable", "1.0.0").header("upload-offset", "0");
                let request = request.header("x-http-method-override", "HEAD");
                if matches!(operation.method, "POST" | "PATCH") {
                    request.header("content-type", media_type).body(r#"{"views": [{"frame": "test/r_0"}]}"#)
                } else {
                    request
                }
            })
            .await
    };
    let guarded: Vec<_> = contract::guarded().into_iter().filter(|one| one.scope != Scope::Admin).collect();
    for operation in guarded.iter().filter(|operation| operation.template.contains('{')) {
        let template = &operation.template;
        let thing = things.iter().find(|(prefix, _)| template.starts_with(prefix));
        let Some((_, id)) = thing else {
            panic!(
                "{template} names things of a key: make one in possessions(), so that this test can ask for another's"
            )
        };
        let parts: Vec<&str> =
            template.split('/').map(|part| if part.starts_with('{') { id.as_str() } else { part }).collect();
        let path = parts.join("/");
        let answer = ask(operation, &path, &other).await;
        assert_eq!(answer.status, 404, "{}: {}", operation.id, String::from_utf8_lossy(&answer.body));
        // What changes nothing shows that the path itself was right; others would take the thing from those that follow.
        if matches!(operation.method, "GET" | "HEAD") {
            for key in [&owner, &admin] {
                let answer = ask(operation, &path, key).await;
                let known = answer.status != 404
                    || operation.id == "getArtifact"
                    || template.matches('{').count() > 1;
                assert!(known, "{}: {}", operation.id, String::from_utf8_lossy(&answer.body));
            }
        }
    }
    for operation in guarded.iter().filter(|one| one.method == "GET" && !one.template.contains('{')) {
        let shown = async |key: &TestKey| {
            let answer = ask(operation, &operation.template, key).await.expect(200);
            let body = String::from_utf8_lossy(&answer.body).into_owned();
            things.iter().any(|(_, id)| body.contains(id))
        };
        assert!(!shown(&other).await, "{} shows what is another's", operation.id);
        assert!(shown(&owner).await && shown(&admin).await, "{} does not show what is there", operation.id);
    }
}

pub(super) async fn a_database_that_fails_lets_nobody_in(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    for (failing, status, kind) in [(Failing::Busy, 503, "busy"), (Failing::Gone, 500, "internal")] {
        server.faults.set(Some(failing));
        for operation in contract::guarded() {
            let answer = server.send(operation.method, &operation.path(), |request| request).await;
            assert_eq!(answer.status, status, "{}", operation.id);
            if operation.method != "HEAD" {
                answer.expect_problem(status, kind);
            }
        }
        server.faults.set(None);
    }
    server.faults.set(Some(Failing::Full));
    for operation in
        contract::guarded().iter().filter(|one| matches!(one.method, "POST" | "PATCH" | "DELETE"))
    {
        let answer = server.send(operation.method, &operation.path(), |request| request).await;
        answer.expect_problem(507, "storage-full");
    }
    server.faults.set(None);
    let key = server.key(&[Scope::Read]).await;
    server.faults.set(Some(Failing::Busy));
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect_problem(503, "busy");
}

#[tokio::test]
async fn a_clock_that_is_set_back_delays_no_request() {
    let (setup, clock) = stopped_clock();
    let access = AccessRules { failures_per_minute: NonZeroU32::MIN, ..AccessRules::default() };
    let limits = RequestLimits { access, ..setup.limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..setup }).await;
    let key = server.key_at_rate(&[Scope::Read], NonZeroU32::MIN).await;
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    with_key(&server, "GET", "/v1/jobs", UNKNOWN).await.expect_problem(401, "invalid-key");

    clock.set_by(SignedDuration::from_hours(-1));
    let answer = with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(429);
    assert_eq!(answer.header("retry-after"), "60");
    clock.advance(SignedDuration::from_mins(1));
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    with_key(&server, "GET", "/v1/jobs", UNKNOWN).await.expect_problem(401, "invalid-key");
    clock.set_by(SignedDuration::from_hours(1));
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect_problem(429, "too-many-requests");
}

#[tokio::test]
async fn a_project_has_a_ceiling_for_the_priority_of_its_jobs() {
    let setup = || Setup { worker: false, ..Setup::default() };
    let server = Server::start_with(&Coverage::default(), setup()).await;
    let scopes = [Scope::Read, Scope::JobsWrite, Scope::DatasetsWrite];
    let ceiling = |most| ProjectLimits { max_priority: Some(most), ..ProjectLimits::default() };
    server.upload("?priority=100", "succeed").await.expect(201);
    let (plain, high, low, admin) = (
        server.key(&scopes).await,
        server.key_with(&scopes, ceiling(70)).await,
        server.key_with(&scopes, ceiling(-5)).await,
        server.key_with(&[Scope::Admin], ceiling(-5)).await,
    );
    let ask = async |server: &Server, key: &TestKey, priority: i32| {
        let path = format!("/v1/jobs?priority={priority}");
        let upload = |request: reqwest::RequestBuilder| {
            request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
        };
        server.send("POST", &path, upload).await
    };
    for (key, most) in [(&plain, 0), (&high, 70), (&low, -5), (&admin, 100)] {
        let made = ask(&server, key, most).await.expect(201).json();
        assert_eq!(made["priority"], most);
        let detail = ask(&server, key, most + 1).await.expect_problem(422, "invalid-parameter");
        assert!(detail.contains("priority") && detail.contains(&format!("{most}")), "{detail}");
    }
    // By JSON too, and a job that is repeated keeps what it was given.
    let scene = server.send("POST", "/v1/scenes", |request| {
        request.bearer_auth(&high.key).header("content-type", "application/zip").body("succeed")
    });
    let scene = scene.await.expect(201).json()["id"].clone();
    let by_json = async |priority: i32| {
        let body = json!({ "scene_id": scene, "priority": priority });
        server.send("POST", "/v1/jobs", |request| request.bearer_auth(&high.key).json(&body)).await
    };
    by_json(71).await.expect_problem(422, "invalid-parameter");
    let job = by_json(70).await.expect(201).header("location").to_owned();
    with_key(&server, "POST", &format!("{job}/cancel"), &high.key).await.expect(200);
    let again = with_key(&server, "POST", &format!("{job}/retry"), &high.key).await.expect(201).json();
    assert_eq!(again["priority"], 70);
    // But no more than its project has by then.
    let admin = server.key(&[Scope::Admin]).await;
    let project = format!("/v1/projects/{}", high.project);
    let lowered = json!({ "max_priority": 20 });
    let lower = |request: reqwest::RequestBuilder| request.bearer_auth(&admin.key).json(&lowered);
    server.send("PATCH", &project, lower).await.expect(200);
    for (key, priority) in [(&high, 20), (&admin, 70)] {
        let again = with_key(&server, "POST", &format!("{job}/retry"), &key.key).await.expect(201).json();
        assert_eq!(again["priority"], priority);
    }

    // The service's own default, for keys without a ceiling.
    let policy = QueuePolicy { limits: ceiling(20), ..quick_policy() };
    let server = Server::start_with(&Coverage::default(), Setup { policy, ..setup() }).await;
    let (plain, low) = (server.key(&scopes).await, server.key_with(&scopes, ceiling(-5)).await);
    ask(&server, &plain, 20).await.expect(201);
    ask(&server, &plain, 21).await.expect_problem(422, "invalid-parameter");
    ask(&server, &low, -4).await.expect_problem(422, "invalid-parameter");

    let admin = server.key(&[Scope::Admin]).await;
    let make = async |most: i32| {
        let body = json!({ "name": "k", "scopes": ["jobs:write"], "max_priority": most });
        server.send("POST", "/v1/keys", |request| request.bearer_auth(&admin.key).json(&body)).await
    };
    let made = make(-100).await.expect(201).json();
    let project = format!("/v1/projects/{}", made["project_id"].as_str().expect("a project"));
    assert_eq!(with_key(&server, "GET", &project, &admin.key).await.expect(200).json()["max_priority"], -100);
    let detail = make(101).await.expect_problem(422, "invalid-key-request");
    assert!(detail.contains("max_priority: 101"), "{detail}");
}
