//! Cross-site requests are refused. Over sockets, since HTTP clients would not send most of them.

use std::{net::SocketAddr, sync::Arc};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use serde_json::Value;
use tcgs::domain::Scope;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};

use super::access::{UNKNOWN, with_key};
use crate::support::{
    contract::Coverage,
    dataset,
    faults::Failing,
    server::{Server, Setup},
    service::Service,
};

/// An answer as it came.
struct Raw {
    status: u16,
    head: String,
    body: Vec<u8>,
}

impl Raw {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    #[track_caller]
    fn expect(self, status: u16, what: &str) -> Self {
        assert_eq!(self.status, status, "{what}: {}", String::from_utf8_lossy(&self.body));
        self
    }

    #[track_caller]
    fn expect_problem(self, status: u16, kind: &str, what: &str) {
        let problem = self.expect(status, what).json();
        assert_eq!(problem["type"], format!("urn:tcgs:problem:{kind}"), "{what}: {problem:#}");
    }
}

/// Sends a head, given without the line that closes the connection, and a body, and reads the answer, which must bar other origins
/// from showing it.
async fn send(address: &str, head: &str, body: &[u8]) -> Raw {
    let mut stream = TcpStream::connect(address).await.expect("connects");
    let length = if body.is_empty() { String::new() } else { format!("Content-Length: {}\r\n", body.len()) };
    stream.write_all(format!("{head}{length}Connection: close\r\n\r\n").as_bytes()).await.expect("sent");
    stream.write_all(body).await.expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an end");
    let end = answer.windows(4).position(|window| window == b"\r\n\r\n").expect("a head");
    let head = String::from_utf8(answer[..end].to_vec()).expect("ASCII").to_lowercase();
    assert!(head.contains("cross-origin-resource-policy: same-origin"), "{head}");
    assert!(head.contains("x-request-id: ") && head.contains("x-content-type-options: nosniff"), "{head}");
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
    Raw { status, head, body: answer[end + 4..].to_vec() }
}

