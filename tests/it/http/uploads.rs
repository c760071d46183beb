//! Resumable uploads: tus 1.0.0 over a real socket, with broken connections, restarts and concurrent writers.

use std::{sync::Arc, time::Duration};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use jiff::SignedDuration;
use proptest::prelude::*;
use reqwest::RequestBuilder;
use serde_json::json;
use sha1::Sha1;
use sha2::{Digest as _, Sha256};
use tcgs::{
    domain::{Digest, ManualClock, ProjectId, ProjectLimits, Scope, UploadId},
    http::config::RequestLimits,
    store::{NewUpload, uploads::MAX_OPEN_UPLOADS},
};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};
use uuid::Uuid;

use super::connections::tight_limits;
use crate::support::{
    contract::Coverage,
    eventually::{eventually, within},
    faults::Failing,
    server::{Answer, Server, Setup},
};

const PART: &str = "application/offset+octet-stream";

fn idle() -> Setup {
    Setup { worker: false, ..Setup::default() }
}

fn tus(request: RequestBuilder) -> RequestBuilder {
    request.header("tus-resumable", "1.0.0")
}

pub(super) async fn begin(server: &Server, length: usize) -> String {
    let answer =
        server.send("POST", "/v1/uploads", |request| tus(request).header("upload-length", length)).await;
    let answer = answer.expect(201);
    assert_eq!(answer.header("upload-offset"), "0");
    answer.header("location").to_owned()
}

pub(super) async fn part(server: &Server, upload: &str, offset: usize, bytes: &[u8]) -> Answer {
    part_with(server, upload, offset, bytes, |request| request).await
}

/// The same once nobody else writes: a request that was given up may for a moment still be about to.
async fn part_in_turn(server: &Server, upload: &str, at: usize, bytes: &[u8], sum: Option<&str>) -> Answer {
    within("the part's turn", async {
        loop {
            let answer = part_with(server, upload, at, bytes, |request| match sum {
                Some(sum) => request.header("upload-checksum", sum),
                None => request,
            });
            let answer = answer.await;
            if answer.status != 423 {
                return answer;
            }
        }
    })
    .await
}

async fn part_with(
    server: &Server,
    upload: &str,
    offset: usize,
    bytes: &[u8],
    fill: impl FnOnce(RequestBuilder) -> RequestBuilder,
) -> Answer {
    let bytes = bytes.to_vec();
    server
        .send("PATCH", upload, |request| {
            fill(tus(request).header("content-type", PART).header("upload-offset", offset).body(bytes))
        })
        .await
}

/// How far the upload came.
async fn offset(server: &Server, upload: &str) -> usize {
    let answer = server.send("HEAD", upload, tus).await.expect(200);
    answer.header("upload-offset").parse().expect("a number")
}

pub(super) async fn make_scene(server: &Server, upload: &str) -> Answer {
    let id = upload.rsplit('/').next().expect("an id");
    server.post_json("/v1/scenes", &json!({ "upload_id": id })).await
}

