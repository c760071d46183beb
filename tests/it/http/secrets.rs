//! Keys and webhook secrets are shown once, when created, and nowhere else.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex},
};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use serde_json::{Value, json};
use tcgs::{
    domain::{Digest, Scope},
    webhooks::system_lookup,
};
use tracing::{Dispatch, subscriber::DefaultGuard};

use super::{
    access::{UNKNOWN, with_key},
    webhooks::{LOCAL, deliver, setup},
};
use crate::support::{
    contract::{self, Coverage},
    eventually::eventually,
    faults::Failing,
    receiver::Receiver,
    server::{Answer, Server, TestKey},
};

/// Where a subscriber writes.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl std::io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("not poisoned").extend_from_slice(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Log {
    /// Catches all that this thread logs, where a test's server runs, for as long as what is returned lives.
    fn catch() -> (Self, (Dispatch, DefaultGuard)) {
        let log = Self::default();
        let writer = log.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_max_level(tracing::Level::TRACE)
            .with_ansi(false)
            .with_span_events(tracing_subscriber::fmt::format::FmtSpan::FULL)
            .with_writer(move || writer.clone())
            .finish();
        // While there is only one subscriber, an event that a thread without it comes to first stays off for all (tracing asks
        // the thread's own subscriber alone); with two, all are asked.
        let second = Dispatch::new(tracing_subscriber::registry());
        (log, (second, tracing::subscriber::set_default(subscriber)))
    }

    fn text(&self) -> String {
        String::from_utf8(self.0.lock().expect("not poisoned").clone()).expect("UTF-8")
    }
}

/// A server, what is secret in it, and what it answered.
struct Seen {
    server: Server,
    known: TestKey,
    keys: Vec<String>,
    webhook_secret: String,
    answers: Vec<Answer>,
}

impl Seen {
    /// A service with keys, known, revoked, narrow and made over HTTP, and with an endpoint for webhooks.
    async fn start(receiver: &Receiver) -> Self {
        let server = Server::start_with(&Coverage::default(), setup()).await;
        drop(deliver(&server, LOCAL, system_lookup()));
        let known = server.key(&Scope::ALL).await;
        let revoked = server.key(&[Scope::Admin]).await;
        server.revoke(&revoked).await;
        let narrow = server.key(&[Scope::DatasetsWrite]).await;
        let post = async |path: &str, body: Value| {
            let request = server.send("POST", path, |request| request.bearer_auth(&known.key).json(&body));
            request.await.expect(201).json()
        };
        let made = post("/v1/keys", json!({ "name": "made", "scopes": ["read"] })).await;
        let made = made["key"].as_str().expect("a key").to_owned();
        let hook = post("/v1/webhook-endpoints", json!({ "url": receiver.url("/hook") })).await;
        let webhook_secret = hook["secret"].as_str().expect("a secret").to_owned();
        let keys = vec![UNKNOWN.to_owned(), known.key.clone(), revoked.key, narrow.key, made];
        Self { server, known, keys, webhook_secret, answers: Vec::new() }
    }

    /// Asks with the key that may do everything.
    async fn ask(&mut self, method: &str, path: &str) -> &Answer {
        let answer = with_key(&self.server, method, path, &self.known.key).await;
        self.answers.push(answer);
        self.answers.last().expect("just put there")
    }

    async fn upload(&mut self, dataset: &'static str) -> &Answer {
        let upload = self.server.send("POST", "/v1/jobs", |request| {
            request.bearer_auth(&self.known.key).header("content-type", "application/zip").body(dataset)
        });
        self.answers.push(upload.await);
        self.answers.last().expect("just put there")
    }

    /// A job of a dataset, once it is as it stays.
    async fn job(&mut self, dataset: &'static str) -> String {
        let job = self.upload(dataset).await.header("location").to_owned();
        let has_ended = async || !self.ask("GET", &job).await.json()["finished_at"].is_null();
        eventually("the job has ended", has_ended).await;
        job
    }

    async fn use_jobs(&mut self) {
        for refused in ["bad zip", "bomb"] {
            self.upload(refused).await;
        }
        let (failed, done) = (self.job("fail").await, self.job("succeed").await);
        self.ask("GET", &format!("{done}/view?position=1,0,0&look_at=0,0,0&width=13")).await;
        for job in [&failed, &done] {
            for part in [
                "/events",
                "/events?limit=1",
                "/series",
                "/artifacts",
                "/artifact",
                "/report",
                "/export?format=ply",
                "/view?frame=test/r_0",
            ] {
                self.ask("GET", &format!("{job}{part}")).await;
            }
            let events = format!("{job}/events");
            let streamed = self.server.send("GET", &events, |request| {
                request.bearer_auth(&self.known.key).header("accept", "text/event-stream")
            });
            self.answers.push(streamed.await);
        }
        self.ask("POST", &format!("{failed}/retry")).await;
        self.ask("POST", &format!("{done}/retry")).await;
    }

