//! Event streams: from any event number to the end, across connections and servers.

use std::{sync::Arc, time::Duration};

use serde_json::{Value, json};
use tcgs::{
    domain::{Phase, Problem, ProblemType, Progress, Scope, SystemClock},
    http::{self, HttpConfig, Services, config::RequestLimits},
    store::{Outcome, Store},
};
use tokio_util::sync::CancellationToken;

use super::access::with_key;
use crate::support::{
    contract::Coverage,
    eventually::eventually,
    server::{Server, Setup, TestKey, quick_policy},
    sse::{Frame, Reader, frames},
};

async fn history(server: &Server, job: &str) -> Vec<Value> {
    let page = server.get(&format!("{job}/events?limit=1000")).await.expect(200).json();
    page["events"].as_array().expect("events").clone()
}

fn told(frames: &[Frame]) -> Vec<Value> {
    frames.iter().map(Frame::json).collect()
}

async fn to_the_end(mut stream: Reader) -> Vec<Frame> {
    let mut all = Vec::new();
    while let Some(frame) = stream.next().await {
        all.push(frame);
    }
    all
}

fn no_worker(limits: RequestLimits) -> Setup {
    Setup { worker: false, limits, ..Setup::default() }
}

pub(super) async fn a_stream_tells_everything_once_and_ends_with_the_job(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.create("gate").await;
    let events = format!("{job}/events");
    let stream = server.stream(&events, None).await;
    let headers = stream.response().headers();
    assert_eq!(stream.response().status(), 200);
    for (name, value) in
        [("content-type", "text/event-stream"), ("cache-control", "no-store"), ("x-accel-buffering", "no")]
    {
        assert_eq!(headers[name], value);
    }
    let following = tokio::spawn(to_the_end(stream));
    server.reaches(&job, "running").await;
    server.runner.gate.open();
    let live = following.await.expect("the stream ends by itself");
    let past = history(&server, &job).await;
    assert_eq!(told(&live), past);
    assert_eq!(live.last().map(|last| last.json()["data"]["state"].clone()), Some(json!("succeeded")));
    for frame in &live {
        let event = frame.json();
        assert_eq!((&event["seq"], &event["kind"]), (&json!(frame.number()), &json!(frame.event)));
    }

    let as_stream = |path: String, last: Option<String>| {
        let server = &server;
        async move {
            let answer = server.send("GET", &path, |request| {
                let request = request.header("accept", "text/event-stream");
                last.into_iter().fold(request, |request, last| request.header("last-event-id", last))
            });
            answer.await
        }
    };
    let whole = as_stream(events.clone(), None).await.expect(200);
    assert!(whole.body.starts_with(b"retry: 3000\n\n") || whole.body.starts_with(b"retry:3000\n\n"));
    assert_eq!(told(&frames(&whole.body)), past);
    for seen in 0..past.len() {
        let rest = as_stream(events.clone(), Some(seen.to_string())).await.expect(200);
        assert_eq!(told(&frames(&rest.body)), past[seen..]);
        let rest = as_stream(format!("{events}?after={seen}"), None).await.expect(200);
        assert_eq!(told(&frames(&rest.body)), past[seen..]);
    }
    // A browser that comes again repeats the address that it began with.
    let again = as_stream(format!("{events}?after=0"), Some("2".into())).await.expect(200);
    assert_eq!(told(&frames(&again.body)), past[2..]);
    let done = as_stream(events.clone(), Some(past.len().to_string())).await.expect(204);
    assert_eq!((done.header("cache-control"), done.body.len()), ("no-store", 0));

    // Of a job that was restored from a backup a client may have seen more than there is.
    as_stream(events.clone(), Some("999".into())).await.expect(204);
    let page = server.get(&format!("{events}?after=999&limit=5")).await.expect(200).json();
    assert_eq!(
        (&page["events"], &page["next"]),
        (&json!([]), &json!(format!("{events}?after={}&limit=5", past.len())))
    );

    for wrong in ["x", "-1", "1.5", ""] {
        let detail = as_stream(events.clone(), Some(wrong.into())).await;
        assert!(detail.expect_problem(422, "invalid-parameter").starts_with("Last-Event-ID"));
        let page = server.send("GET", &events, |request| request.header("last-event-id", wrong)).await;
        page.expect_problem(422, "invalid-parameter");
    }
    let both = server.send("GET", &events, |request| {
        request.header("accept", "text/event-stream;q=0.1, application/json")
    });
    both.await.expect(200).json();
}

