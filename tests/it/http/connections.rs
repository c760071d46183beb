//! Connections and bodies that stall, break off or are too many at a time.

use std::{collections::BTreeSet, num::NonZeroU32, sync::Arc, time::Duration};

use serde_json::json;
use tcgs::domain::{ManualClock, ProjectId, Scope};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};

use crate::support::{
    contract::{self, Coverage},
    eventually::{eventually, within},
    server::{Server, Setup},
};

pub(super) fn tight_limits() -> tcgs::http::config::RequestLimits {
    tcgs::http::config::RequestLimits {
        upload_bytes: 10,
        json_bytes: 100,
        body_idle_timeout: Duration::from_millis(50),
        ..Default::default()
    }
}

/// Sends bytes as they are, then maybe closes the sending half, and reads the answer to its end.
async fn raw(server: &Server, request: &str, close: bool) -> Vec<u8> {
    let mut stream = TcpStream::connect(server.address).await.expect("connects");
    stream.write_all(request.as_bytes()).await.expect("sent");
    if close {
        stream.shutdown().await.expect("closed");
    }
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an end");
    answer
}

/// Checks a raw answer against the contract and returns its status.
pub(super) fn check_raw(server: &Server, method: &str, path: &str, answer: &[u8]) -> u16 {
    let text = String::from_utf8_lossy(answer);
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no answer: {text}"));
    let mut lines = head.lines();
    let status = lines.next().and_then(|line| line.split(' ').nth(1)?.parse().ok()).expect("a status");
    let headers = lines
        .filter_map(|line| line.split_once(": "))
        .map(|(name, value)| (name.parse().expect("a name"), value.parse().expect("a value")))
        .collect();
    server.coverage.check(method, path, status, &headers, body.as_bytes());
    status
}

pub(super) async fn bodies_that_break_off_or_dawdle_are_given_up(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { limits: tight_limits(), ..Setup::default() }).await;
    let job = server.create("succeed").await;
    server.reaches(&job, "succeeded").await;
    let project = format!("/v1/projects/{}", ProjectId::DEFAULT);
    let key = format!("/v1/keys/{}", ProjectId::DEFAULT);
    for (method, path, media_type) in [
        ("POST", "/v1/jobs".to_owned(), "application/zip"),
        ("POST", "/v1/jobs".to_owned(), "multipart/form-data; boundary=b"),
        ("POST", "/v1/scenes".to_owned(), "application/zip"),
        ("POST", "/v1/scenes".to_owned(), "multipart/form-data; boundary=b"),
        ("PATCH", job.clone(), "application/json"),
        ("POST", "/v1/scenes".to_owned(), "application/json"),
        ("POST", format!("{job}/views"), "application/json"),
        ("POST", format!("{job}/retry"), "application/json"),
        ("POST", "/v1/webhook-endpoints".to_owned(), "application/json"),
        ("POST", "/v1/estimate".to_owned(), "application/json"),
        ("POST", "/v1/projects".to_owned(), "application/json"),
        ("PATCH", project.clone(), "application/json"),
        ("POST", "/v1/keys".to_owned(), "application/json"),
        ("PATCH", key.clone(), "application/json"),
        ("POST", format!("{job}/animation"), "application/json"),
    ] {
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {media_type}\r\nConnection: close\r\n"
        );
        let slow = raw(&server, &format!("{head}Content-Length: 9\r\n\r\n{{\"v"), false).await;
        assert_eq!(check_raw(&server, method, &path, &slow), 408);
        let broken =
            raw(&server, &format!("{head}Transfer-Encoding: chunked\r\n\r\nnot a length\r\n"), false).await;
        assert_eq!(check_raw(&server, method, &path, &broken), 400);
    }
    let in_job = ["views", "animation"].map(|part| format!("{job}/{part}"));
    let others = [
        ("POST", "/v1/projects".to_owned()),
        ("PATCH", project),
        ("POST", "/v1/keys".to_owned()),
        ("PATCH", key),
    ];
    for (method, path) in in_job.map(|path| ("POST", path)).into_iter().chain(others) {
        let long = json!({ "views": vec![json!({ "frame": "test/r_0" }); 50] });
        let answer = server.send(method, &path, |request| request.json(&long)).await;
        answer.expect_problem(413, "body-too-large");
        let text = |request: reqwest::RequestBuilder| request.header("content-type", "text/plain").body("{}");
        server.send(method, &path, text).await.expect_problem(415, "unsupported-media-type");
    }
    let request_body = json!({ "url": format!("https://example.com/{}", "a".repeat(200)) });
    server.post_json("/v1/webhook-endpoints", &request_body).await.expect_problem(413, "body-too-large");
    server.upload("", "succeed").await.expect(201);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_body_in_json_has_its_bound_whether_its_length_is_announced_or_not() {
    let server = Server::start_with(
        &Coverage::default(),
        Setup { limits: tight_limits(), worker: false, ..Setup::default() },
    )
    .await;
    for (length, status) in [(100, 201), (101, 413)] {
        for is_announced in [true, false] {
            let mut text = r#"{"url": "https://example.com/"}"#.to_owned();
            text.push_str(&" ".repeat(length - text.len()));
            let pieces: Vec<_> =
                text.as_bytes().chunks(40).map(|piece| Ok::<_, std::io::Error>(piece.to_vec())).collect();
            let body = match is_announced {
                true => reqwest::Body::from(text),
                false => reqwest::Body::wrap_stream(futures_util::stream::iter(pieces)),
            };
            let sent = server.send("POST", "/v1/webhook-endpoints", |request| {
                request.header("content-type", "application/json").body(body)
            });
            assert_eq!(sent.await.status, status, "{length} bytes, announced: {is_announced}");
        }
    }
}