/// Sends the head of a part and some of its bytes, and leaves the connection open.
async fn half_a_part(
    server: &Server,
    upload: &str,
    place: std::ops::Range<usize>,
    bytes: &[u8],
    more: &str,
) -> TcpStream {
    let mut stream = TcpStream::connect(server.address).await.expect("connects");
    let head = format!(
        "PATCH {upload} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nContent-Type: {PART}\r\n\
         Upload-Offset: {}\r\nContent-Length: {}\r\n{more}Connection: close\r\n\r\n",
        place.start,
        place.len(),
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    stream.write_all(bytes).await.expect("sent");
    stream
}

/// Waits until nobody holds the upload.
async fn until_free(server: &Server, upload: &str) {
    let id: UploadId = upload.rsplit('/').next().and_then(|id| id.parse().ok()).expect("an id");
    let is_free = async || server.services.blobs.open_upload(id).await.expect("asked").is_some();
    eventually("nobody holds the upload", is_free).await;
}

/// Waits until some of the upload is written; asking for its lock here could keep the writer out.
async fn until_written(server: &Server, upload: &str) {
    let path = server.data.path().join("uploads").join(upload.rsplit('/').next().expect("an id"));
    let is_there = async || std::fs::metadata(&path).is_ok_and(|file| file.len() > 0);
    eventually("some of the upload is written", is_there).await;
}

pub(super) async fn a_dataset_comes_in_parts_and_becomes_a_scene(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let options = server.send("OPTIONS", "/v1/uploads", |request| request).await.expect(204);
    assert_eq!(options.header("tus-max-size"), (64_u64 << 30).to_string());

    let metadata = format!("filename {},other", STANDARD.encode("garden.zip"));
    let begun = server.send("POST", "/v1/uploads", |request| {
        tus(request).header("upload-length", 14).header("upload-metadata", &metadata)
    });
    let begun = begun.await.expect(201);
    let upload = begun.header("location").to_owned();
    let first = part(&server, &upload, 0, b"succeed ").await.expect(204);
    assert_eq!(first.header("upload-offset"), "8");
    let head = server.send("HEAD", &upload, tus).await.expect(200);
    assert_eq!((head.header("upload-offset"), head.header("upload-length")), ("8", "14"));
    assert_eq!(head.header("upload-metadata"), metadata);
    let detail = make_scene(&server, &upload).await.expect_problem(409, "upload-incomplete");
    assert!(detail.ends_with("is incomplete: 8 of 14 bytes received"), "{detail}");
    part(&server, &upload, 8, b"").await.expect(204);
    part(&server, &upload, 8, b"parts!").await.expect(204);

    let made = make_scene(&server, &upload).await.expect(201);
    let scene = made.json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(b"succeed parts!").to_string());
    assert_eq!(scene["name"], "garden.zip");
    let again = make_scene(&server, &upload).await.expect(200);
    assert_eq!(again.json(), scene);
    assert_eq!(server.services.blobs.uploads().await.expect("a list"), [], "its file is the blob's now");
    let usage = server.services.store.usage(ProjectId::DEFAULT).await.expect("read");
    assert_eq!((usage.stored, usage.reserved), (14, 0));
    for method in ["HEAD", "DELETE"] {
        server.send(method, &upload, tus).await.expect(410);
    }
    part(&server, &upload, 14, b"").await.expect_problem(410, "upload-gone");
    server.send("DELETE", made.header("location"), |request| request).await.expect(204);
    make_scene(&server, &upload).await.expect_problem(410, "upload-gone");
    assert_eq!(server.services.blobs.uploads().await.expect("a list"), [], "nothing is made of what is gone");

    let bad = begin(&server, 3).await;
    part(&server, &bad, 0, b"bad").await.expect(204);
    make_scene(&server, &bad).await.expect(422);
    assert_eq!(offset(&server, &bad).await, 3, "what was refused can still be given up");
    server.send("DELETE", &bad, tus).await.expect(204);
    server.send("HEAD", &bad, tus).await.expect(404);
    server.send("DELETE", &bad, tus).await.expect(404);
    part(&server, &bad, 3, b"").await.expect_problem(404, "upload-not-found");
    let id: UploadId = bad.rsplit('/').next().and_then(|id| id.parse().ok()).expect("an id");
    let files = server.services.blobs.uploads().await.expect("a list");
    assert!(!files.contains(&id), "its file is gone too");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_part_gives_an_upload_its_whole_time_again() {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let server = Server::start_with(&Coverage::default(), Setup { clock: clock.clone(), ..idle() }).await;
    let upload = begin(&server, 10).await;
    let expires = async || {
        let head = server.send("HEAD", &upload, tus).await.expect(200);
        head.header("upload-expires").to_owned()
    };
    assert_eq!(expires().await, "Sun, 22 Nov 2026 12:00:00 GMT");
    clock.advance(SignedDuration::from_hours(23));
    let sent = part(&server, &upload, 0, b"12345").await.expect(204);
    assert_eq!(sent.header("upload-expires"), "Mon, 23 Nov 2026 11:00:00 GMT");
    assert_eq!(expires().await, sent.header("upload-expires"));
}

/// Bytes of a part after which what came is recorded, though the part goes on.
const RECORDED: usize = 16 << 20;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_long_part_is_recorded_on_its_way_unless_a_checksum_may_undo_it() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let content = vec![b'x'; RECORDED + (1 << 20)];
    let upload = begin(&server, 2 * RECORDED).await;
    let open = half_a_part(&server, &upload, 0..2 * RECORDED, &content, "").await;
    eventually("what came is recorded", async || offset(&server, &upload).await >= RECORDED).await;
    drop(open);

    let upload = begin(&server, content.len()).await;
    let wrong = format!("sha256 {}", STANDARD.encode(Sha256::digest(b"other")));
    let answer =
        part_with(&server, &upload, 0, &content, |request| request.header("upload-checksum", wrong)).await;
    assert!(answer.expect_problem(460, "checksum-mismatch").contains("from byte 0"));
    assert_eq!(offset(&server, &upload).await, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_scene_of_an_upload_has_the_name_of_the_request_or_else_of_the_metadata() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let coded = |text: &str| STANDARD.encode(text);
    let both = format!("filename {},name {}", coded("garden.zip"), coded("Garden"));
    for (number, (metadata, wanted, expected)) in [
        (both.clone(), None, json!("Garden")),
        (both, Some("Hall"), json!("Hall")),
        (format!("name {}", coded("a\u{7}b")), None, json!(null)),
        (format!("name {}", coded(&"x".repeat(201))), None, json!(null)),
    ]
    .into_iter()
    .enumerate()
    {
        let content = format!("succeed {number}");
        let begun = server.send("POST", "/v1/uploads", |request| {
            tus(request).header("upload-length", content.len()).header("upload-metadata", &metadata)
        });
        let upload = begun.await.expect(201).header("location").to_owned();
        part(&server, &upload, 0, content.as_bytes()).await.expect(204);
        let mut body = json!({ "upload_id": upload.rsplit('/').next() });
        if let Some(name) = wanted {
            body["name"] = json!(name);
        }
        let scene = server.post_json("/v1/scenes", &body).await.expect(201).json();
        assert_eq!(scene["name"], expected, "{metadata} {wanted:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_stays_until_its_scene_is_recorded() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let upload = begin(&server, 9).await;
    part(&server, &upload, 0, b"succeed 9").await.expect(204);
    server.faults.set(Some(Failing::Late));
    make_scene(&server, &upload).await.expect_problem(503, "busy");
    server.faults.set(None);
    make_scene(&server, &upload).await.expect(201);
}

pub(super) async fn methods_come_through_proxies_as_post(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let upload = begin(&server, 14).await;
    let post = |method: &'static str, offset: usize, body: &'static str| {
        server.send("POST", &upload, move |request| {
            tus(request)
                .header("x-http-method-override", method)
                .header("upload-offset", offset)
                .header("content-type", "application/offset+octet-stream")
                .body(body)
        })
    };
    let first = post("PATCH", 0, "succeed ").await.expect(204);
    assert_eq!(first.header("upload-offset"), "8");
    post("PATCH", 0, "again").await.expect_problem(409, "offset-mismatch");
    assert_eq!(post("HEAD", 0, "").await.expect(200).header("upload-offset"), "8");
    let refused = post("PUT", 0, "").await;
    assert!(refused.header("allow").contains("PATCH"), "{:?}", refused.headers);
    refused.expect_problem(405, "method-not-allowed");
    server.send("POST", &upload, tus).await.expect_problem(405, "method-not-allowed");
    post("DELETE", 0, "").await.expect(204);
    server.send("HEAD", &upload, tus).await.expect(404);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bodies_in_a_content_coding_are_called_by_its_name() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let upload = begin(&server, 3).await;
    for (method, path, kind) in [
        ("POST", "/v1/jobs", "application/zip"),
        ("POST", "/v1/jobs", "application/json"),
        ("POST", "/v1/scenes", "application/zip"),
        ("POST", "/v1/scenes", "application/json"),
        ("PATCH", &*upload, "application/offset+octet-stream"),
    ] {
        let answer = server.send(method, path, |request| {
            let request = tus(request).header("content-type", kind).header("upload-offset", 0);
            request.header("content-encoding", "gzip").body("\u{1f}")
        });
        let answer = answer.await;
        assert_eq!(answer.header("accept-encoding"), "identity");
        let detail = answer.expect_problem(415, "unsupported-media-type");
        assert!(detail.contains("the Content-Encoding is gzip"), "{method} {path}: {detail}");
    }
}

pub(super) async fn headers_that_make_no_sense_are_named(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let create = |headers: Vec<(&'static str, &'static str)>| {
        server.send("POST", "/v1/uploads", move |mut request| {
            for (name, value) in headers {
                request = request.header(name, value);
            }
            request
        })
    };
    let version = ("tus-resumable", "1.0.0");
    for headers in [vec![("upload-length", "1")], vec![("tus-resumable", "0.2.2"), ("upload-length", "1")]] {
        let answer = create(headers).await.expect(412);
        assert_eq!((answer.header("tus-version"), answer.header("tus-resumable")), ("1.0.0", "1.0.0"));
    }
    for (headers, named) in [
        (vec![version], "upload-length"),
        (vec![version, ("upload-length", "-1")], "upload-length"),
        (vec![version, ("upload-length", "18446744073709551616")], "upload-length"),
        (vec![version, ("upload-defer-length", "1")], "upload-defer-length"),
        (vec![version, ("upload-length", "1"), ("upload-metadata", "a,a")], "upload-metadata"),
        (vec![version, ("upload-length", "1"), ("upload-metadata", "name !")], "upload-metadata"),
    ] {
        let detail = create(headers).await.expect_problem(400, "invalid-header");
        assert!(detail.starts_with(named), "{detail}");
    }
    let body = server
        .send("POST", "/v1/uploads", |request| tus(request).header("upload-length", 1).body("x"))
        .await
        .expect_problem(400, "invalid-header");
    assert!(body.contains("PATCH"), "{body}");
    let query = server.send("POST", "/v1/uploads?name=x", |request| tus(request).header("upload-length", 1));
    query.await.expect_problem(422, "invalid-parameter");

    let upload = begin(&server, 5).await;
    server.send("HEAD", &upload, |request| request).await.expect(412);
    server.send("DELETE", &upload, |request| request).await.expect_problem(412, "tus-version");
    let untyped = server.send("PATCH", &upload, |request| tus(request).header("upload-offset", 0));
    untyped.await.expect_problem(415, "unsupported-media-type");
    let unplaced = server.send("PATCH", &upload, |request| tus(request).header("content-type", PART));
    unplaced.await.expect_problem(400, "invalid-header");
    let unversioned = server.send("PATCH", &upload, |request| request.header("content-type", PART));
    unversioned.await.expect_problem(412, "tus-version");
    for sum in ["md5 XrY7u+Ae7tCTyyK7j1rNww==", "sha1", "sha256 AAAA"] {
        let answer =
            part_with(&server, &upload, 0, b"12345", |request| request.header("upload-checksum", sum));
        answer.await.expect_problem(400, "invalid-header");
    }
    for id in ["17", "0190a5d8-0000-7000-8000-000000000000", "..%2F..%2Fetc", "%00"] {
        let upload = format!("/v1/uploads/{id}");
        server.send("HEAD", &upload, tus).await.expect(404);
        server.send("DELETE", &upload, tus).await.expect_problem(404, "upload-not-found");
        part(&server, &upload, 0, b"x").await.expect_problem(404, "upload-not-found");
    }
    server.get(&upload).await.expect_problem(405, "method-not-allowed");
}

pub(super) async fn parts_that_do_not_fit_change_nothing(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let upload = begin(&server, 10).await;
    part(&server, &upload, 0, b"1234").await.expect(204);
    for wrong in [0, 3, 5, 10] {
        let answer = part(&server, &upload, wrong, b"x").await.expect(409);
        assert_eq!(answer.header("upload-offset"), "4");
    }
    part(&server, &upload, 4, b"5678901").await.expect_problem(413, "body-too-large");
    assert_eq!(offset(&server, &upload).await, 4);
    // Without an announced length it shows only once it comes; what fits stays.
    let streamed = server.send("PATCH", &upload, |request| {
        let pieces = ["56", "7890", "1"].map(Ok::<_, std::io::Error>);
        let body = reqwest::Body::wrap_stream(futures_util::stream::iter(pieces));
        tus(request).header("content-type", PART).header("upload-offset", 4).body(body)
    });
    streamed.await.expect_problem(413, "body-too-large");
    let came = offset(&server, &upload).await;
    assert!((4..=10).contains(&came), "{came}");

    let upload = begin(&server, 10).await;
    let sum = |algorithm: &str, bytes: &[u8]| match algorithm {
        "sha256" => format!("sha256 {}", STANDARD.encode(Sha256::digest(bytes))),
        _ => format!("sha1 {}", STANDARD.encode(Sha1::digest(bytes))),
    };
    for algorithm in ["sha256", "sha1"] {
        let wrong = sum(algorithm, b"other");
        let answer =
            part_with(&server, &upload, 0, b"12345", |request| request.header("upload-checksum", wrong));
        let detail = answer.await.expect_problem(460, "checksum-mismatch");
        assert!(detail.contains("from byte 0"), "{detail}");
        assert_eq!(offset(&server, &upload).await, 0);
    }
    for (at, algorithm) in [(0, "sha256"), (5, "sha1")] {
        let right = sum(algorithm, b"12345");
        let answer =
            part_with(&server, &upload, at, b"12345", |request| request.header("upload-checksum", right));
        answer.await.expect(204);
    }
    let scene = make_scene(&server, &upload).await.expect(201).json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(b"1234512345").to_string());
}

pub(super) async fn an_upload_that_waits_too_long_is_over(coverage: Coverage) {
    let limits = RequestLimits { upload_ttl: Duration::ZERO, ..RequestLimits::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..idle() }).await;
    let upload = begin(&server, 10).await;
    part(&server, &upload, 0, b"x").await.expect_problem(410, "upload-gone");
    server.send("HEAD", &upload, tus).await.expect(410);
    server.send("DELETE", &upload, tus).await.expect_problem(410, "upload-gone");
    make_scene(&server, &upload).await.expect_problem(410, "upload-gone");
}

pub(super) async fn room_is_kept_from_the_beginning(coverage: Coverage) {
    let limits = RequestLimits { resumable_bytes: 1 << 50, ..RequestLimits::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..idle() }).await;
    let create = |length: u64, key: Option<String>| {
        server.send("POST", "/v1/uploads", move |request| {
            let request = tus(request).header("upload-length", length);
            if let Some(key) = key { request.bearer_auth(key) } else { request }
        })
    };
    let large = create((1 << 50) + 1, None).await.expect(413);
    assert_eq!(large.header("tus-max-size"), (1_u64 << 50).to_string());
    create(1 << 50, None).await.expect_problem(507, "storage-full");

    let limits = ProjectLimits { quota_bytes: Some(100), ..ProjectLimits::default() };
    let key = server.key_with(&[Scope::DatasetsWrite], limits).await;
    let other = server.key(&[Scope::DatasetsWrite]).await;
    let first = create(60, Some(key.key.clone())).await.expect(201);
    let detail = create(41, Some(key.key.clone())).await.expect_problem(507, "quota-exceeded");
    assert!(detail.contains("60 are stored or reserved"), "{detail}");
    let upload = first.header("location").to_owned();
    let foreign = server.send("DELETE", &upload, |request| tus(request).bearer_auth(&other.key)).await;
    foreign.expect_problem(404, "upload-not-found");
    let body = json!({ "upload_id": upload.rsplit('/').next() });
    let foreign =
        server.send("POST", "/v1/scenes", |request| request.bearer_auth(&other.key).json(&body)).await;
    foreign.expect_problem(404, "upload-not-found");
    server.send("DELETE", &upload, |request| tus(request).bearer_auth(&key.key)).await.expect(204);
    create(100, Some(key.key.clone())).await.expect(201);
}