pub(super) async fn there_are_only_so_many_streams(coverage: Coverage) {
    let limits = RequestLimits { event_streams: 8, event_streams_per_key: 2, ..Default::default() };
    let server = Server::start_with(&coverage, no_worker(limits)).await;
    let job = server.create("succeed").await;
    let events = format!("{job}/events");
    let first = server.stream(&events, None).await;
    let _second = server.stream(&events, None).await;
    let ask = || server.send("GET", &events, |request| request.header("accept", "text/event-stream"));
    let refused = ask().await;
    refused.header("retry-after").parse::<u32>().expect("seconds");
    assert!(refused.expect_problem(429, "too-many-streams").starts_with("2 streams of yours are open"));
    server.get(&events).await.expect(200);
    drop(first);
    // The place is free once the server has noticed.
    let is_free = async || server.stream(&events, None).await.response().status() != 429;
    eventually("the place is free", is_free).await;

    let limits = RequestLimits { event_streams: 1, event_streams_per_key: 2, ..Default::default() };
    let server = Server::start_with(&coverage, no_worker(limits)).await;
    let events = format!("{}/events", server.create("succeed").await);
    let _only = server.stream(&events, None).await;
    let refused = server.send("GET", &events, |request| request.header("accept", "text/event-stream")).await;
    assert!(refused.expect_problem(429, "too-many-streams").starts_with("1 streams in all are open"));
}

