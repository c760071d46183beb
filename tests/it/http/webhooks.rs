//! Webhooks: endpoints, and signed deliveries with retries.

use std::{
    ffi::OsStr,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use jiff::SignedDuration;
use serde_json::{Value, json};
use tcgs::{
    domain::{ManualClock, OutboundPolicy, Scope, WebhookSecret},
    http::config::RequestLimits,
    https::ExtraRoots,
    store::{AfterAttempt, DeliveryResult},
    webhooks::{self, DeliveryConfig, Lookup, Sender, sign, system_lookup},
};
use tokio::{sync::Notify, task::JoinHandle};

use crate::support::{
    authority::Authority,
    contract::Coverage,
    dataset, program,
    receiver::{Manner, Received, Receiver},
    server::{Server, Setup},
    service::Service,
};

const ENDPOINTS: &str = "/v1/webhook-endpoints";
pub(super) const LOCAL: OutboundPolicy = OutboundPolicy { allow_loopback: true };

pub(super) fn setup() -> Setup {
    let limits = RequestLimits { webhook_targets: LOCAL, webhook_endpoints: 3, ..Default::default() };
    Setup { limits, ..Setup::default() }
}

/// A server on a clock that the test moves, without a worker.
fn stopped() -> (Setup, Arc<ManualClock>) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    (Setup { clock: clock.clone(), worker: false, ..setup() }, clock)
}

/// Delivers for a server until it stops.
pub(super) fn deliver(server: &Server, policy: OutboundPolicy, lookup: Lookup) -> JoinHandle<()> {
    deliver_trusting(server, policy, lookup, &ExtraRoots::default())
}

fn deliver_trusting(
    server: &Server,
    policy: OutboundPolicy,
    lookup: Lookup,
    roots: &ExtraRoots,
) -> JoinHandle<()> {
    let sender = Sender::new(policy, lookup, Duration::from_secs(15), roots).expect("a sender");
    let config = DeliveryConfig { poll: Duration::from_millis(2), ..DeliveryConfig::default() };
    let store = server.store.clone();
    tokio::spawn(webhooks::deliver(store, sender, config, server.shutdown.clone()))
}

async fn endpoint(server: &Server, body: Value) -> Value {
    server.post_json(ENDPOINTS, &body).await.expect(201).json()
}

async fn deliveries(server: &Server, endpoint: &Value) -> Vec<Value> {
    let path = endpoint["links"]["deliveries"].as_str().expect("a path");
    server.get(path).await.expect(200).json()["deliveries"].as_array().expect("a list").clone()
}