#[tokio::test]
async fn a_connection_that_dawdles_over_its_headers_is_closed() {
    let setup = Setup { header_timeout: Duration::from_millis(50), ..Setup::default() };
    let server = Server::start_with(&Coverage::default(), setup).await;
    let answer = raw(&server, "GET /healthz HTTP/1.1\r\nHost: loc", false).await;
    assert!(!String::from_utf8_lossy(&answer).contains("200"), "the read ended because the server closed");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_early_refusal_reaches_a_client_that_sends_its_whole_body_first() {
    let server = Server::start(&Coverage::default()).await;
    let size = 32 << 20;
    for (query, status) in [("?preset=fast", 422), ("", 413)] {
        let mut stream = TcpStream::connect(server.address).await.expect("connects");
        let head = format!(
            "POST /v1/jobs{query} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\n\
             Connection: close\r\nContent-Length: {size}\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).await.expect("sent");
        stream.write_all(&vec![b'x'; size]).await.expect("the server takes the whole body");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.expect("an end");
        assert_eq!(check_raw(&server, "POST", "/v1/jobs", &answer), status);
    }
}

/// Asks every operation, and what is none, with a body that is longer than what is read on the way, and returns the statuses.
async fn send_whole_bodies_first(server: &Server, headers: &str) -> BTreeSet<u16> {
    let body = vec![b'x'; 768 << 10];
    let guarded = contract::guarded();
    let guarded = guarded.iter().map(|operation| (operation.method, operation.path()));
    let others = [("POST", "/healthz"), ("PUT", "/v1/jobs"), ("POST", "/v1/nothing"), ("POST", "/elsewhere")];
    let mut seen = BTreeSet::new();
    for (method, path) in guarded.chain(others.map(|(method, path)| (method, path.to_owned()))) {
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: localhost\r\n{headers}Connection: close\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        let mut stream = TcpStream::connect(server.address).await.expect("connects");
        let sent = async {
            stream.write_all(head.as_bytes()).await?;
            stream.write_all(&body).await?;
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).await?;
            Ok::<_, std::io::Error>(answer)
        };
        let answer = sent.await.unwrap_or_else(|error| panic!("{method} {path}: {error}"));
        seen.insert(check_raw(server, method, &path, &answer));
    }
    seen
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_is_answered_reaches_a_client_that_sends_its_whole_body_first() {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let mut setup = Setup { worker: false, clock, ..Setup::default() };
    setup.limits.access.failures_per_minute = NonZeroU32::new(10).expect("ten");
    let server = Server::start_with(&Coverage::default(), setup).await;
    let seen = send_whole_bodies_first(&server, "").await;
    assert!([200, 204, 404, 405, 412, 415].iter().all(|status| seen.contains(status)), "{seen:?}");
    let typed = "Content-Type: application/json\r\nTus-Resumable: 1.0.0\r\n";
    let seen = send_whole_bodies_first(&server, typed).await;
    assert!([200, 204, 400, 404, 405].iter().all(|status| seen.contains(status)), "{seen:?}");

    let narrow = server.key(&[Scope::DatasetsWrite]).await;
    let slow = server.key_at_rate(&Scope::ALL, NonZeroU32::MIN).await;
    for (key, status) in [(None, 401), (Some(narrow.key), 403), (Some(slow.key), 429)] {
        let header = key.map(|key| format!("Authorization: Bearer {key}\r\n")).unwrap_or_default();
        let seen = send_whole_bodies_first(&server, &header).await;
        assert!(seen.contains(&status), "{seen:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_read_of_a_strangers_body_has_an_end() {
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::JobsWrite]).await;
    for (authorization, bytes, closes) in [
        (String::new(), 1 << 20, false),
        (String::new(), (1 << 20) + 1, true),
        (format!("Authorization: Bearer {}\r\n", key.key), 2 << 20, false),
    ] {
        let head = format!(
            "POST /v1/jobs?preset=fast HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\n{authorization}\
             Content-Length: {bytes}\r\n\r\n"
        );
        let (mut from, mut to) = TcpStream::connect(server.address).await.expect("connects").into_split();
        let sending = tokio::spawn(async move {
            // The service may stop reading.
            let _ = to.write_all(head.as_bytes()).await;
            let _ = to.write_all(&vec![b'x'; bytes]).await;
            to
        });
        let mut answer = Vec::new();
        while !answer.windows(4).any(|window| window == b"\r\n\r\n") {
            assert!(from.read_buf(&mut answer).await.expect("an answer") > 0, "{bytes} bytes");
        }
        let head = String::from_utf8_lossy(&answer).to_lowercase();
        assert_eq!(head.contains("connection: close\r\n"), closes, "{bytes} bytes: {head}");
        drop(from);
        drop(sending.await.expect("joined"));
    }
}

#[tokio::test]
async fn a_client_that_waits_for_leave_to_send_is_refused_without_it() {
    let server = Server::start(&Coverage::default()).await;
    for (path, status) in
        [("/v1/jobs?preset=fast", 422), ("/v1/jobs/17/retry", 404), ("/v1/jobs/17/cancel", 404)]
    {
        let request = format!(
            "POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\nExpect: 100-continue\r\n\
             Content-Length: 1000\r\n\r\n"
        );
        let answer = raw(&server, &request, false).await;
        assert_eq!(check_raw(&server, "POST", path, &answer), status, "and not 100");
        let text = String::from_utf8_lossy(&answer).to_lowercase();
        assert!(
            text.contains("connection: close\r\n"),
            "what comes next cannot be told from the body: {text}"
        );
    }
}

#[tokio::test]
async fn connections_beyond_the_cap_wait_for_a_place() {
    let server =
        Server::start_with(&Coverage::default(), Setup { max_connections: 1, ..Setup::default() }).await;
    let mut first = TcpStream::connect(server.address).await.expect("connects");
    first.write_all(b"GET /healthz HTTP/1.1\r\nHost: loc").await.expect("sent");
    let mut second = Box::pin(server.get("/healthz"));
    let early = tokio::time::timeout(Duration::from_millis(50), &mut second).await;
    assert!(early.is_err(), "there is no place yet");
    drop(first);
    second.await.expect(200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shutdown_finishes_open_requests_and_takes_no_more() {
    let mut server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let path = format!("{job}/view?position=1,0,0&look_at=0,0,0&width=17");
    let (open, ()) = tokio::join!(server.get(&path), async {
        server.renderer.gate.someone_waits().await;
        server.shutdown.cancel();
        let is_closed = async || TcpStream::connect(server.address).await.is_err();
        eventually("nobody listens", is_closed).await;
        server.renderer.gate.open();
    });
    open.expect(200);
    (&mut server.serving).await.expect("the accept loop ends");
}

#[tokio::test]
async fn a_body_that_only_dribbles_is_given_up_though_it_never_pauses() {
    let limits = tcgs::http::config::RequestLimits {
        body_idle_timeout: Duration::from_millis(200),
        min_body_rate: 1 << 20,
        ..Default::default()
    };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let stream = TcpStream::connect(server.address).await.expect("connects");
    let (mut from, mut to) = stream.into_split();
    let head = "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\nConnection: close\r\n\
                Content-Length: 100000\r\n\r\n";
    to.write_all(head.as_bytes()).await.expect("sent");
    let dribble = tokio::spawn(async move {
        while to.write_all(b"x").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    });
    let mut answer = Vec::new();
    // The server may close while there are bytes that it has not read, which resets the connection after the answer.
    let _ = within("an answer", from.read_to_end(&mut answer)).await;
    assert_eq!(check_raw(&server, "POST", "/v1/jobs", &answer), 408);
    dribble.abort();
}

#[tokio::test]
async fn a_client_that_takes_nothing_of_its_answers_loses_its_connection() {
    let tune = |config: &mut tcgs::http::HttpConfig| config.write_timeout = Duration::from_millis(50);
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let connections = async || {
        let text = server.get("/metrics").await.expect(200).body;
        let text = String::from_utf8(text.to_vec()).expect("UTF-8");
        let line = text.lines().find_map(|line| line.strip_prefix("http_connections "));
        line.expect("the series").parse::<u32>().expect("a count")
    };
    let mut idle = TcpStream::connect(server.address).await.expect("connects");
    eventually("both connections are counted", async || connections().await >= 2).await;
    // More answers than any socket's buffers hold.
    let requests = "GET /openapi.yaml HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(1000);
    idle.write_all(requests.as_bytes()).await.expect("sent");
    eventually("the idle connection is closed", async || connections().await <= 1).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_takes_too_little_of_its_answers_loses_its_connection() {
    let tune = |config: &mut tcgs::http::HttpConfig| {
        config.write_timeout = Duration::from_millis(500);
        config.min_response_rate = 1 << 40;
    };
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let mut stream = TcpStream::connect(server.address).await.expect("connects");
    let (requests, each) = (500, server.get("/openapi.yaml").await.expect(200).body.len());
    let text = "GET /openapi.yaml HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(requests);
    stream.write_all(text.as_bytes()).await.expect("sent");
    let (mut taken, mut piece) = (0, vec![0; 64 << 10]);
    while let Ok(bytes @ 1..) = stream.read(&mut piece).await {
        taken += bytes;
        // It never stops for long, but the service waits for it all the same.
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    assert!(taken < requests * each, "{taken} bytes were sent");
}

#[tokio::test]
async fn one_address_cannot_take_every_place() {
    let tune = |config: &mut tcgs::http::HttpConfig| config.max_connections_per_address = 1;
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let mut first = TcpStream::connect(server.address).await.expect("connects");
    first.write_all(b"GET /healthz HTTP/1.1\r\nHost: loc").await.expect("sent");
    let mut second = TcpStream::connect(server.address).await.expect("the system connects");
    let mut answer = Vec::new();
    let ended = second.read_to_end(&mut answer).await;
    assert!(ended.is_err() || answer.is_empty(), "closed without an answer");
    first.write_all(b"alhost\r\nConnection: close\r\n\r\n").await.expect("sent");
    first.read_to_end(&mut answer).await.expect("an end");
    assert_eq!(check_raw(&server, "GET", "/healthz", &answer), 200, "the first has its place");
    drop(first);
    let mut metrics = String::new();
    eventually("the place is free again", async || {
        let mut stream = TcpStream::connect(server.address).await.expect("the system connects");
        let mut answer = Vec::new();
        let asked = async {
            stream
                .write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                .await?;
            stream.read_to_end(&mut answer).await
        };
        let is_answered = asked.await.is_ok_and(|bytes| bytes > 0);
        metrics = String::from_utf8_lossy(&answer).into_owned();
        is_answered
    })
    .await;
    let refused = metrics.lines().find_map(|line| line.strip_prefix("http_connections_refused_total "));
    assert!(refused.is_some_and(|count| count != "0"), "{metrics}");
}

#[tokio::test]
async fn a_trusted_proxy_has_the_places_of_all_its_clients() {
    let tune = |config: &mut tcgs::http::HttpConfig| {
        config.max_connections_per_address = 1;
        let network = "127.0.0.1".parse().expect("a network");
        config.limits.access.trusted_proxies = tcgs::http::TrustedProxies(vec![network]);
    };
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let mut open = Vec::new();
    for _ in 0..3 {
        open.push(TcpStream::connect(server.address).await.expect("connects"));
    }
    for stream in &mut open {
        stream
            .write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            .await
            .expect("sent");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.expect("an end");
        assert_eq!(check_raw(&server, "GET", "/healthz", &answer), 200);
    }
}

#[tokio::test]
async fn heads_that_are_too_long_are_problems() {
    let server = Server::start(&Coverage::default()).await;
    let uri = server.get(&format!("/v1/jobs?cursor={}", "x".repeat(9 << 10))).await;
    assert!(uri.expect_problem(414, "uri-too-long").contains("8192"));
    let long = "x".repeat(33 << 10);
    let headers = server.send("GET", "/v1/jobs", |request| request.header("x-long", &long)).await;
    assert!(headers.expect_problem(431, "headers-too-large").contains("32768"));
    // Beyond the connection's buffer there is no request to answer, but still a status.
    let endless = format!("GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Long: {}", "x".repeat(70 << 10));
    assert!(raw(&server, &endless, false).await.starts_with(b"HTTP/1.1 431 "));
}
