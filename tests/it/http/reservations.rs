//! Space on the disk: reserved before bytes are stored, and released with all that is refused.

use std::{
    fs,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use object_store::ObjectStore;
use serde_json::json;
use tcgs::{
    domain::{ProjectLimits, Scope},
    http::config::RequestLimits,
};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};

use super::connections::check_raw;
use crate::support::{
    bucket::S3Server,
    contract::Coverage,
    eventually::eventually,
    fakes::{self, DatasetCheck, Gate},
    faults::Failing,
    server::{Answer, Server, Setup, TestKey},
};

fn idle() -> Setup {
    Setup { worker: false, ..Setup::default() }
}

/// Bytes of the files in a folder and in those in it.
fn bytes_in(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries
        .map(|path| if path.is_dir() { bytes_in(&path) } else { fs::metadata(&path).expect("a file").len() })
        .sum()
}

/// Bytes of all that is stored beside the database.
fn stored(server: &Server) -> u64 {
    ["blobs", "staging", "uploads"].map(|name| bytes_in(&server.data.path().join(name))).iter().sum()
}

/// Whether a body says how long it is.
#[derive(Clone, Copy, PartialEq)]
enum Framing {
    Length,
    Chunked,
}

async fn post(server: &Server, path: &str, key: &TestKey, framing: Framing, dataset: Vec<u8>) -> Answer {
    let body = match framing {
        Framing::Length => reqwest::Body::from(dataset),
        Framing::Chunked => {
            let pieces: Vec<_> =
                dataset.chunks(1000).map(|piece| Ok::<_, std::io::Error>(piece.to_vec())).collect();
            reqwest::Body::wrap_stream(futures_util::stream::iter(pieces))
        }
    };
    let sent = server.send("POST", path, |request| {
        request.bearer_auth(&key.key).header("content-type", "application/zip").body(body)
    });
    sent.await
}