/// Asks for the newest delivery until it is as wanted.
async fn until(server: &Server, endpoint: &Value, wanted: impl Fn(&Value) -> bool) -> Value {
    loop {
        let newest = deliveries(server, endpoint).await.first().cloned().unwrap_or_default();
        if wanted(&newest) {
            return newest;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

fn check_signature(received: &Received, endpoint: &Value) {
    let secret = WebhookSecret::stored(endpoint["secret"].as_str().expect("a secret").into());
    let timestamp = received.header("webhook-timestamp").parse().expect("seconds");
    let body = std::str::from_utf8(&received.body).expect("UTF-8");
    let expected = sign(&secret, received.header("webhook-id"), timestamp, body).expect("signed");
    assert_eq!(received.header("webhook-signature"), expected);
}

pub(super) async fn endpoints_are_made_listed_and_deleted_and_show_their_secret_once(coverage: Coverage) {
    let server = Server::start_with(&coverage, setup()).await;
    let request_body =
        json!({ "url": "https://example.com/hook", "events": ["job.failed"], "description": "mine" });
    let made = server.post_json(ENDPOINTS, &request_body).await.expect(201);
    let path = made.header("location").to_owned();
    assert_eq!(made.header("cache-control"), "no-store");
    let mut first = made.json();
    assert!(first["secret"].as_str().is_some_and(|secret| secret.starts_with("whsec_")));
    first.as_object_mut().expect("an object").remove("secret");
    assert_eq!(server.get(&path).await.expect(200).json(), first, "all but the secret");
    assert_eq!(first["events"], json!(["job.failed"]));

    let second = endpoint(&server, json!({ "url": "https://example.com/all" })).await;
    assert_eq!(second["events"].as_array().map(Vec::len), Some(5));
    let third = endpoint(&server, json!({ "url": "https://example.com/third" })).await;
    server
        .post_json(ENDPOINTS, &json!({ "url": "https://example.com/" }))
        .await
        .expect_problem(409, "too-many-endpoints");

    let mut listed = Vec::new();
    let mut next = Some(format!("{ENDPOINTS}?limit=2"));
    while let Some(path) = next {
        let answer = server.get(&path).await.expect(200);
        let page = answer.json();
        let link = answer.headers.get("link").map(|link| link.to_str().expect("ASCII").to_owned());
        assert_eq!(link, page["next"].as_str().map(|next| format!("<{next}>; rel=\"next\"")));
        listed.extend(page["endpoints"].as_array().expect("endpoints").clone());
        next = page["next"].as_str().map(str::to_owned);
    }
    let ids: Vec<&Value> = listed.iter().map(|endpoint| &endpoint["id"]).collect();
    assert_eq!(ids, [&third["id"], &second["id"], &first["id"]], "newest first");
    assert!(listed.iter().all(|endpoint| endpoint.get("secret").is_none()));

    server.send("DELETE", &path, |request| request).await.expect(204);
    server.send("DELETE", &path, |request| request).await.expect_problem(404, "endpoint-not-found");
    for missing in [path.as_str(), "/v1/webhook-endpoints/17"] {
        server.get(missing).await.expect_problem(404, "endpoint-not-found");
        server.get(&format!("{missing}/deliveries")).await.expect_problem(404, "endpoint-not-found");
        let replay = format!("{missing}/deliveries/17/replay");
        server.post(&replay).await.expect_problem(404, "endpoint-not-found");
    }
}

pub(super) async fn what_is_wrong_with_an_endpoint_is_said(coverage: Coverage) {
    let server = Server::start_with(&coverage, setup()).await;
    for (url, named) in [
        ("http://example.com/", "https"),
        ("https://10.0.0.1/", "private"),
        ("https://[fd00:ec2::254]/", "private"),
        ("https://169.254.169.254/latest/meta-data", "link-local"),
        ("https://me:secret@example.com/", "password"),
        ("nonsense", "absolute"),
    ] {
        let refused = server.post_json(ENDPOINTS, &json!({ "url": url })).await;
        let detail = refused.expect_problem(422, "url-not-allowed");
        assert!(detail.starts_with("url: ") && detail.contains(named), "{url}: {detail}");
    }
    let url = "https://example.com/";
    for (request_body, named) in [
        (json!({}), "url"),
        (json!({ "url": 17 }), "string"),
        (json!({ "url": url, "secret": "whsec_mine" }), "secret"),
        (json!({ "url": url, "events": ["job.paused"] }), "job.paused"),
        (json!({ "url": url, "events": ["job.failed", "job.failed"] }), "twice"),
        (json!({ "url": url, "events": [] }), "empty"),
        (json!({ "url": url, "description": "x".repeat(201) }), "200"),
    ] {
        let detail = server.post_json(ENDPOINTS, &request_body).await.expect_problem(422, "invalid-endpoint");
        assert!(detail.contains(named), "{request_body}: {detail}");
    }
    let broken = |body: &'static str, media_type: &'static str| {
        server.send("POST", ENDPOINTS, move |request| request.header("content-type", media_type).body(body))
    };
    broken("{", "application/json").await.expect_problem(400, "malformed-json");
    broken("{}", "text/plain").await.expect_problem(415, "unsupported-media-type");
    for query in ["?limit=0", "?cursor=x", "?all=1"] {
        server.get(&format!("{ENDPOINTS}{query}")).await.expect_problem(422, "invalid-parameter");
    }
    let longest = "\u{fc}".repeat(200);
    let made = endpoint(&server, json!({ "url": url, "description": longest })).await;
    assert_eq!(made["description"], longest);
    let list = made["links"]["deliveries"].as_str().expect("a path");
    for query in ["?limit=101", "?cursor=x", "?all=1"] {
        server.get(&format!("{list}{query}")).await.expect_problem(422, "invalid-parameter");
    }

    let strict = Server::start(&coverage).await;
    let refused = strict.post_json(ENDPOINTS, &json!({ "url": "http://127.0.0.1:9/" })).await;
    refused.expect_problem(422, "url-not-allowed");
}

pub(super) async fn a_jobs_life_is_told_in_signed_messages(coverage: Coverage) {
    let server = Server::start_with(&coverage, setup()).await;
    let mut receiver = Receiver::start().await;
    let all = endpoint(&server, json!({ "url": receiver.url("/all") })).await;
    let ends = json!(["job.succeeded", "job.failed", "job.cancelled"]);
    let ends = endpoint(&server, json!({ "url": receiver.url("/ends"), "events": ends })).await;
    let delivering = deliver(&server, LOCAL, system_lookup());
    let job = server.succeeded().await;

    let (mut told, mut ended) = (Vec::new(), Vec::new());
    while told.len() < 3 || ended.is_empty() {
        let received = receiver.next().await;
        let (endpoint, into) = if received.path == "/all" { (&all, &mut told) } else { (&ends, &mut ended) };
        check_signature(&received, endpoint);
        assert_eq!(received.header("content-type"), "application/json");
        assert!(received.header("user-agent").starts_with("tcgs/"));
        assert!(received.body.len() < 20_000);
        into.push(received.json());
    }
    let types: Vec<&Value> = told.iter().map(|message| &message["type"]).collect();
    assert_eq!(types, ["job.queued", "job.running", "job.succeeded"], "in order");
    assert_eq!(ended.len(), 1);
    let last = &ended[0];
    assert_eq!(last["type"], "job.succeeded");
    assert_eq!(last["data"]["state"], "succeeded");
    assert_eq!(last["data"]["links"]["self"], job);
    assert_eq!(format!("/v1/jobs/{}", last["data"]["job_id"].as_str().expect("an id")), job);

    let done = until(&server, &ends, |delivery| delivery["state"] == "delivered").await;
    assert_eq!((&done["response_status"], &done["attempts"]), (&json!(200), &json!(1)));
    assert_eq!(done["error"], Value::Null);
    let list = all["links"]["deliveries"].as_str().expect("a path");
    until(&server, &all, |delivery| delivery["state"] == "delivered").await;
    let page = server.get(&format!("{list}?limit=2")).await.expect(200).json();
    assert_eq!(page["deliveries"][0]["event"], "job.succeeded");
    let rest = server.get(page["next"].as_str().expect("more")).await.expect(200).json();
    assert_eq!((&rest["deliveries"][0]["event"], &rest["next"]), (&json!("job.queued"), &Value::Null));

    // Sent again on request, with the same id.
    let replay = done["links"]["replay"].as_str().expect("a path");
    let again = server.post(replay).await.expect(202).json();
    assert_eq!((&again["state"], &again["id"]), (&json!("pending"), &done["id"]));
    let received = receiver.next().await;
    assert_eq!(received.header("webhook-id"), done["id"]);
    check_signature(&received, &ends);
    until(&server, &ends, |delivery| delivery["attempts"] == 2 && delivery["state"] == "delivered").await;
    let unknown = format!("{}/{}/replay", ends["links"]["deliveries"].as_str().expect("a path"), all["id"]);
    server.post(&unknown.replace('"', "")).await.expect_problem(404, "delivery-not-found");

    server.shutdown.cancel();
    delivering.await.expect("delivery stops with the server");
    assert!(receiver.is_quiet(), "nothing was sent twice");
}

pub(super) async fn a_message_under_way_is_not_sent_again(coverage: Coverage) {
    let (setup, _clock) = stopped();
    let server = Server::start_with(&coverage, setup).await;
    let mut receiver = Receiver::start().await;
    let gate = Arc::new(Notify::new());
    receiver.answer(Manner::After(Arc::clone(&gate)));
    let made = endpoint(&server, json!({ "url": receiver.url("/"), "events": ["job.queued"] })).await;
    // Two servers on one database.
    let _one = deliver(&server, LOCAL, system_lookup());
    let _other = deliver(&server, LOCAL, system_lookup());
    server.create("succeed").await;
    receiver.next().await;
    let under_way = deliveries(&server, &made).await.remove(0);
    assert_eq!((&under_way["state"], &under_way["attempts"]), (&json!("pending"), &json!(1)));
    let replay = under_way["links"]["replay"].as_str().expect("a path");
    server.post(replay).await.expect_problem(409, "delivery-under-way");
    gate.notify_one();
    until(&server, &made, |delivery| delivery["state"] == "delivered").await;
    assert!(receiver.is_quiet());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_are_not_taken_are_sent_again_on_schedule_and_given_up_in_the_end() {
    let (setup, clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let mut receiver = Receiver::start().await;
    receiver.answer_status(500);
    let made = endpoint(&server, json!({ "url": receiver.url("/"), "events": ["job.queued"] })).await;
    let _delivering = deliver(&server, LOCAL, system_lookup());
    server.create("succeed").await;
    let mut ids = Vec::new();
    let pauses = [5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400];
    for (attempt, pause) in (1..).zip(pauses) {
        let received = receiver.next().await;
        check_signature(&received, &made);
        ids.push(received.header("webhook-id").to_owned());
        let failed =
            until(&server, &made, |delivery| !delivery["error"].is_null() && delivery["attempts"] == attempt)
                .await;
        assert_eq!((&failed["state"], &failed["response_status"]), (&json!("pending"), &json!(500)));
        let [due, begun] = ["next_attempt_at", "attempted_at"].map(|name| {
            failed[name].as_str().expect("an instant").parse::<jiff::Timestamp>().expect("an instant")
        });
        let ratio = due.duration_since(begun).as_secs_f64() / f64::from(pause);
        assert!((0.9..=1.1).contains(&ratio), "attempt {attempt}: {ratio}");
        assert!(receiver.is_quiet());
        clock.advance(SignedDuration::from_secs(i64::from(pause) * 11 / 10 + 1));
    }
    receiver.next().await;
    let given_up = until(&server, &made, |delivery| delivery["state"] == "failed").await;
    assert_eq!((&given_up["attempts"], &given_up["next_attempt_at"]), (&json!(10), &Value::Null));
    assert!(ids.windows(2).all(|pair| pair[0] == pair[1]), "one id for every attempt");

    // Asked for again, it has its whole schedule before it.
    receiver.answer_status(204);
    server.post(given_up["links"]["replay"].as_str().expect("a path")).await.expect(202);
    receiver.next().await;
    until(&server, &made, |delivery| delivery["state"] == "delivered").await;
}

pub(super) async fn an_endpoint_that_is_gone_is_told_nothing_more(coverage: Coverage) {
    let (setup, clock) = stopped();
    let server = Server::start_with(&coverage, setup).await;
    let mut receiver = Receiver::start().await;
    let made = endpoint(&server, json!({ "url": receiver.url("/"), "events": ["job.queued"] })).await;
    let path = made["links"]["self"].as_str().expect("a path").to_owned();
    receiver.answer(Manner::Status(307, vec![("location", receiver.url("/elsewhere"))]));
    let _delivering = deliver(&server, LOCAL, system_lookup());
    server.create("succeed 1").await;
    assert_eq!(receiver.next().await.path, "/");
    let redirected = until(&server, &made, |delivery| delivery["response_status"] == 307).await;
    assert!(redirected["error"].as_str().is_some_and(|error| error.contains("not followed")));
    assert!(receiver.is_quiet(), "redirections are not followed");

    receiver.answer(Manner::Status(503, vec![("retry-after", "3600".into())]));
    clock.advance(SignedDuration::from_secs(10));
    receiver.next().await;
    let put_off = until(&server, &made, |delivery| delivery["response_status"] == 503).await;
    let due: jiff::Timestamp = put_off["next_attempt_at"].as_str().expect("an instant").parse().expect("one");
    assert_eq!(due.to_string(), "2026-11-21T13:00:10Z", "as the endpoint asked");

    receiver.answer_status(410);
    clock.advance(SignedDuration::from_secs(3601));
    receiver.next().await;
    let gone = until(&server, &made, |delivery| delivery["response_status"] == 410).await;
    assert_eq!(gone["state"], "failed");
    assert_eq!(server.get(&path).await.expect(200).json()["disabled_at"], "2026-11-21T13:00:11Z");
    let replay = gone["links"]["replay"].as_str().expect("a path");
    server.post(replay).await.expect_problem(409, "endpoint-disabled");
    server.create("succeed 2").await;
    assert_eq!(deliveries(&server, &made).await.len(), 1, "and nothing is written for it");
}

pub(super) async fn endpoints_belong_to_their_key(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..setup() }).await;
    let [mine, theirs] = [server.key(&Scope::ALL[..3]).await, server.key(&Scope::ALL[..3]).await];
    let with = |method: &'static str, path: String, key: String, body: Option<Value>| {
        let server = &server;
        async move {
            let answer = server.send(method, &path, |request| {
                let request = request.bearer_auth(key);
                body.iter().fold(request, |request, body| request.json(body))
            });
            answer.await
        }
    };
    let request_body = json!({ "url": "https://example.com/" });
    let made = with("POST", ENDPOINTS.into(), mine.key.clone(), Some(request_body)).await.expect(201).json();
    let path = made["links"]["self"].as_str().expect("a path").to_owned();
    for (method, path) in [
        ("GET", path.clone()),
        ("DELETE", path.clone()),
        ("GET", format!("{path}/deliveries")),
        ("POST", format!("{path}/deliveries/17/replay")),
    ] {
        with(method, path, theirs.key.clone(), None).await.expect_problem(404, "endpoint-not-found");
    }
    let list = with("GET", ENDPOINTS.into(), theirs.key.clone(), None).await.expect(200).json();
    assert_eq!(list["endpoints"], json!([]));
    for (key, told) in [(&theirs, 0), (&mine, 1)] {
        let created = server.send("POST", "/v1/jobs", |request| {
            request.bearer_auth(&key.key).header("content-type", "application/zip").body(key.id.to_string())
        });
        created.await.expect(201);
        let list = with("GET", format!("{path}/deliveries"), mine.key.clone(), None).await.expect(200).json();
        assert_eq!(list["deliveries"].as_array().map(Vec::len), Some(told), "only one's own jobs");
    }
}

/// Answers lookups with each of these in turn, then with the last again.
fn lookups(answers: &'static [&'static [&'static str]]) -> Lookup {
    let asked = Arc::new(AtomicUsize::new(0));
    Arc::new(move |_| {
        let turn = asked.fetch_add(1, Ordering::SeqCst).min(answers.len() - 1);
        Box::pin(async move {
            Ok(answers[turn].iter().map(|address| address.parse().expect("an address")).collect())
        })
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_with_any_address_that_is_not_allowed_is_not_asked() {
    let (setup, clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let mut receiver = Receiver::start().await;
    let url = format!("http://localhost:{}/", receiver.address.port());
    let made = endpoint(&server, json!({ "url": url, "events": ["job.queued"] })).await;
    // First one good and one bad address, then a good one alone.
    let _delivering = deliver(&server, LOCAL, lookups(&[&["127.0.0.1", "10.0.0.1"], &["127.0.0.1"]]));
    server.create("succeed").await;
    let refused = until(&server, &made, |delivery| !delivery["error"].is_null()).await;
    assert!(refused["error"].as_str().is_some_and(|error| error.contains("private")), "{refused}");
    assert_eq!(refused["response_status"], Value::Null);
    assert!(receiver.is_quiet(), "not even the good one");
    clock.advance(SignedDuration::from_secs(10));
    receiver.next().await;
    until(&server, &made, |delivery| delivery["state"] == "delivered").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn where_loopback_is_not_allowed_neither_names_nor_numbers_lead_there() {
    let (setup, _clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let mut receiver = Receiver::start().await;
    let strict = OutboundPolicy::default();
    let port = receiver.address.port();
    // The endpoints were made while it was allowed, or the name led elsewhere then.
    for (url, named) in [
        (format!("http://127.0.0.1:{port}/"), "https"),
        (format!("https://127.0.0.1:{port}/"), "loopback"),
        (format!("https://rebound.example:{port}/"), "loopback"),
    ] {
        let made = endpoint(&server, json!({ "url": url, "events": ["job.queued"] })).await;
        server.create("succeed").await;
        let stop = deliver(&server, strict, lookups(&[&["127.0.0.1"]]));
        let refused = until(&server, &made, |delivery| !delivery["error"].is_null()).await;
        assert!(refused["error"].as_str().is_some_and(|error| error.contains(named)), "{url}: {refused}");
        stop.abort();
    }
    assert!(receiver.is_quiet());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_does_not_speak_tls_or_does_not_answer_is_a_fault() {
    let (setup, _clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let receiver = Receiver::start().await;
    let url = format!("https://127.0.0.1:{}/", receiver.address.port());
    let plain = endpoint(&server, json!({ "url": url, "events": ["job.queued"] })).await;
    let closed = std::net::TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound");
    let nobody =
        endpoint(&server, json!({ "url": format!("http://{closed}/"), "events": ["job.queued"] })).await;
    let _delivering = deliver(&server, LOCAL, system_lookup());
    server.create("succeed").await;
    for endpoint in [&plain, &nobody] {
        let failed = until(&server, endpoint, |delivery| !delivery["error"].is_null()).await;
        assert_eq!((&failed["state"], &failed["response_status"]), (&json!("pending"), &Value::Null));
        assert_eq!(failed["error"], "no connection to the endpoint");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_takes_a_message_and_stays_mute_is_given_up() {
    let (setup, _clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let mute = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}/", mute.local_addr().expect("bound"));
    let made = endpoint(&server, json!({ "url": url, "events": ["job.queued"] })).await;
    let sender = Sender::new(LOCAL, system_lookup(), Duration::from_secs(1), &ExtraRoots::default());
    let config = DeliveryConfig { poll: Duration::from_millis(2), ..DeliveryConfig::default() };
    let store = server.store.clone();
    tokio::spawn(webhooks::deliver(store, sender.expect("a sender"), config, server.shutdown.clone()));
    server.create("succeed").await;
    // Taken, and held open without a word.
    let (_held, _) = mute.accept().await.expect("a connection");
    let waited = tokio::time::timeout(Duration::from_secs(60), async {
        until(&server, &made, |delivery| !delivery["error"].is_null()).await
    });
    let failed = waited.await.expect("it does not wait for ever");
    assert_eq!((&failed["error"], &failed["state"]), (&json!("no response within 1 s"), &json!("pending")));
    assert_eq!(failed["response_status"], Value::Null);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_go_to_their_endpoint_and_through_no_proxy() {
    let (mut endpoint, mut proxy) = (Receiver::start().await, Receiver::start().await);
    let data = tempfile::tempdir().expect("a folder");
    let names = ["http_proxy", "HTTP_PROXY", "https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"];
    let mut environment: Vec<_> = names.iter().map(|name| (*name, proxy.url(""))).collect();
    environment.extend(["no_proxy", "NO_PROXY"].map(|name| (name, String::new())));
    let flags = ["--workers", "0", "--webhooks-allow-loopback"];
    let service = Service::start_in(data.path(), flags, &environment).await;
    let request_body = json!({ "url": endpoint.url("/hook"), "events": ["job.queued"] });
    let made = service.post_json(ENDPOINTS, &request_body).await.expect(201).json();
    service.upload("", dataset::zip()).await.expect(201);
    let received = tokio::time::timeout(Duration::from_secs(60), endpoint.next()).await.expect("in time");
    assert_eq!(received.path, "/hook");
    check_signature(&received, &made);
    assert!(proxy.is_quiet());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_go_over_tls_to_who_shows_a_certificate_that_is_trusted_and_to_nobody_else() {
    let (mut setup, clock) = stopped();
    setup.limits.webhook_endpoints = 5;
    let server = Server::start_with(&Coverage::default(), setup).await;
    let [trusted, unknown, namesake] = ["ours", "theirs", "ours"].map(Authority::new);
    let mut sound = Receiver::start_tls(trusted.acceptor("localhost")).await;
    let mut by_number = Receiver::start_tls(trusted.acceptor("127.0.0.1")).await;
    let mut other_name = Receiver::start_tls(trusted.acceptor("hooks.example")).await;
    let mut unknown_ca = Receiver::start_tls(unknown.acceptor("localhost")).await;
    let mut pretender = Receiver::start_tls(namesake.acceptor("localhost")).await;
    let mut made = Vec::new();
    for (receiver, host) in [
        (&sound, "localhost"),
        (&by_number, "127.0.0.1"),
        (&other_name, "localhost"),
        (&unknown_ca, "localhost"),
        (&pretender, "localhost"),
    ] {
        let request_body = json!({ "url": receiver.https_url(host), "events": ["job.queued"] });
        made.push(endpoint(&server, request_body).await);
    }
    let local: Lookup = lookups(&[&["127.0.0.1"]]);
    let delivering = deliver_trusting(&server, LOCAL, Arc::clone(&local), &trusted.roots());
    server.create("succeed").await;
    for (receiver, made) in [(&mut sound, &made[0]), (&mut by_number, &made[1])] {
        let received = receiver.next().await;
        check_signature(&received, made);
        assert_eq!(received.json()["type"], "job.queued");
        let done = until(&server, made, |delivery| delivery["state"] == "delivered").await;
        assert_eq!(
            (&done["response_status"], &done["attempts"], &done["error"]),
            (&json!(200), &json!(1), &json!(null))
        );
    }
    let unknown_to_us = "the endpoint's certificate is signed by no authority that is trusted here";
    for (made, error) in [
        (&made[2], "the endpoint's certificate is for another name"),
        (&made[3], unknown_to_us),
        (&made[4], unknown_to_us),
    ] {
        let failed = until(&server, made, |delivery| !delivery["error"].is_null()).await;
        assert_eq!((&failed["error"], &failed["response_status"]), (&json!(error), &Value::Null));
        assert_eq!(
            (&failed["state"], &failed["attempts"]),
            (&json!("pending"), &json!(1)),
            "to be tried again"
        );
    }
    for receiver in [&mut other_name, &mut unknown_ca, &mut pretender] {
        assert!(receiver.is_quiet(), "not a word of the message was sent");
    }

    // It is the second attempt that succeeds once the second authority is trusted.
    delivering.abort();
    let both = format!("{}{}", trusted.pem(), unknown.pem());
    let both = ExtraRoots::from_pem(both.as_bytes()).expect("two certificates");
    let delivering = deliver_trusting(&server, LOCAL, Arc::clone(&local), &both);
    clock.advance(SignedDuration::from_secs(10));
    check_signature(&unknown_ca.next().await, &made[3]);
    let done = until(&server, &made[3], |delivery| delivery["state"] == "delivered").await;
    assert_eq!(done["attempts"], 2);

    // A trusted authority opens no address that is not allowed.
    delivering.abort();
    let _delivering = deliver_trusting(&server, OutboundPolicy::default(), local, &both);
    server.create("succeed again").await;
    let refused = until(&server, &made[0], |delivery| !delivery["error"].is_null()).await;
    assert!(refused["error"].as_str().is_some_and(|error| error.contains("loopback")), "{refused}");
    assert!(sound.is_quiet());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_program_trusts_the_authorities_of_a_file() {
    let authority = Authority::new("ours");
    let mut receiver = Receiver::start_tls(authority.acceptor("localhost")).await;
    let data = tempfile::tempdir().expect("a folder");
    let file = data.path().join("ca.pem");
    std::fs::write(&file, authority.pem()).expect("written");
    let flags = ["--workers", "0", "--webhooks-allow-loopback", "--webhooks-ca"].map(OsStr::new);
    let service = Service::start_with(data.path(), flags.into_iter().chain([file.as_os_str()])).await;
    let request_body = json!({ "url": receiver.https_url("localhost"), "events": ["job.queued"] });
    let made = service.post_json(ENDPOINTS, &request_body).await.expect(201).json();
    service.upload("", dataset::zip()).await.expect(201);
    check_signature(&receiver.next().await, &made);
    service.stop().await;

    std::fs::write(&file, "no certificate").expect("written");
    let mut command = program::command();
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data.path());
    let refused = command.arg("--webhooks-ca").arg(&file).output().expect("the binary runs");
    let told = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{told}");
    assert!(told.contains("--webhooks-ca") && told.contains("ca.pem holds no certificate"), "{told}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_delivery_whose_server_died_is_made_by_another() {
    let (setup, clock) = stopped();
    let server = Server::start_with(&Coverage::default(), setup).await;
    let mut receiver = Receiver::start().await;
    let made = endpoint(&server, json!({ "url": receiver.url("/"), "events": ["job.queued"] })).await;
    server.create("succeed").await;
    let lease = Duration::from_secs(60);
    let dead = server.store.take_delivery(lease).await.expect("a store").expect("something due");
    assert!(server.store.take_delivery(lease).await.expect("a store").is_none(), "it is somebody's");
    let _delivering = deliver(&server, LOCAL, system_lookup());
    clock.advance(SignedDuration::from_secs(61));
    assert_eq!(receiver.next().await.header("webhook-id"), dead.id.to_string());
    until(&server, &made, |delivery| delivery["state"] == "delivered").await;
    let late =
        DeliveryResult { response_status: None, error: Some("too late".into()), next: AfterAttempt::GiveUp };
    server.store.finish_delivery(dead.id, dead.attempt, late).await.expect("no fault");
    let after = deliveries(&server, &made).await.remove(0);
    assert_eq!(after["state"], "delivered", "a late result changes nothing");
}