pub(super) async fn bodies_of_parts_that_dawdle_or_break_off_keep_what_came(coverage: Coverage) {
    let limits = RequestLimits { resumable_bytes: 100, ..tight_limits() };
    let server = Server::start_with(&coverage, Setup { limits, ..idle() }).await;
    let upload = begin(&server, 10).await;
    let mut stream = half_a_part(&server, &upload, 0..10, b"12345", "").await;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an end");
    assert_eq!(super::connections::check_raw(&server, "PATCH", &upload, &answer), 408);
    assert_eq!(offset(&server, &upload).await, 5);

    let mut stream = TcpStream::connect(server.address).await.expect("connects");
    let head = format!(
        "PATCH {upload} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nContent-Type: {PART}\r\n\
         Upload-Offset: 5\r\nTransfer-Encoding: chunked\r\nConnection: close\r\n\r\n2\r\n67\r\nno length\r\n"
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an end");
    assert_eq!(super::connections::check_raw(&server, "PATCH", &upload, &answer), 400);
    assert_eq!(offset(&server, &upload).await, 7);
    part(&server, &upload, 7, b"890").await.expect(204);

    let busy = RequestLimits { uploads: 0, ..tight_limits() };
    let server = Server::start_with(&coverage, Setup { limits: busy, ..idle() }).await;
    let upload = begin(&server, 10).await;
    part(&server, &upload, 0, b"x").await.expect_problem(503, "busy");
}

pub(super) async fn one_request_at_a_time_writes(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let upload = begin(&server, 10).await;
    let mut first = half_a_part(&server, &upload, 0..10, b"12345", "").await;
    until_written(&server, &upload).await;
    part(&server, &upload, 0, b"rival").await.expect_problem(423, "upload-locked");
    server.send("DELETE", &upload, tus).await.expect_problem(423, "upload-locked");
    let detail = make_scene(&server, &upload).await.expect_problem(409, "upload-locked");
    assert!(detail.contains("another request"), "{detail}");
    first.write_all(b"67890").await.expect("sent");
    let mut answer = Vec::new();
    first.read_to_end(&mut answer).await.expect("an end");
    assert_eq!(super::connections::check_raw(&server, "PATCH", &upload, &answer), 204);
    let scene = make_scene(&server, &upload).await.expect(201).json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(b"1234567890").to_string());

    // Two at once, whichever is first: never both.
    let upload = begin(&server, 4).await;
    let (a, b) = tokio::join!(part(&server, &upload, 0, b"aaaa"), part(&server, &upload, 0, b"bbbb"));
    let mut statuses = [a.status, b.status];
    statuses.sort_unstable();
    assert_eq!(statuses[0], 204);
    assert!(matches!(statuses[1], 409 | 423), "{statuses:?}");
    let scene = make_scene(&server, &upload).await.expect(201).json();
    let sums = [b"aaaa", b"bbbb"].map(|content| Digest::of(content).to_string());
    assert!(sums.iter().any(|sum| scene["dataset"]["sha256"] == *sum));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_writer_that_dies_frees_the_upload_and_what_it_brought_stays() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    for (checksum, kept) in [("", 5), ("Upload-Checksum: sha1 qZk+NkcGgWq6PiVxeFDCbJzQ2J0=\r\n", 0)] {
        let upload = begin(&server, 10).await;
        let stream = half_a_part(&server, &upload, 0..10, b"12345", checksum).await;
        until_written(&server, &upload).await;
        drop(stream);
        until_free(&server, &upload).await;
        assert_eq!(offset(&server, &upload).await, kept);
        part(&server, &upload, kept, &b"1234567890"[kept..]).await.expect(204);
        let answer = make_scene(&server, &upload).await;
        assert!(matches!(answer.status, 200 | 201), "{answer:?}");
        assert_eq!(answer.json()["dataset"]["sha256"], Digest::of(b"1234567890").to_string());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_goes_on_after_a_restart_from_what_was_recorded() {
    let coverage = Coverage::default();
    let server = Server::start_with(&coverage, idle()).await;
    let upload = begin(&server, 10).await;
    part(&server, &upload, 0, b"1234").await.expect(204);
    // What a killed server leaves: bytes that reached the file and not the table.
    let id: UploadId = upload.rsplit('/').next().and_then(|id| id.parse().ok()).expect("an id");
    let mut file = server.services.blobs.open_upload(id).await.expect("opens").expect("free");
    file.continue_at(4).await.expect("at the end");
    file.write(b"lost").await.expect("written");
    file.sync().await.expect("on disk");
    drop(file);
    let data = Arc::clone(&server.data);
    server.shutdown.cancel();
    drop(server);

    let server = Server::start_in(&coverage, idle(), data).await;
    assert_eq!(offset(&server, &upload).await, 4);
    part(&server, &upload, 8, b"90").await.expect(409);
    part(&server, &upload, 4, b"567890").await.expect(204);
    let scene = make_scene(&server, &upload).await.expect(201).json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(b"1234567890").to_string());
}

/// Something that a client may do to an upload.
#[derive(Debug, Clone)]
enum Step {
    /// Sends so many bytes from where the upload is.
    Send(usize),
    /// Sends from elsewhere.
    SendAt(usize),
    /// Sends with a checksum, right or wrong.
    Sum(usize, bool),
    /// Breaks off a part.
    BreakOff(usize),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (0_usize..40).prop_map(Step::Send),
        (0_usize..120).prop_map(Step::SendAt),
        (0_usize..40, any::<bool>()).prop_map(|(count, right)| Step::Sum(count, right)),
        (0_usize..40).prop_map(Step::BreakOff),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// Whatever a client does, the offset is how much of the content has come, and no byte of it is another.
    #[test]
    fn the_offset_is_always_what_came(steps in prop::collection::vec(step(), 0..12)) {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        runtime.expect("a runtime").block_on(async {
            let server = Server::start_with(&Coverage::default(), idle()).await;
            let content: Vec<u8> = (0..100_u8).collect();
            let upload = begin(&server, content.len()).await;
            let mut came = 0;
            for step in steps {
                let next = |count: usize| &content[came..(came + count).min(content.len())];
                match step {
                    Step::Send(count) => {
                        part_in_turn(&server, &upload, came, next(count), None).await.expect(204);
                        came += next(count).len();
                    }
                    Step::SendAt(at) if at == came => {}
                    Step::SendAt(at) => {
                        part_in_turn(&server, &upload, at, b"elsewhere", None).await.expect(409);
                    }
                    Step::Sum(count, right) => {
                        let bytes = next(count);
                        let sum = if right { Sha256::digest(bytes) } else { Sha256::digest(b"not these") };
                        let sum = format!("sha256 {}", STANDARD.encode(sum));
                        let answer = part_in_turn(&server, &upload, came, bytes, Some(&sum)).await;
                        answer.expect(if right { 204 } else { 460 });
                        came += if right { bytes.len() } else { 0 };
                    }
                    Step::BreakOff(count) => {
                        let bytes = next(count);
                        let mut stream =
                            half_a_part(&server, &upload, came..content.len(), bytes, "").await;
                        stream.shutdown().await.expect("closed");
                        // The server closes once the request is given up or answered.
                        stream.read_to_end(&mut Vec::new()).await.expect("an end");
                        until_free(&server, &upload).await;
                        let now = offset(&server, &upload).await;
                        assert!((came..=came + bytes.len()).contains(&now), "{now} after {came}");
                        came = now;
                    }
                }
                assert_eq!(offset(&server, &upload).await, came);
            }
            part_in_turn(&server, &upload, came, &content[came..], None).await.expect(204);
            let scene = make_scene(&server, &upload).await.expect(201).json();
            assert_eq!(scene["dataset"]["sha256"], Digest::of(&content).to_string());
        });
    }
}

pub(super) async fn a_project_has_so_many_open_uploads(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let expires_at = server.services.clock.now() + SignedDuration::from_hours(1);
    for number in 1..=u128::from(MAX_OPEN_UPLOADS) {
        let (id, project) = (UploadId(Uuid::from_u128(number)), ProjectId::DEFAULT);
        let new = NewUpload { id, project, length: 0, metadata: None, expires_at };
        server.store.create_upload(new).await.expect("room");
    }
    let begin = || server.send("POST", "/v1/uploads", |request| tus(request).header("upload-length", 0));
    begin().await.expect_problem(429, "too-many-uploads");
    let path = format!("/v1/uploads/{}", UploadId(Uuid::from_u128(1)));
    server.send("DELETE", &path, tus).await.expect(204);
    begin().await.expect(201);
}