/// A dataset of so many bytes that no other test has.
fn dataset(number: usize, bytes: usize) -> Vec<u8> {
    let mut text = format!("succeed {number} ").into_bytes();
    text.resize(bytes, b'x');
    text
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_over_the_quota_is_refused_and_not_stored() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let limits = ProjectLimits { quota_bytes: Some(1 << 10), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    for number in 0..12 {
        let path = ["/v1/jobs", "/v1/scenes"][number % 2];
        let framing = if number < 6 { Framing::Length } else { Framing::Chunked };
        let answer = post(&server, path, &key, framing, dataset(number, 1 << 16)).await;
        let detail = answer.expect_problem(507, "quota-exceeded");
        assert!(detail.contains("quota of 1024"), "{detail}");
        assert_eq!(stored(&server), 0, "{path}");
    }
    let begin = server.send("POST", "/v1/uploads", |request| {
        request.bearer_auth(&key.key).header("tus-resumable", "1.0.0").header("upload-length", 1 << 16)
    });
    begin.await.expect_problem(507, "quota-exceeded");
    for framing in [Framing::Length, Framing::Chunked] {
        post(&server, "/v1/jobs", &key, framing, dataset(framing as usize, 500)).await.expect(201);
    }
    assert_eq!(stored(&server), 1000);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_an_owner_has_already_needs_no_room() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let limits = ProjectLimits { quota_bytes: Some(3000), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    post(&server, "/v1/jobs", &key, Framing::Length, dataset(1, 2500)).await.expect(201);
    for framing in [Framing::Length, Framing::Chunked] {
        for path in ["/v1/jobs", "/v1/scenes"] {
            let again = post(&server, path, &key, framing, dataset(1, 2500)).await;
            assert!(matches!(again.status, 200 | 201), "{path}: {again:?}");
            for other in [dataset(2, 2500), dataset(2, 2400), dataset(2, 2600)] {
                post(&server, path, &key, framing, other).await.expect_problem(507, "quota-exceeded");
            }
            assert_eq!(stored(&server), 2500);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_largest_dataset_is_looked_for_only_beyond_the_quota() {
    let limits = RequestLimits { upload_bytes: 32 << 20, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..idle() }).await;
    let limits = ProjectLimits { quota_bytes: Some(24 << 20), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    // Longer than a reservation grows at a time.
    post(&server, "/v1/jobs", &key, Framing::Chunked, dataset(1, 20 << 20)).await.expect(201);
    assert_eq!(server.faults.calls("largest_dataset"), 0);
    for (number, framing) in [Framing::Length, Framing::Chunked].into_iter().enumerate() {
        let refused = post(&server, "/v1/jobs", &key, framing, dataset(2, 6 << 20)).await;
        refused.expect_problem(507, "quota-exceeded");
        assert_eq!(server.faults.calls("largest_dataset"), number as u32 + 1, "once for each request");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_refused_late_leaves_nothing() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let limits = ProjectLimits { max_active_jobs: Some(1), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    post(&server, "/v1/jobs", &key, Framing::Length, dataset(0, 500)).await.expect(201);
    post(&server, "/v1/jobs", &key, Framing::Length, dataset(1, 5000))
        .await
        .expect_problem(429, "too-many-jobs");
    assert_eq!(stored(&server), 500, "a job too many");
    post(&server, "/v1/jobs", &key, Framing::Length, dataset(0, 500))
        .await
        .expect_problem(429, "too-many-jobs");
    assert_eq!(stored(&server), 500, "what something refers to stays");
    post(&server, "/v1/scenes", &key, Framing::Length, b"bad dataset".to_vec()).await.expect(422);
    assert_eq!(stored(&server), 500, "no dataset");
    let digest = server.send("POST", "/v1/scenes", |request| {
        let request = request.bearer_auth(&key.key).header("content-type", "application/zip");
        request
            .header("content-digest", "sha-256=:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=:")
            .body(dataset(3, 999))
    });
    assert!(matches!(digest.await.status, 400 | 422));
    assert_eq!(stored(&server), 500, "another content than was announced");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_stays_while_nobody_knows_whether_something_refers_to_it() {
    let server = Server::start(&Coverage::default()).await;
    server.faults.set(Some(Failing::Late));
    server.upload("", "succeed late").await.expect_problem(503, "busy");
    super::scenes::keep(&server, "", "succeed late too").await.expect_problem(503, "busy");
    server.faults.set(None);
    server.faults.catch_up().await;
    let jobs = server.get("/v1/jobs").await.expect(200).json();
    server.reaches(jobs["jobs"][0]["links"]["self"].as_str().expect("a path"), "succeeded").await;
    let scenes = server.get("/v1/scenes").await.expect(200).json();
    let of_scene = server.post_json("/v1/jobs", &json!({ "scene_id": scenes["scenes"][0]["id"] })).await;
    server.reaches(of_scene.expect(201).header("location"), "succeeded").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bodies_on_their_way_have_their_room_to_themselves() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let limits = ProjectLimits { quota_bytes: Some(1000), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    let mut first = TcpStream::connect(server.address).await.expect("connects");
    let head = format!(
        "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\nContent-Type: application/zip\r\n\
         Expect: 100-continue\r\nConnection: close\r\nContent-Length: 600\r\n\r\n",
        key.key
    );
    first.write_all(head.as_bytes()).await.expect("sent");
    let mut leave = [0; 25];
    first.read_exact(&mut leave).await.expect("leave to send");
    assert_eq!(&leave, b"HTTP/1.1 100 Continue\r\n\r\n", "the room is reserved by now");
    for (path, framing) in [("/v1/jobs", Framing::Length), ("/v1/scenes", Framing::Chunked)] {
        post(&server, path, &key, framing, dataset(2, 600)).await.expect_problem(507, "quota-exceeded");
    }
    first.write_all(&dataset(1, 600)).await.expect("sent");
    let mut answer = Vec::new();
    first.read_to_end(&mut answer).await.expect("an end");
    assert_eq!(check_raw(&server, "POST", "/v1/jobs", &answer), 201);
    post(&server, "/v1/jobs", &key, Framing::Length, dataset(4, 300)).await.expect(201);
}

/// Announced uploads fill the disk only where their parts stay.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn open_uploads_take_room_on_the_disk_unless_a_bucket_holds_them() {
    const GIB: u64 = 1 << 30;
    let begin_two = async |bucket: Option<Arc<dyn ObjectStore>>| {
        let data = Arc::new(tempfile::tempdir().expect("a folder"));
        let free = fs4::available_space(data.path()).expect("known");
        let min_free_space = free.checked_sub(8 * GIB).expect("a disk with 8 GiB");
        let limits = RequestLimits { min_free_space, ..Setup::default().limits };
        let server = Server::start_in(&Coverage::default(), Setup { limits, bucket, ..idle() }, data).await;
        let begin = async || {
            let begin = server.send("POST", "/v1/uploads", |request| {
                request.header("tus-resumable", "1.0.0").header("upload-length", 5 * GIB)
            });
            begin.await.status
        };
        [begin().await, begin().await]
    };
    assert_eq!(begin_two(None).await, [201, 507]);
    let Some(bucket) = S3Server::shared() else { return };
    assert_eq!(begin_two(Some(bucket.connect(&bucket.prefix()))).await, [201, 201]);
}

/// Only some of it is on the disk at a time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_part_that_the_disk_has_no_longer_room_for_passes_through_to_a_bucket() {
    const GIB: u64 = 1 << 30;
    let Some(bucket) = S3Server::shared() else { return };
    let objects = bucket.connect(&bucket.prefix());
    let coverage = Coverage::default();
    let setup = || Setup { bucket: Some(Arc::clone(&objects)), ..idle() };
    let server = Server::start_with(&coverage, setup()).await;
    let begin = server.send("POST", "/v1/uploads", |request| {
        request.header("tus-resumable", "1.0.0").header("upload-length", 4 * GIB)
    });
    let upload = begin.await.expect(201).header("location").to_owned();
    let free = fs4::available_space(server.data.path()).expect("known");
    let min_free_space = free.checked_sub(2 * GIB).expect("a disk with 4 GiB");
    let limits = RequestLimits { min_free_space, ..setup().limits };
    let fuller = Server::start_in(&coverage, Setup { limits, ..setup() }, Arc::clone(&server.data)).await;
    let head = format!(
        "PATCH {upload} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n\
         Content-Type: application/offset+octet-stream\r\nExpect: 100-continue\r\nContent-Length: {}\r\n\r\n",
        4 * GIB
    );
    let mut stream = TcpStream::connect(fuller.address).await.expect("connects");
    stream.write_all(head.as_bytes()).await.expect("sent");
    let mut leave = [0; 25];
    stream.read_exact(&mut leave).await.expect("an answer");
    assert_eq!(String::from_utf8_lossy(&leave), "HTTP/1.1 100 Continue\r\n\r\n");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_project_that_sends_slowly_leaves_places_to_the_others() {
    let limits = RequestLimits { uploads: 4, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..idle() }).await;
    let [slow, other] = [(); 2].map(|()| server.key_with(&Scope::ALL[..3], ProjectLimits::default()));
    let (slow, other) = (slow.await, other.await);
    let mut held = Vec::new();
    for path in ["/v1/scenes", "/v1/jobs", "/v1/scenes"] {
        let mut stream = TcpStream::connect(server.address).await.expect("connects");
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\nContent-Type: application/zip\r\n\
             Expect: 100-continue\r\nContent-Length: 600\r\n\r\n",
            slow.key
        );
        stream.write_all(head.as_bytes()).await.expect("sent");
        let mut leave = [0; 25];
        stream.read_exact(&mut leave).await.expect("leave to send");
        held.push(stream);
    }
    let refused = post(&server, "/v1/jobs", &slow, Framing::Length, dataset(1, 300)).await;
    let detail = refused.expect_problem(503, "busy");
    assert!(detail.contains("of your project"), "{detail}");
    post(&server, "/v1/jobs", &other, Framing::Length, dataset(2, 300)).await.expect(201);
}

/// A check of datasets that waits at a gate, and how many have begun.
pub(super) fn gated_check() -> (DatasetCheck, Arc<Gate>, Arc<AtomicUsize>) {
    let (gate, begun) = (Arc::new(Gate::default()), Arc::new(AtomicUsize::new(0)));
    let check: DatasetCheck = {
        let (gate, begun) = (Arc::clone(&gate), Arc::clone(&begun));
        Arc::new(move |dataset| {
            begun.fetch_add(1, Ordering::SeqCst);
            gate.pass();
            fakes::check(dataset)
        })
    };
    (check, gate, begun)
}

/// A body of unknown length reserves more than it brings.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_body_did_not_need_of_its_room_is_free_while_it_is_checked() {
    let (check, gate, _) = gated_check();
    let server = Server::start_with(&Coverage::default(), Setup { check, ..idle() }).await;
    let limits = ProjectLimits { quota_bytes: Some(8 << 20), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    let (first, ()) =
        tokio::join!(post(&server, "/v1/jobs", &key, Framing::Chunked, dataset(1, 1000)), async {
            gate.someone_waits().await;
            let begin = server.send("POST", "/v1/uploads", |request| {
                request
                    .bearer_auth(&key.key)
                    .header("tus-resumable", "1.0.0")
                    .header("upload-length", 7 << 20)
            });
            let begun = begin.await;
            gate.open();
            begun.expect(201);
        });
    first.expect(201);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_whose_client_has_gone_is_not_checked_any_more() {
    let (check, gate, begun) = gated_check();
    let limits = RequestLimits { checks: 1, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, check, ..idle() }).await;
    let active = async |requests: usize| {
        let line = format!("\nhttp_active_requests {requests}\n");
        eventually(&line, async || {
            let text = server.get("/metrics").await.expect(200).body;
            String::from_utf8_lossy(&text).contains(&line)
        })
        .await;
    };
    let (first, ()) = tokio::join!(server.upload("", "succeed"), async {
        gate.someone_waits().await;
        let others =
            futures_util::future::join(server.upload("", "succeed 2"), server.upload("", "succeed 3"));
        tokio::select! {
            _ = others => panic!("the check of the first has not ended"),
            // Two that wait, the first, and the one that asks.
            () = active(4) => {}
        }
        // Their connections are closed now.
        active(2).await;
        gate.open();
    });
    first.expect(201);
    server.upload("", "succeed").await.expect(201);
    assert_eq!(begun.load(Ordering::SeqCst), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_in_a_folder_takes_a_place_to_become_a_scene() {
    let coverage = Coverage::default();
    let server = Server::start_with(&coverage, idle()).await;
    let upload = super::uploads::begin(&server, 9).await;
    super::uploads::part(&server, &upload, 0, b"succeed 9").await.expect(204);
    let limits = RequestLimits { uploads: 0, ..Setup::default().limits };
    let busy = Server::start_in(&coverage, Setup { limits, ..idle() }, Arc::clone(&server.data)).await;
    super::uploads::make_scene(&busy, &upload).await.expect_problem(503, "busy");
    super::uploads::make_scene(&server, &upload).await.expect(201);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_in_a_bucket_becomes_a_scene_only_where_there_is_room_for_its_archive() {
    let Some(bucket) = S3Server::shared() else { return };
    let objects = bucket.connect(&bucket.prefix());
    let coverage = Coverage::default();
    let setup = || Setup { bucket: Some(Arc::clone(&objects)), ..idle() };
    let server = Server::start_with(&coverage, setup()).await;
    // The bytes of the upload are all that the project may have: they count once.
    let limits = ProjectLimits { quota_bytes: Some(9), ..ProjectLimits::default() };
    let key = server.key_with(&Scope::ALL[..3], limits).await;
    let begin = server.send("POST", "/v1/uploads", |request| {
        request.bearer_auth(&key.key).header("tus-resumable", "1.0.0").header("upload-length", 9)
    });
    let upload = begin.await.expect(201).header("location").to_owned();
    let part = server.send("PATCH", &upload, |request| {
        let request = request.bearer_auth(&key.key).header("tus-resumable", "1.0.0");
        let request = request.header("upload-offset", 0);
        request.header("content-type", "application/offset+octet-stream").body("succeed 9")
    });
    part.await.expect(204);
    let make_scene = async |server: &Server| {
        let id = upload.rsplit('/').next().expect("an id");
        let body = json!({ "upload_id": id });
        server.send("POST", "/v1/scenes", |request| request.bearer_auth(&key.key).json(&body)).await
    };

    let limits = RequestLimits { min_free_space: 1 << 60, ..setup().limits };
    let full = Server::start_in(&coverage, Setup { limits, ..setup() }, Arc::clone(&server.data)).await;
    make_scene(&full).await.expect_problem(507, "storage-full");
    let limits = RequestLimits { uploads: 0, ..setup().limits };
    let busy = Server::start_in(&coverage, Setup { limits, ..setup() }, Arc::clone(&server.data)).await;
    make_scene(&busy).await.expect_problem(503, "busy");
    make_scene(&server).await.expect(201);
}

pub(super) async fn below_the_floor_of_free_space_nothing_is_taken_in(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let scene = super::scenes::keep(&server, "", "succeed").await.expect(201).json()["id"].clone();
    let done = server.succeeded().await;
    let failed = server.create("fail").await;
    server.reaches(&failed, "failed").await;
    let begin = async |server: &Server| {
        let begin = server.send("POST", "/v1/uploads", |request| {
            request.header("tus-resumable", "1.0.0").header("upload-length", 9)
        });
        begin.await
    };
    let upload = begin(&server).await.expect(201).header("location").to_owned();
    let limits = RequestLimits { min_free_space: 1 << 60, ..Setup::default().limits };
    let low = Server::start_in(&coverage, Setup { limits, ..idle() }, Arc::clone(&server.data)).await;
    let before = stored(&low);
    low.upload("", "succeed with something new").await.expect_problem(507, "storage-full");
    super::scenes::keep(&low, "", "succeed with more").await.expect_problem(507, "storage-full");
    begin(&low).await.expect_problem(507, "storage-full");
    let part = low.send("PATCH", &upload, |request| {
        let request = request.header("tus-resumable", "1.0.0").header("upload-offset", 0);
        request.header("content-type", "application/offset+octet-stream").body("succeed 9")
    });
    part.await.expect_problem(507, "storage-full");
    low.post_json("/v1/jobs", &json!({ "scene_id": scene })).await.expect_problem(507, "storage-full");
    low.post(&format!("{failed}/retry")).await.expect_problem(507, "storage-full");
    low.exporter.gate.open();
    low.get(&format!("{done}/export?format=ply")).await.expect_problem(507, "storage-full");
    assert_eq!(low.exporter.made.load(Ordering::SeqCst), 0);
    assert_eq!(stored(&low), before);
    low.get("/readyz").await.expect_problem(503, "not-ready");
    server.upload("", "succeed with something new").await.expect(201);
}