    async fn use_webhooks(&mut self, receiver: &mut Receiver) {
        receiver.next().await;
        let listed = self.ask("GET", "/v1/webhook-endpoints").await.json();
        let links = &listed["endpoints"][0]["links"];
        let [own, deliveries] = ["self", "deliveries"].map(|link| links[link].as_str().expect("a path"));
        self.ask("GET", own).await;
        let mut sent = None;
        eventually("a message is delivered", async || {
            let listed = self.ask("GET", deliveries).await.json();
            let listed = listed["deliveries"].as_array().expect("a list").clone();
            sent = listed.into_iter().find(|delivery| delivery["state"] == "delivered");
            sent.is_some()
        })
        .await;
        let sent = sent.expect("delivered");
        let id = sent["id"].as_str().expect("an id");
        self.ask("POST", &format!("{deliveries}/{id}/replay")).await.clone().expect(202);
        let request_body = json!({ "url": receiver.url("/hook"), "secret": self.webhook_secret });
        let own_secret = self.server.send("POST", "/v1/webhook-endpoints", |request| {
            request.bearer_auth(&self.known.key).json(&request_body)
        });
        self.answers.push(own_secret.await.clone().expect(422));
    }

    async fn use_keys(&mut self) {
        for path in ["/v1/keys", "/v1/keys?revoked=true", "/metrics", "/readyz", "/version"] {
            self.ask("GET", path).await;
        }
        for operation in contract::guarded() {
            for key in &self.keys {
                let answer = with_key(&self.server, operation.method, &operation.path(), key).await;
                self.answers.push(answer);
            }
        }
        let known = &self.known.key;
        let basic = |password: &str| format!("Basic {}", STANDARD.encode(format!("me:{password}")));
        let (good, bad) = (basic(known), basic(&format!("{known}x")));
        for header in
            [format!("bearer{known}"), format!("Basic {known}"), format!("Bearer {known}x"), good, bad]
        {
            for method in ["GET", "POST"] {
                let request =
                    self.server.send(method, "/v1/jobs", |request| request.header("authorization", &header));
                self.answers.push(request.await);
            }
        }
        self.ask("GET", &format!("/v1/jobs?key={known}")).await;
        for failing in [Failing::Busy, Failing::Gone] {
            self.server.faults.set(Some(failing));
            self.ask("GET", "/v1/jobs").await;
        }
        self.server.faults.set(None);
    }
}

#[tokio::test]
async fn secrets_are_in_no_log_and_no_answer() {
    let (log, _caught) = Log::catch();
    let mut receiver = Receiver::start().await;
    let mut seen = Seen::start(&receiver).await;
    seen.use_jobs().await;
    seen.use_webhooks(&mut receiver).await;
    seen.use_keys().await;

    let statuses: BTreeSet<u16> = seen.answers.iter().map(|answer| answer.status).collect();
    let expected = [200, 201, 202, 401, 403, 404, 409, 422, 500, 503];
    assert!(expected.iter().all(|status| statuses.contains(status)), "{statuses:?}");
    let media_types: BTreeSet<&str> = seen
        .answers
        .iter()
        .filter(|answer| answer.headers.contains_key("content-type"))
        .map(|answer| answer.header("content-type").split(';').next().unwrap_or_default())
        .collect();
    for kind in ["text/html", "text/event-stream", "application/openmetrics-text", "application/problem+json"]
    {
        assert!(media_types.contains(kind), "{kind} is not among {media_types:?}");
    }
    let log = log.text();
    for caught in ["GET /v1/jobs 401", " DEBUG ", "/v1/webhook-endpoints"] {
        assert!(log.contains(caught), "the log was not caught: {caught} is not in {} bytes", log.len());
    }

    // A part is as bad as the whole: what may be shown of a key are its first thirteen characters.
    let mut parts = vec![seen.webhook_secret[6..22].to_owned()];
    for key in &seen.keys {
        let by_basic = STANDARD.encode(format!("me:{key}"));
        let hash = Digest::of(key.as_bytes()).to_string();
        parts.extend([&key[14..30], &by_basic[24..40], &hash[..16]].map(str::to_owned));
    }
    for part in &parts {
        assert!(!log.contains(part), "the log shows a secret or its hash");
        for answer in &seen.answers {
            let shown = format!("{:?} {}", answer.headers, String::from_utf8_lossy(&answer.body));
            assert!(!shown.contains(part), "an answer shows a secret or its hash: {shown}");
        }
    }
}
