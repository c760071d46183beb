//! Repeated requests, and responses that wait.

use serde_json::json;
use tcgs::domain::Scope;
use tokio::{
    io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader},
    net::TcpStream,
};

use super::reservations::gated_check;
use crate::support::{
    contract::Coverage,
    eventually::eventually,
    server::{Answer, Server, Setup, TestKey},
};

async fn create(server: &Server, key: &str, query: &str, dataset: &'static str) -> Answer {
    server
        .send("POST", &format!("/v1/jobs{query}"), |request| {
            let request = request.header("content-type", "application/zip");
            request.header("idempotency-key", key).body(dataset)
        })
        .await
}

async fn jobs(server: &Server) -> usize {
    server.get("/v1/jobs").await.expect(200).json()["jobs"].as_array().map_or(0, Vec::len)
}

pub(super) async fn a_request_that_is_sent_again_makes_nothing_again(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let first = create(&server, "one", "?seed=1", "succeed").await.expect(201);
    assert!(!first.headers.contains_key("idempotency-replayed"));
    let path = first.header("location").to_owned();
    server.reaches(&path, "succeeded").await;
    let again = create(&server, "one", "?seed=1", "succeed").await.expect(201);
    assert_eq!(again.header("idempotency-replayed"), "true");
    assert_eq!(again.header("location"), path);
    assert_eq!(again.json()["state"], "succeeded", "the job as it stands now");
    for (query, dataset) in [("?seed=2", "succeed"), ("?seed=1", "succeed differently"), ("", "succeed")] {
        let detail = create(&server, "one", query, dataset).await;
        assert!(detail.expect_problem(422, "idempotency-key-reused").contains("'one'"));
    }
    create(&server, "two", "?seed=1", "succeed").await.expect(201);
    assert_eq!(jobs(&server).await, 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_is_its_projects_and_stands_for_one_path() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let scopes = [Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite];
    let [one, other] = [server.key(&scopes).await, server.key(&scopes).await];
    let send = async |path: &str, key: &TestKey| {
        let sent = server.send("POST", path, |request| {
            let request = request.bearer_auth(&key.key).header("content-type", "application/zip");
            request.header("idempotency-key", "one").body("succeed")
        });
        sent.await
    };
    for key in [&one, &other] {
        let made = send("/v1/jobs", key).await.expect(201);
        assert!(!made.headers.contains_key("idempotency-replayed"), "another project's key is another");
        assert_eq!(made.json()["project_id"], key.project.to_string());
    }
    send("/v1/scenes", &one).await.expect_problem(422, "idempotency-key-reused");
}

/// Two servers of one database do not see each other's requests in flight.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_servers_that_get_one_request_one_makes_the_job_and_the_other_shows_it() {
    let (check, gate, _) = gated_check();
    let coverage = Coverage::default();
    let slow = Server::start_with(&coverage, Setup { check, worker: false, ..Setup::default() }).await;
    let quick = Setup { worker: false, ..Setup::default() };
    let quick = Server::start_in(&coverage, quick, std::sync::Arc::clone(&slow.data)).await;
    let (late, first) = tokio::join!(create(&slow, "one", "", "succeed"), async {
        gate.someone_waits().await;
        let first = create(&quick, "one", "", "succeed").await;
        gate.open();
        first.expect(201)
    });
    let late = late.expect(201);
    assert_eq!(late.header("idempotency-replayed"), "true");
    assert_eq!(late.header("location"), first.header("location"));
    assert_eq!(jobs(&slow).await, 1);
}

pub(super) async fn what_was_refused_is_not_remembered(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    create(&server, "one", "", "bad zip").await.expect(422);
    create(&server, "one", "?seed=many", "succeed").await.expect(422);
    let made = create(&server, "one", "", "succeed").await.expect(201);
    assert!(!made.headers.contains_key("idempotency-replayed"));
    let long = "x".repeat(256);
    for key in ["", long.as_str()] {
        create(&server, key, "", "succeed").await.expect_problem(422, "invalid-idempotency-key");
    }
    let twice = server.send("POST", "/v1/jobs", |request| {
        let request = request.header("content-type", "application/zip").body("succeed");
        request.header("idempotency-key", "a").header("idempotency-key", "b")
    });
    twice.await.expect_problem(422, "invalid-idempotency-key");
    create(&server, &"x".repeat(255), "", "succeed").await.expect(201);
}

pub(super) async fn fifty_requests_with_one_key_make_one_job(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let requests = (0..50).map(|_| create(&server, "one", "", "succeed"));
    let answers = futures_util::future::join_all(requests).await;
    let mut made = std::collections::BTreeSet::new();
    for answer in answers {
        match answer.status {
            201 => drop(made.insert(answer.header("location").to_owned())),
            // So many archives are not received at a time.
            503 => drop(answer.expect_problem(503, "busy")),
            _ => drop(answer.expect_problem(409, "idempotency-in-flight")),
        }
    }
    assert_eq!((made.len(), jobs(&server).await), (1, 1), "{made:?}");
}

