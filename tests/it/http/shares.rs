//! Links that open a job for those without a key: what they open, and how they end.

use std::time::Duration;

use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{domain::Scope, http::config::RequestLimits};

use super::{
    access::{stopped_clock, with_key},
    report::parse,
};
use crate::support::{
    contract::Coverage,
    eventually::eventually,
    server::{Answer, Server, Setup, TestKey},
};

/// A finished job of a key.
async fn finished(server: &Server, key: &TestKey) -> String {
    let created = server.send("POST", "/v1/jobs", |request| {
        request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
    });
    let job = created.await.expect(201).header("location").to_owned();
    eventually("the job has succeeded", async || {
        with_key(server, "GET", &job, &key.key).await.json()["state"] == "succeeded"
    })
    .await;
    job
}

async fn share(server: &Server, job: &str, key: &TestKey, body: Option<Value>) -> Answer {
    server
        .send("POST", &format!("{job}/shares"), |request| {
            let request = request.bearer_auth(&key.key);
            body.into_iter().fold(request, |request, body| request.json(&body))
        })
        .await
}

pub(super) async fn a_link_opens_a_jobs_page_and_what_it_shows_and_nothing_else(coverage: Coverage) {
    let (setup, clock) = stopped_clock();
    let server = Server::start_with(&coverage, Setup { worker: true, ..setup }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let (job, other) = (finished(&server, &key).await, finished(&server, &key).await);
    let made = share(&server, &job, &key, None).await.expect(201);
    let (location, link) = (made.header("location").to_owned(), made.json());
    let url = link["url"].as_str().expect("a path").to_owned();
    let base = url.strip_suffix("/report").expect("of the report");
    assert!(base.starts_with("/s/") && base.ends_with(&job), "{url}");

    let answer = server.get(&url).await.expect(200);
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = parse(&page);
    for hidden in ["All scenes", "id=\"share\"", "JSON"] {
        assert!(!page.contains(hidden), "{hidden} is not for those without a key");
    }
    for link in elements.iter().filter(|element| element.name == "a") {
        server.get(&format!("{base}/{}", link.attributes["href"])).await.expect(200);
    }
    for opened in ["view?frame=test/r_0", "thumbnail", "preview", "series", "events", "artifact"] {
        server.get(&format!("{base}/{opened}")).await.expect(200);
        server.send("HEAD", &format!("{base}/{opened}"), |request| request).await.expect(200);
    }
    // Script and module of the viewer lie outside of the link.
    let viewer = server.get(&format!("{base}/viewer")).await.expect(200);
    let viewer = String::from_utf8(viewer.body.to_vec()).expect("UTF-8");
    assert!(viewer.contains(r#""../../../../../viewer/module.wasm""#), "{viewer}");
    let prefix = base.strip_suffix(&job).expect("the job's path at the end");
    let closed = [
        job.clone(),
        format!("{job}/shares"),
        format!("{job}/artifacts"),
        format!("{other}/report"),
        format!("{other}/view?frame=test/r_0"),
        "/v1/jobs".to_owned(),
        "/v1/usage".to_owned(),
        "/metrics".to_owned(),
        "/nothing".to_owned(),
        "/".to_owned(),
    ];
    for path in closed {
        server.get(&format!("{prefix}{path}")).await.expect_problem(404, "not-found");
    }
    for (method, path) in
        [("POST", "cancel"), ("POST", "shares"), ("POST", "views"), ("DELETE", ""), ("POST", "report")]
    {
        let path = format!("{base}/{path}");
        let answer = server.send(method, path.trim_end_matches('/'), |request| request).await;
        answer.expect_problem(404, "not-found");
    }
    server.get(&format!("{job}/report")).await.expect_problem(401, "no-key");
    let last = if url.contains('0') { ('0', "1") } else { ('1', "2") };
    let forged = url.replacen(last.0, last.1, 1);
    server.get(&forged).await.expect_problem(404, "not-found");
    server.get(&format!("/s/17{job}/report")).await.expect_problem(404, "not-found");

    // It is over once it is revoked, or by its time.
    let listed = with_key(&server, "GET", &format!("{job}/shares"), &key.key).await.expect(200).json();
    assert_eq!(listed, json!({ "shares": [link] }));
    with_key(&server, "DELETE", &location, &key.key).await.expect(204);
    server.get(&url).await.expect_problem(404, "not-found");
    with_key(&server, "DELETE", &location, &key.key).await.expect_problem(404, "share-not-found");
    let short = share(&server, &job, &key, Some(json!({ "expires_in_s": 60 }))).await.expect(201).json();
    let short = short["url"].as_str().expect("a path");
    clock.advance(SignedDuration::from_secs(59));
    server.get(short).await.expect(200);
    clock.advance(SignedDuration::from_secs(1));
    server.get(short).await.expect_problem(404, "not-found");
    assert_eq!(
        with_key(&server, "GET", &format!("{job}/shares"), &key.key).await.json(),
        json!({ "shares": [] })
    );
}

pub(super) async fn a_link_may_open_one_thing_alone(coverage: Coverage) {
    let (setup, _) = stopped_clock();
    let server = Server::start_with(&coverage, Setup { worker: true, ..setup }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let job = finished(&server, &key).await;
    for target in ["view?frame=test/r_0&width=40", "artifact"] {
        let link = share(&server, &job, &key, Some(json!({ "path": target }))).await.expect(201).json();
        assert_eq!(link["path"], target);
        let url = link["url"].as_str().expect("a path");
        assert!(url.ends_with(&format!("{job}/{target}")), "{url}");
        server.get(url).await.expect(200);
        let base = url.strip_suffix(target).expect("the target at the end");
        for other in ["report", "view?frame=test/r_1&width=40", "view?frame=test/r_0", "thumbnail", "events"]
        {
            server.get(&format!("{base}{other}")).await.expect_problem(404, "not-found");
        }
    }
    let path = |text: &str| Some(json!({ "path": text }));
    let long = format!("view?frame={}", "x".repeat(5000));
    for refused in ["", "cancel", "shares", "../jobs", "artifacts", "view#x", "view?frame=a b", &long] {
        share(&server, &job, &key, path(refused)).await.expect_problem(422, "invalid-parameter");
    }
    for seconds in [0, 31_622_401] {
        let body = Some(json!({ "expires_in_s": seconds }));
        share(&server, &job, &key, body).await.expect_problem(422, "invalid-parameter");
    }
    let post = async |kind: &'static str, body: &'static str| {
        let path = format!("{job}/shares");
        let request = server.send("POST", &path, |request| {
            request.bearer_auth(&key.key).header("content-type", kind).body(body)
        });
        request.await
    };
    post("application/json", "{").await.expect_problem(400, "malformed-json");
    post("text/plain", "{}").await.expect_problem(415, "unsupported-media-type");
    for query in ["shares?limit=3", "shares/0190a5d8-0000-7000-8000-000000000000?x=1"] {
        let method = if query.contains('/') { "DELETE" } else { "GET" };
        let answer = with_key(&server, method, &format!("{job}/{query}"), &key.key).await;
        answer.expect_problem(422, "invalid-parameter");
    }
    with_key(&server, "DELETE", &format!("{job}/shares/17"), &key.key)
        .await
        .expect_problem(404, "share-not-found");

    // Two are there already.
    for _ in 2..100 {
        share(&server, &job, &key, None).await.expect(201);
    }
    share(&server, &job, &key, None).await.expect_problem(409, "too-many-shares");
}

pub(super) async fn a_link_of_a_page_alone_opens_what_the_page_loads(coverage: Coverage) {
    let (setup, _) = stopped_clock();
    let server = Server::start_with(&coverage, Setup { worker: true, ..setup }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let job = finished(&server, &key).await;
    let page = async |target: &str| {
        let made = share(&server, &job, &key, Some(json!({ "path": target }))).await.expect(201);
        let url = made.json()["url"].as_str().expect("a path").to_owned();
        let page = String::from_utf8(server.get(&url).await.expect(200).body.to_vec()).expect("UTF-8");
        (url.strip_suffix(target).expect("the target at the end").to_owned(), page)
    };
    let (base, viewer) = page("viewer").await;
    for loaded in ["artifact", "view?position=4,0,0&look_at=0,0,0&width=40", "view?frame=test/r_0&width=40"] {
        server.get(&format!("{base}{loaded}")).await.expect(200);
    }
    for other in ["report", "events", "preview", "export?format=ply", "thumbnail"] {
        server.get(&format!("{base}{other}")).await.expect_problem(404, "not-found");
    }
    for element in parse(&viewer).iter().filter(|element| element.name == "a") {
        server.get(&format!("{base}{}", element.attributes["href"])).await.expect(200);
    }

    let (base, report) = page("report").await;
    for loaded in ["events", "preview"] {
        server.get(&format!("{base}{loaded}")).await.expect(200);
    }
    for other in ["viewer", "artifact", "view?frame=test/r_0", "report?format=csv", "export?format=spz"] {
        server.get(&format!("{base}{other}")).await.expect_problem(404, "not-found");
    }
    let links: Vec<_> = parse(&report).into_iter().filter(|element| element.name == "a").collect();
    assert!(links.is_empty(), "{links:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn holders_of_one_link_leave_the_places_of_other_links_free() {
    let (setup, _) = stopped_clock();
    let limits = RequestLimits { streams_per_caller: 1, ..setup.limits.clone() };
    let server = Server::start_with(&Coverage::default(), Setup { worker: true, limits, ..setup }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let job = finished(&server, &key).await;
    let mut streams = Vec::new();
    for _ in 0..2 {
        let link = share(&server, &job, &key, None).await.expect(201).json();
        let url =
            link["url"].as_str().expect("a path").replace("/report", "/stream?orbit=1000&frames=2&fps=1");
        let mut open = server.open("GET", &url, |request| request).await;
        open.chunk().await.expect("a body").expect("a first part");
        server.get(&url).await.expect_problem(429, "too-many-views");
        streams.push(open);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_link_has_opened_ends_soon_after_the_link() {
    let (setup, clock) = stopped_clock();
    let limits = RequestLimits { key_recheck_interval: Duration::from_millis(5), ..setup.limits.clone() };
    let server = Server::start_with(&Coverage::default(), Setup { worker: true, limits, ..setup }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let job = finished(&server, &key).await;
    for is_revoked in [true, false] {
        let made = share(&server, &job, &key, Some(json!({ "expires_in_s": 60 }))).await.expect(201);
        let url = made.json()["url"].as_str().expect("a path").to_owned();
        let url = url.replace("/report", "/stream?orbit=1000&frames=2&fps=1");
        let mut stream = server.open("GET", &url, |request| request).await;
        stream.chunk().await.expect("a body").expect("a first part");
        match is_revoked {
            true => drop(with_key(&server, "DELETE", made.header("location"), &key.key).await.expect(204)),
            false => clock.advance(SignedDuration::from_secs(60)),
        }
        // Half an hour of it is left.
        while let Ok(Some(_)) = stream.chunk().await {}
    }
}

pub(super) async fn every_replica_knows_the_links_of_the_others(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let link = server.post(&format!("{job}/shares")).await.expect(201).json();
    let url = link["url"].as_str().expect("a path");
    let replica =
        Server::start_in(&coverage, Setup { worker: false, ..Setup::default() }, server.data.clone()).await;
    replica.get(url).await.expect(200);
    let again = replica.get(&format!("{job}/shares")).await.expect(200).json();
    assert_eq!(again["shares"][0]["url"], url, "and signs as they do");
}