async fn without_workers() -> (tempfile::TempDir, Service) {
    let data = tempfile::tempdir().expect("a folder");
    let service = Service::start_with(data.path(), ["--workers", "0"]).await;
    (data, service)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_keys_the_service_answers_to_loopback_names_only() {
    let (_data, service) = without_workers().await;
    let address = service.address();
    let port = address.parse::<SocketAddr>().expect("an address").port();
    for own in [
        "localhost",
        "LOCALHOST:1",
        "127.0.0.1",
        "127.1.2.3:80",
        "[::1]",
        "[::1]:8080",
        "tcgs.localhost",
        address,
    ] {
        let head = format!("GET /v1/jobs HTTP/1.1\r\nHost: {own}\r\n");
        send(address, &head, b"").await.expect(200, own);
    }
    let foreign = [
        "evil.example".to_owned(),
        format!("evil.example:{port}"),
        "127.0.0.1.evil.example".into(),
        "0.0.0.0".into(),
    ];
    for host in &foreign {
        for asked in [
            "GET /v1/jobs",
            "HEAD /v1/jobs",
            "GET /metrics",
            "GET /healthz",
            "GET /openapi.yaml",
            "GET /nowhere",
            "OPTIONS /v1/uploads",
            "POST /v1/jobs",
            "POST /v1/jobs/0190a5d8-0000-7000-8000-000000000000/cancel",
            "DELETE /v1/jobs/0190a5d8-0000-7000-8000-000000000000",
        ] {
            let head = format!(
                "{asked} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nSec-Fetch-Site: same-origin\r\n"
            );
            let answer = send(address, &head, b"").await;
            if asked.starts_with("HEAD") {
                answer.expect(421, host);
            } else {
                answer.expect_problem(421, "foreign-host", &format!("{asked} at {host}"));
            }
        }
        let absolute = format!("GET http://{host}/v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\n");
        send(address, &absolute, b"").await.expect_problem(421, "foreign-host", &absolute);
        let old = format!("GET /v1/jobs HTTP/1.0\r\nHost: {host}\r\n");
        send(address, &old, b"").await.expect_problem(421, "foreign-host", &old);
        let both = format!("GET http://127.0.0.1/v1/jobs HTTP/1.1\r\nHost: {host}\r\n");
        send(address, &both, b"").await.expect_problem(421, "foreign-host", &both);
    }
    for own in [
        "GET http://localhost/v1/jobs HTTP/1.1\r\nHost: localhost\r\n",
        "GET http://127.0.0.1:8080/v1/jobs HTTP/1.1\r\nHost: 127.0.0.1:8080\r\n",
        "GET /v1/jobs HTTP/1.0\r\n",
    ] {
        send(address, own, b"").await.expect(200, own);
    }
    for invalid in [
        "GET /v1/jobs HTTP/1.1\r\n",
        "GET /v1/jobs HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n",
        "GET /v1/jobs HTTP/1.1\r\nHost: me@localhost\r\n",
        "GET /v1/jobs HTTP/1.1\r\nHost: \r\n",
    ] {
        send(address, invalid, b"").await.expect_problem(400, "invalid-header", invalid);
    }
}

/// What marks a request as another page's, each by itself.
const FOREIGN: [&str; 6] = [
    "Sec-Fetch-Site: cross-site\r\n",
    "Sec-Fetch-Site: same-site\r\nOrigin: http://localhost:3000\r\n",
    "Origin: http://evil.example\r\n",
    "Origin: null\r\n",
    "Sec-Fetch-Site: cross-site\r\nOrigin: http://127.0.0.1:8080\r\n",
    "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: iframe\r\n",
];
const FOLLOWED: &str =
    "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: document\r\n";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_of_other_sites_change_and_read_nothing() {
    let (_data, service) = without_workers().await;
    let address = service.address();
    let zip = dataset::zip();
    let made = service.upload("", zip.clone()).await.expect(201);
    let (job, tag) = (made.header("location").to_owned(), made.header("etag").to_owned());
    let asked = async |method: &str, path: &str, marks: &str, kind: &str, body: &[u8]| {
        let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: {kind}\r\n{marks}");
        send(address, &head, body).await
    };
    let json = br#"{"url": "https://example.com/"}"#;
    for marks in FOREIGN.into_iter().chain([FOLLOWED]) {
        for (method, path, kind, body) in [
            ("POST", "/v1/jobs".to_owned(), "application/zip", &zip[..]),
            ("POST", "/v1/jobs".to_owned(), "text/plain", &zip[..]),
            ("POST", "/v1/scenes".to_owned(), "application/zip", &zip[..]),
            ("POST", "/v1/webhook-endpoints".to_owned(), "application/json", &json[..]),
            ("POST", format!("{job}/cancel"), "text/plain", &b""[..]),
            ("POST", format!("{job}/retry"), "text/plain", &b""[..]),
            ("DELETE", job.clone(), "text/plain", &b""[..]),
            ("POST", "/v1/nothing".to_owned(), "text/plain", &b""[..]),
        ] {
            let what = format!("{method} {path} {marks:?}");
            asked(method, &path, marks, kind, body).await.expect_problem(403, "cross-site-request", &what);
        }
        let begin = format!("Tus-Resumable: 1.0.0\r\nUpload-Length: 9\r\n{marks}");
        asked("POST", "/v1/uploads", &begin, "text/plain", &b""[..]).await.expect_problem(
            403,
            "cross-site-request",
            marks,
        );
    }
    for marks in FOREIGN {
        for path in [&*job, "/v1/jobs", "/metrics", "/openapi.yaml", "/v1/scenes"] {
            asked("GET", path, marks, "text/plain", b"").await.expect_problem(
                403,
                "cross-site-request",
                marks,
            );
        }
    }
    asked("GET", &job, FOLLOWED, "text/plain", b"").await.expect(200, "a followed link");
    asked("GET", &job, "Sec-Fetch-Site: none\r\n", "text/plain", b"")
        .await
        .expect(200, "an address that was typed");
    let own = format!("Origin: http://{address}\r\n");
    asked("GET", &job, &own, "text/plain", b"").await.expect(200, "its own page");

    let now = service.get(&job).await.expect(200);
    assert_eq!(
        (now.json()["state"].as_str(), now.header("etag")),
        (Some("queued"), &*tag),
        "nothing has changed"
    );
    for (path, list, count) in
        [("/v1/jobs", "jobs", 1), ("/v1/scenes", "scenes", 1), ("/v1/webhook-endpoints", "endpoints", 0)]
    {
        let listed = service.get(path).await.expect(200).json();
        assert_eq!(listed[list].as_array().map(Vec::len), Some(count), "{path}: {listed}");
    }
    asked("POST", &format!("{job}/cancel"), &own, "text/plain", &b""[..])
        .await
        .expect(200, "its own page may");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_that_a_browser_keeps_is_of_no_use_to_pages_of_other_sites() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let key = server.key(&Scope::ALL).await;
    let created = server.send("POST", "/v1/jobs", |request| {
        request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
    });
    let job = created.await.expect(201).header("location").to_owned();
    let address = server.address.to_string();
    let asked = async |method: &str, path: &str, more: &str| {
        let head = format!("{method} {path} HTTP/1.1\r\nHost: tcgs.example\r\n{more}");
        send(&address, &head, b"").await
    };
    let basic = format!("Authorization: Basic {}\r\n", STANDARD.encode(format!("me:{}", key.key)));
    let bearer = format!("Authorization: Bearer {}\r\n", key.key);
    asked("GET", &job, &basic).await.expect(200, "with keys, any name is the service's");
    asked("GET", &job, &format!("{basic}{FOLLOWED}")).await.expect(200, "a followed link");
    let cancel = format!("{job}/cancel");
    for marks in FOREIGN {
        for (method, path) in [("GET", &job), ("HEAD", &job), ("POST", &cancel), ("DELETE", &job)] {
            asked(method, path, &format!("{basic}{marks}")).await.expect(403, marks);
            asked(method, path, marks).await.expect(403, marks);
        }
        asked("GET", &job, &format!("{bearer}{marks}"))
            .await
            .expect(200, "no browser adds a bearer's key by itself");
    }
    asked("POST", &cancel, &basic).await.expect_problem(401, "bearer-needed", "nothing changes by it");
    let now = with_key(&server, "GET", &job, &key.key).await.expect(200).json();
    assert_eq!(now["state"], "queued");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_link_from_elsewhere_shows_an_export_and_has_none_made() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    server.exporter.gate.open();
    let (address, export) = (server.address.to_string(), format!("{job}/export?format=ply"));
    let followed = format!("GET {export} HTTP/1.1\r\nHost: {address}\r\n{FOLLOWED}");
    send(&address, &followed, b"").await.expect_problem(403, "cross-site-request", "not made yet");
    assert_eq!(server.exporter.made.load(std::sync::atomic::Ordering::SeqCst), 0);
    server.get(&export).await.expect(200);
    send(&address, &followed, b"").await.expect(200, "made");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_metrics_own_listener_answers_to_loopback_names_only_too() {
    let tune = |config: &mut tcgs::http::HttpConfig| {
        config.metrics_listen = Some("127.0.0.1:0".parse().expect("an address"));
    };
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    server.key(&Scope::ALL).await;
    let address = server.metrics_address.expect("an address").to_string();
    let asked = async |more: &str| send(&address, &format!("GET /metrics HTTP/1.1\r\n{more}"), b"").await;
    let answer = asked("Host: localhost\r\n").await.expect(200, "its own name");
    assert!(answer.head.contains("openmetrics"), "{}", answer.head);
    asked("Host: evil.example\r\n").await.expect_problem(421, "foreign-host", "another name");
    asked(&format!("Host: localhost\r\n{}", FOREIGN[0])).await.expect_problem(
        403,
        "cross-site-request",
        "another page",
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_with_keys_does_a_probe_find_the_service_under_any_name() {
    let coverage = Coverage::default();
    let setup = || Setup { worker: false, ..Setup::default() };
    let server = Server::start_with(&coverage, setup()).await;
    let open = ["/healthz", "/readyz", "/version", "/openapi.yaml"];
    let asked = async |server: &Server, path: &str, more: &str| {
        let head = format!("GET {path} HTTP/1.1\r\nHost: tcgs.example\r\n{more}");
        send(&server.address.to_string(), &head, b"").await
    };
    for path in open {
        asked(&server, path, "").await.expect_problem(421, "foreign-host", path);
    }
    // While nobody can say whether there are keys, there count as none.
    server.faults.set(Some(Failing::Gone));
    asked(&server, "/v1/jobs", "").await.expect_problem(421, "foreign-host", "no answer of the database");
    server.faults.set(None);

    let key = server.key(&[Scope::Read]).await;
    // The first server knows of them by a request, the second from its start.
    asked(&server, "/v1/jobs", "").await.expect_problem(401, "no-key", "the first that needs one");
    let again = Server::start_in(&coverage, setup(), Arc::clone(&server.data)).await;
    for server in [&server, &again] {
        for path in open {
            asked(server, path, "").await.expect(200, path);
        }
        let bearer = format!("Authorization: Bearer {}\r\n", key.key);
        server.faults.set(Some(Failing::Busy));
        asked(server, "/v1/jobs", &bearer).await.expect_problem(503, "busy", "keys are not forgotten");
        asked(server, "/healthz", "").await.expect(200, "an open operation needs no database");
        server.faults.set(None);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_keys_a_bearer_token_is_no_proof_of_a_program() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let address = server.address.to_string();
    for marks in FOREIGN {
        let head =
            format!("GET /v1/jobs HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {UNKNOWN}\r\n{marks}");
        send(&address, &head, b"").await.expect_problem(403, "cross-site-request", marks);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_that_other_machines_can_reach_are_served_under_any_name() {
    let tune = |config: &mut tcgs::http::HttpConfig| {
        config.metrics_listen = Some("0.0.0.0:0".parse().expect("an address"));
    };
    let server = Server::start_with(&Coverage::default(), Setup { tune, ..Setup::default() }).await;
    let port = server.metrics_address.expect("an address").port();
    let head = "GET /metrics HTTP/1.1\r\nHost: tcgs.example\r\n";
    send(&format!("127.0.0.1:{port}"), head, b"").await.expect(200, "a scraper");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_of_allowed_origins_use_the_api() {
    const PAGE: &str = "https://app.example";
    let tune = |config: &mut tcgs::http::HttpConfig| {
        let origins = [PAGE, "http://localhost:5173"].map(|origin| origin.parse().expect("an origin"));
        config.limits.access.allowed_origins = tcgs::http::AllowedOrigins(origins.to_vec());
    };
    let server =
        Server::start_with(&Coverage::default(), Setup { tune, worker: false, ..Setup::default() }).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await;
    let preflight = async |server: &Server, path: &str, origin: &str| {
        let open = server.open("OPTIONS", path, |request| {
            let request = request.header("origin", origin).header("sec-fetch-site", "cross-site");
            let request = request.header("access-control-request-method", "PATCH");
            request.header("access-control-request-headers", "authorization,content-type,idempotency-key")
        });
        open.await
    };
    let header = |answer: &reqwest::Response, name: &str| -> String {
        answer
            .headers()
            .get_all(name)
            .iter()
            .map(|value| value.to_str().expect("ASCII"))
            .collect::<Vec<_>>()
            .join(",")
    };
    for path in ["/v1/jobs", "/v1/uploads", "/v1/jobs/0190a5d8-0000-7000-8000-000000000000"] {
        let allowed = preflight(&server, path, PAGE).await;
        assert_eq!(allowed.status(), 200, "{path}");
        assert_eq!(header(&allowed, "access-control-allow-origin"), PAGE);
        assert!(header(&allowed, "access-control-allow-methods").contains("PATCH"));
        assert_eq!(
            header(&allowed, "access-control-allow-headers"),
            "authorization,content-type,idempotency-key"
        );
        assert_eq!(header(&allowed, "access-control-max-age"), "7200");
        assert_eq!(header(&allowed, "access-control-allow-credentials"), "");
        let refused = preflight(&server, path, "https://evil.example").await;
        assert_eq!(refused.status(), 403, "{path}");
        assert_eq!(header(&refused, "access-control-allow-origin"), "");
    }
    let list = async |origin: &str, key: Option<&str>| {
        let open = server.open("GET", "/v1/jobs", |request| {
            let request = request.header("origin", origin).header("sec-fetch-site", "cross-site");
            key.into_iter().fold(request, |request, key| request.bearer_auth(key))
        });
        open.await
    };
    let read = list(PAGE, Some(&key.key)).await;
    assert_eq!(
        (read.status().as_u16(), header(&read, "access-control-allow-origin")),
        (200, PAGE.to_owned())
    );
    assert_eq!(header(&read, "access-control-expose-headers"), "*");
    assert!(header(&read, "vary").to_lowercase().contains("origin"));
    let keyless = list(PAGE, None).await;
    assert_eq!(
        (keyless.status().as_u16(), header(&keyless, "access-control-allow-origin")),
        (401, PAGE.to_owned())
    );
    let foreign = list("https://evil.example", Some(&key.key)).await;
    assert_eq!(header(&foreign, "access-control-allow-origin"), "");
    // The operation of tus is not taken for a preflight.
    let options =
        server.open("OPTIONS", "/v1/uploads", |request| request.header("origin", PAGE).bearer_auth(&key.key));
    assert_eq!(options.await.status(), 403, "the scope is missing");

    let closed = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let off = preflight(&closed, "/v1/jobs", PAGE).await;
    assert_eq!((off.status().as_u16(), header(&off, "access-control-allow-origin")), (403, String::new()));
}