pub(super) async fn a_list_tells_of_each_job_that_changes(coverage: Coverage) {
    let limits = RequestLimits { key_recheck_interval: Duration::from_millis(5), ..Setup::default().limits };
    let server = Server::start_with(&coverage, no_worker(limits)).await;
    let scopes = [Scope::JobsWrite, Scope::Read];
    let [mine, other] = [server.key(&scopes).await, server.key(&scopes).await];
    let create = async |key: &TestKey| {
        let created = server.send("POST", "/v1/jobs", |request| {
            request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
        });
        created.await.expect(201).header("location").to_owned()
    };
    let follow = async |path: &str| {
        let open = server.open("GET", path, |request| {
            request.bearer_auth(&mine.key).header("accept", "text/event-stream")
        });
        Reader::new(open.await)
    };
    let next = async |stream: &mut Reader| {
        let frame = stream.next().await.expect("an event");
        let job = frame.json();
        let state = job["state"].as_str().unwrap_or_default().to_owned();
        (frame.event, format!("/v1/jobs/{}", job["id"].as_str().expect("an id")), state)
    };
    let job = |path: &str, state: &str| ("job".to_owned(), path.to_owned(), state.to_owned());

    let first = create(&mine).await;
    let foreign = create(&other).await;
    let mut all = follow("/v1/jobs").await;
    assert_eq!(next(&mut all).await, job(&first, "queued"));
    let second = create(&mine).await;
    assert_eq!(next(&mut all).await, job(&second, "queued"), "what is another's is not told");
    with_key(&server, "POST", &format!("{first}/cancel"), &mine.key).await.expect(200);
    assert_eq!(next(&mut all).await, job(&first, "cancelled"));
    with_key(&server, "DELETE", &first, &mine.key).await.expect(204);
    assert_eq!(next(&mut all).await, ("gone".to_owned(), first, String::new()));

    let mut running = follow("/v1/jobs?state=running").await;
    with_key(&server, "POST", &format!("{foreign}/cancel"), &other.key).await.expect(200);
    let lease = server.store.claim("test").await.expect("a claim").expect("a job").lease;
    assert_eq!(next(&mut running).await, job(&second, "running"));
    let failed = Outcome::Failed(Problem::new(ProblemType::DeviceLost, "as the test wants it"));
    server.store.finish(&lease, failed).await.expect("ended");
    assert_eq!(next(&mut running).await, job(&second, "failed"), "as it leaves the list");

    let whole = server.send("GET", "/v1/jobs", |request| {
        request.bearer_auth(&mine.key).header("accept", "text/event-stream")
    });
    let (whole, ()) = tokio::join!(whole, async {
        tokio::time::sleep(Duration::from_millis(50)).await;
        server.revoke(&mine).await;
    });
    let last = frames(&whole.expect(200).body).pop().expect("a word");
    assert_eq!((&*last.event, last.json()), ("closed", json!({ "reason": "key-revoked" })));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_kind_of_event_has_its_name_in_a_stream() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.create("retry").await;
    server.reaches(&job, "failed").await;
    let all = to_the_end(server.stream(&format!("{job}/events"), None).await).await;
    let mut kinds: Vec<&str> = all.iter().map(|frame| &*frame.event).collect();
    assert!(all.iter().all(|frame| frame.json()["kind"] == *frame.event), "{kinds:?}");
    kinds.sort_unstable();
    kinds.dedup();
    assert_eq!(kinds, ["attempt", "phase", "progress", "state"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_silent_stream_shows_that_it_lives() {
    let limits = RequestLimits { keep_alive: Duration::from_millis(5), ..Default::default() };
    let server = Server::start_with(&Coverage::default(), no_worker(limits)).await;
    let job = server.create("succeed").await;
    let mut stream = server.stream(&format!("{job}/events"), Some(1)).await;
    let mut comments = 0;
    while comments < 3 {
        let block = stream.block().await.expect("the stream goes on");
        comments += usize::from(block.starts_with(b":"));
    }
    // One that has seen more than there is, as of a restored backup, is told the rest.
    let mut ahead = server.stream(&format!("{job}/events"), Some(999)).await;
    server.post(&format!("{job}/cancel")).await.expect(200);
    assert_eq!(ahead.next().await.expect("the end of the job").number(), 2);
    assert_eq!(ahead.next().await, None);
    let last = stream.next().await.expect("the end of the job");
    assert_eq!((last.number(), &last.json()["data"]["state"]), (2, &json!("cancelled")));
    assert_eq!(stream.next().await, None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_waits_outlives_a_failing_database() {
    let server = Server::start_with(&Coverage::default(), no_worker(RequestLimits::default())).await;
    let job = server.create("succeed").await;
    let mut stream = server.stream(&format!("{job}/events"), None).await;
    assert_eq!(stream.next().await.map(|frame| frame.number()), Some(1));
    server.faults.set(Some(crate::support::faults::Failing::Gone));
    let mut other = server.stream(&format!("{job}/events"), None).await;
    assert_eq!(other.response().status(), 500);
    assert_eq!(other.next().await, None);
    server.faults.set(None);
    server.post(&format!("{job}/cancel")).await.expect(200);
    assert_eq!(stream.next().await.map(|frame| frame.number()), Some(2), "a wait outlives a failure");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_client_that_follows_across_a_restart_misses_nothing_and_gets_nothing_twice() {
    let mut server = Server::start_with(&Coverage::default(), no_worker(RequestLimits::default())).await;
    let job = server.create("succeed").await;
    let events = format!("{job}/events");
    let lease = server.store.claim("test").await.expect("a claim").expect("a job").lease;
    let mut stream = server.stream(&events, None).await;
    let mut seen = Vec::new();
    for _ in 0..3 {
        seen.push(stream.next().await.expect("an event"));
    }

    // The server stops with the stream open; the worker, another process, goes on.
    server.shutdown.cancel();
    assert_eq!(stream.next().await, None, "the stream ends so that the server can stop");
    (&mut server.serving).await.expect("the server stops");
    let progress = |step| Progress { step, total: 10, ..Progress::default() };
    server.store.report(&lease, Phase::Train, &progress(5)).await.expect("stored");

    let reopened = Store::open(&server.database(), Arc::new(SystemClock), quick_policy()).await;
    let store = reopened.expect("the database");
    let services = Services { store: store.clone(), ..server.services.clone() };
    let config = HttpConfig { listen: server.address, ..HttpConfig::default() };
    let listener = http::bind(&config, false).await.expect("the same port");
    let stop = CancellationToken::new();
    let serving = tokio::spawn(http::serve(listener, config, services, stop.clone()));
    let last = seen.last().map(Frame::number);
    let mut stream = server.stream(&events, last).await;
    seen.push(stream.next().await.expect("what happened between the servers"));
    server.store.report(&lease, Phase::Encode, &progress(10)).await.expect("stored");
    let failed = Outcome::Failed(Problem::new(ProblemType::DeviceLost, "as the test wants it"));
    server.store.finish(&lease, failed).await.expect("ended");
    seen.extend(to_the_end(stream).await);

    let past = store.events(lease.job, 0, 1000).await.expect("read").expect("a job");
    let past: Vec<Value> = past.iter().map(|event| serde_json::to_value(event).expect("JSON")).collect();
    assert_eq!(told(&seen), past);
    assert_eq!(past.last().map(|last| &last["data"]["state"]), Some(&json!("failed")));
    stop.cancel();
    serving.await.expect("the second server stops");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_hundred_clients_follow_a_job() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.create("gate").await;
    let mut following = Vec::new();
    for _ in 0..100 {
        let stream = server.stream(&format!("{job}/events"), None).await;
        assert_eq!(stream.response().status(), 200);
        following.push(tokio::spawn(to_the_end(stream)));
    }
    server.runner.gate.open();
    let mut all = Vec::new();
    for stream in following {
        all.push(told(&stream.await.expect("the stream ends")));
    }
    let past = history(&server, &job).await;
    assert!(all.iter().all(|told| *told == past));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_ends_with_a_word_soon_after_its_key_or_link_is_revoked() {
    let limits = RequestLimits { key_recheck_interval: Duration::from_millis(5), ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), no_worker(limits)).await;
    let [mine, other] =
        [server.key(&[Scope::JobsWrite, Scope::Read]).await, server.key(&[Scope::Admin]).await];
    let created = server.send("POST", "/v1/jobs", |request| {
        request.bearer_auth(&mine.key).header("content-type", "application/zip").body("succeed")
    });
    let events = format!("{}/events", created.await.expect(201).header("location"));
    let follow = async |key: &TestKey| {
        let open = server.open("GET", &events, |request| {
            request.bearer_auth(&key.key).header("accept", "text/event-stream")
        });
        Reader::new(open.await)
    };
    let (mut stream, mut others) = (follow(&mine).await, follow(&other).await);
    assert_eq!(stream.next().await.map(|frame| frame.event).as_deref(), Some("state"));

    let made = with_key(&server, "POST", &events.replace("/events", "/shares"), &other.key).await.expect(201);
    let link = made.json()["url"].as_str().expect("a path").replace("/report", "/events");
    let open = server.open("GET", &link, |request| request.header("accept", "text/event-stream"));
    let mut shared = Reader::new(open.await);
    assert_eq!(shared.next().await.map(|frame| frame.event).as_deref(), Some("state"));
    with_key(&server, "DELETE", made.header("location"), &other.key).await.expect(204);
    let last = shared.next().await.expect("a word");
    assert_eq!((&*last.event, last.json()), ("closed", json!({ "reason": "link-closed" })));
    assert_eq!(shared.next().await, None, "and the end");

    server.revoke(&mine).await;
    let last = stream.next().await.expect("a word");
    assert_eq!((&*last.event, &*last.id, last.json()), ("closed", "", json!({ "reason": "key-revoked" })));
    assert_eq!(stream.next().await, None, "and the end");
    with_key(&server, "POST", &events.replace("/events", "/cancel"), &other.key).await.expect(200);
    let mut kinds = Vec::new();
    while let Some(frame) = others.next().await {
        kinds.push(frame.event);
    }
    assert_eq!(kinds, ["state", "state"], "another key's stream goes on to the job's end");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_cannot_say_whether_a_key_is_valid_ends_no_stream() {
    let limits = RequestLimits { key_recheck_interval: Duration::from_millis(5), ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), no_worker(limits)).await;
    let job = server.create("succeed").await;
    let key = server.key(&[Scope::Admin]).await;
    let events = format!("{job}/events");
    let open = server
        .open("GET", &events, |request| request.bearer_auth(&key.key).header("accept", "text/event-stream"));
    let mut stream = Reader::new(open.await);
    assert_eq!(stream.next().await.map(|frame| frame.number()), Some(1));
    server.faults.set(Some(crate::support::faults::Failing::Gone));
    tokio::time::sleep(Duration::from_millis(100)).await;
    server.faults.set(None);
    with_key(&server, "POST", &format!("{job}/cancel"), &key.key).await.expect(200);
    assert_eq!(stream.next().await.map(|frame| frame.event).as_deref(), Some("state"), "and not closed");
}