/// A request with the key `one`, up to where the service wants its body. It asks for that only once it has taken the key, so
/// that whatever is sent after this comes while the key is in use.
async fn begun(server: &Server, length: usize) -> BufReader<TcpStream> {
    let mut stream = BufReader::new(TcpStream::connect(server.address).await.expect("a connection"));
    let head = format!(
        "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\nIdempotency-Key: one\r\n\
         Expect: 100-continue\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    let mut line = String::new();
    stream.read_line(&mut line).await.expect("an answer");
    assert!(line.starts_with("HTTP/1.1 100"), "the body is wanted now: {line}");
    stream
}

pub(super) async fn a_request_is_in_flight_until_it_is_answered_and_no_longer(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let mut slow = begun(&server, 7).await;
    let detail = create(&server, "one", "", "succeed").await;
    assert!(detail.expect_problem(409, "idempotency-in-flight").contains("still being answered"));
    create(&server, "two", "", "succeed").await.expect(201);
    slow.write_all(b"succeed").await.expect("sent");
    let mut answer = String::new();
    slow.read_to_string(&mut answer).await.expect("an answer");
    assert!(answer.contains("HTTP/1.1 201"), "{answer}");
    let again = create(&server, "one", "", "succeed").await.expect(201);
    assert_eq!(again.header("idempotency-replayed"), "true");
    assert!(answer.contains(again.header("location")), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_whose_request_broke_off_can_be_used_again() {
    let server = Server::start(&Coverage::default()).await;
    let mut broken = begun(&server, 100).await;
    broken.write_all(b"succeed").await.expect("sent");
    create(&server, "one", "", "succeed").await.expect_problem(409, "idempotency-in-flight");
    drop(broken);
    eventually("the broken request is given up", async || {
        let answer = create(&server, "one", "", "succeed").await;
        let is_made = answer.status == 201;
        if is_made {
            assert!(!answer.headers.contains_key("idempotency-replayed"), "the broken one made nothing");
        } else {
            answer.expect_problem(409, "idempotency-in-flight");
        }
        is_made
    })
    .await;
    assert_eq!(jobs(&server).await, 1);
}

pub(super) async fn an_answer_waits_for_the_job_as_long_as_is_preferred(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let prefer = |method: &'static str, path: String, wait: &'static str, dataset: Option<&'static str>| {
        let server = &server;
        async move {
            let request = server.send(method, &path, |request| {
                let request = request.header("prefer", format!("respond-async, {wait}"));
                match dataset {
                    Some(dataset) => request.header("content-type", "application/zip").body(dataset),
                    None => request,
                }
            });
            request.await
        }
    };
    let done = prefer("POST", "/v1/jobs".into(), "wait=600", Some("succeed")).await.expect(201);
    assert_eq!(done.header("preference-applied"), "wait=60");
    assert_eq!(done.json()["state"], "succeeded");
    assert!(!done.headers.contains_key("retry-after"));

    let waiting = server.create("wait").await;
    let shown = prefer("GET", waiting.clone(), "wait=0", None).await.expect(200);
    assert_eq!(shown.header("preference-applied"), "wait=0");
    assert_ne!(shown.json()["state"], "cancelled");
    let (shown, _) = tokio::join!(prefer("GET", waiting.clone(), "wait=60", None), async {
        server.runner.gate.someone_waits().await;
        server.post(&format!("{waiting}/cancel")).await.expect(202)
    });
    assert_eq!(shown.expect(200).json()["state"], "cancelled");
    let plain = prefer("GET", waiting, "color=red", None).await.expect(200);
    assert!(!plain.headers.contains_key("preference-applied"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_wait_ends_with_the_server_and_is_not_granted_to_too_many() {
    let limits = tcgs::http::config::RequestLimits { waits: 1, ..Setup::default().limits };
    let server =
        Server::start_with(&Coverage::default(), Setup { worker: false, limits, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let wait = || server.send("GET", &job, |request| request.header("prefer", "wait=60"));
    let (first, second) = (Box::pin(wait()), Box::pin(wait()));
    let (refused, waiting) = futures_util::future::select(first, second).await.factor_first();
    assert!(!refused.expect(200).headers.contains_key("preference-applied"));
    server.shutdown.cancel();
    let ended = waiting.await.expect(200);
    assert_eq!((ended.header("preference-applied"), &ended.json()["state"]), ("wait=60", &json!("queued")));
}
