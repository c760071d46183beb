//! Files by hash, and scenes exported on demand.

use std::sync::atomic::Ordering;

use serde_json::{Value, json};
use tcgs::domain::{ProjectLimits, Scope};
use tokio::io::AsyncWriteExt as _;

use super::access::with_key;
use crate::support::{
    contract::Coverage,
    eventually::eventually,
    fakes,
    faults::Failing,
    server::{Server, Setup, TestKey},
};

/// A finished job with three files, and its path.
async fn curve(server: &Server) -> String {
    let made = server.upload("?rd_curve=0.004,0.0005,0.001,0.002", "succeed curve").await.expect(201);
    let path = made.header("location").to_owned();
    server.reaches(&path, "succeeded").await;
    path
}

async fn listed(server: &Server, job: &str) -> Vec<Value> {
    let list = server.get(&format!("{job}/artifacts")).await.expect(200).json();
    list["artifacts"].as_array().expect("files").clone()
}

pub(super) async fn every_file_of_a_job_is_listed_and_served_by_its_hash(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = curve(&server).await;
    let files = listed(&server, &job).await;
    let scenes: Vec<&Value> = files.iter().filter(|file| file["kind"] == "tcgs").collect();
    assert_eq!(scenes.len(), 4);
    assert!(files.iter().any(|file| file["kind"] == "cameras" && file["media_type"] == "application/json"));
    for file in &files {
        assert_eq!((&file["origin"], &file["gaussians"]), (&json!("job"), &Value::Null));
        assert_eq!(file["fidelity"], Value::Null);
        let path = file["href"].as_str().expect("a path");
        let whole = server.get(path).await.expect(200);
        assert_eq!(whole.body.len() as u64, file["bytes"].as_u64().expect("a length"));
        assert_eq!(whole.header("content-type"), file["media_type"]);
        assert_eq!(whole.header("etag"), format!("\"{}\"", file["sha256"].as_str().expect("a hash")));
        assert!(whole.header("cache-control").contains("immutable"));
    }
    let path = scenes[1]["href"].as_str().expect("a path");
    let whole = server.get(path).await.expect(200);
    assert_eq!(whole.body, fakes::curve_file(1));
    assert!(whole.header("content-disposition").contains(".lambda-0.0005.tcgs"), "{:?}", whole.headers);
    let with = |name: &'static str, value: String| {
        let server = &server;
        async move { server.send("GET", path, |request| request.header(name, value)).await }
    };
    let part = with("range", "bytes=5-9".into()).await.expect(206);
    assert_eq!(part.body, whole.body[5..10]);
    assert_eq!(part.header("repr-digest"), whole.header("repr-digest"));
    with("range", "bytes=1000000-".into()).await.expect(416);
    let tag = whole.header("etag").to_owned();
    with("if-none-match", tag.clone()).await.expect(304);
    with("if-match", tag).await.expect(200);
    with("if-match", "\"other\"".into()).await.expect_problem(412, "precondition-failed");
    let head = server.send("HEAD", path, |request| request).await.expect(200);
    assert_eq!((head.body.len(), head.header("content-length")), (0, whole.header("content-length")));
    let artifact = format!("{job}/artifact");
    let other = server.send("GET", &artifact, |request| request.header("if-match", "\"other\"")).await;
    other.expect_problem(412, "precondition-failed");

    let dataset = server.get(&job).await.json()["dataset"]["sha256"].as_str().expect("a hash").to_owned();
    for unknown in [dataset.as_str(), &"0".repeat(64), "17"] {
        let path = format!("/v1/artifacts/{unknown}");
        server.get(&path).await.expect_problem(404, "artifact-not-found");
    }
    for (failing, status) in [(Failing::Busy, 503), (Failing::Gone, 500)] {
        server.faults.set(Some(failing));
        for path in [path.to_owned(), format!("{job}/artifacts"), format!("{job}/export?format=ply")] {
            server.get(&path).await.expect(status);
        }
        server.faults.set(None);
    }
    server.get("/v1/jobs/17/artifacts").await.expect_problem(404, "job-not-found");
    server.send("DELETE", &job, |request| request).await.expect(204);
    server.get(path).await.expect_problem(404, "artifact-not-found");
}

pub(super) async fn a_scene_is_exported_once_and_kept(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = curve(&server).await;
    let path = format!("{job}/export?format=ply");
    let first = server.get(&path).await.expect(200);
    let cameras = fakes::cameras().iter().filter(|camera| camera.name.starts_with("train")).count();
    assert_eq!(first.body, format!("ply from {cameras} cameras of {} bytes", fakes::FILE.len()));
    assert!(first.header("content-disposition").contains(".lambda-0.004.ply"), "{:?}", first.headers);
    let again = server.get(&path).await.expect(200);
    assert_eq!((&again.body, again.header("etag")), (&first.body, first.header("etag")));
    assert_eq!(server.exporter.made.load(Ordering::SeqCst), 1);
    let part = server.send("GET", &path, |request| request.header("range", "bytes=0-2")).await.expect(206);
    assert_eq!(&part.body[..], b"ply");
    let tag = first.header("etag").to_owned();
    server.send("GET", &path, |request| request.header("if-none-match", tag)).await.expect(304);
    server.send("GET", &path, |request| request.header("if-match", "\"x\"")).await.expect(412);
    server.send("GET", &path, |request| request.header("range", "bytes=999-")).await.expect(416);
    for answer in [&first, &again, &part] {
        assert_eq!(answer.header("x-export-psnr"), "41.26");
        assert_eq!(answer.header("x-export-offset"), "500000 4000000 10");
    }
    let unknown = server.get(&format!("{job}/export?format=spz")).await.expect(200);
    assert!(!unknown.headers.contains_key("x-export-psnr"));
    let older = server.get(&format!("{job}/export?format=spz3")).await.expect(200);
    assert!(older.body.starts_with(b"spz3 from"));
    for packed in [&unknown, &older] {
        assert!(packed.header("content-disposition").contains(".lambda-0.004.spz\""), "{:?}", packed.headers);
    }

    let glb = server.get(&format!("{job}/export?format=glb")).await.expect(200);
    assert_eq!((&glb.body[..8], glb.header("content-type")), (&b"glb from"[..], "model/gltf-binary"));

    let kept = listed(&server, &job).await;
    let exports: Vec<&Value> = kept.iter().filter(|file| file["origin"] == "export").collect();
    let kinds: Vec<&Value> = exports.iter().map(|file| &file["kind"]).collect();
    assert_eq!(kinds, ["ply", "spz", "spz3", "glb"]);
    let fidelity: Vec<&Value> = exports.iter().map(|file| &file["fidelity"]).collect();
    assert_eq!(fidelity, [&json!({ "psnr": 41.256, "views": 2 }), &Value::Null, &Value::Null, &Value::Null]);
    for file in &exports {
        assert_eq!((&file["gaussians"], &file["sh_degree"]), (&json!(5), &json!(3)));
        assert_eq!(file["lambda"], 0.004);
        server.get(file["href"].as_str().expect("a path")).await.expect(200);
    }

    let placed = server.get(&format!("{job}/export?format=spz&scale=0.01")).await.expect(200);
    let text = |turn: &str, ply: &[u8]| format!("spz turned by {turn} of {}", String::from_utf8_lossy(ply));
    assert_eq!(placed.body, text("0 times 0.01", &first.body));
    assert_eq!(placed.header("x-export-offset"), "5000 40000 0.1");
    assert!(placed.header("content-disposition").contains(".lambda-0.004.spz\""), "{:?}", placed.headers);
    let path = format!("{job}/export?format=spz&up=-z");
    let turned = server.get(&path).await.expect(200);
    assert!(turned.body.starts_with(b"spz turned by ") && !turned.body.starts_with(b"spz turned by 0"));
    let part = server.send("GET", &path, |request| request.header("range", "bytes=4-9")).await.expect(206);
    assert_eq!((&part.body[..], part.header("etag")), (&b"turned"[..], turned.header("etag")));
    let head = server.send("HEAD", &path, |request| request).await.expect(200);
    assert_eq!((head.body.len(), head.header("repr-digest")), (0, turned.header("repr-digest")));
    let tag = turned.header("etag").to_owned();
    server.send("GET", &path, |request| request.header("if-none-match", tag)).await.expect(304);
    for (format, media_type) in
        [("glb", "model/gltf-binary"), ("usda", "model/vnd.usda"), ("sog", "application/octet-stream")]
    {
        let path = format!("{job}/export?format={format}&limit_gaussians=7");
        let limited = server.get(&path).await.expect(200);
        assert!(
            limited.header("content-disposition").contains(&format!(".{format}\"")),
            "{:?}",
            limited.headers
        );
        assert_eq!(limited.header("content-type"), media_type);
        let text = String::from_utf8_lossy(&first.body).into_owned();
        let expected = format!("{format} turned by 0 times 1 7 by {cameras} cameras of {text}");
        assert_eq!(String::from_utf8_lossy(&limited.body), expected);
    }
    for (query, named) in [
        ("limit_gaussians=0", "limit_gaussians: "),
        ("limit_gaussians=x", "limit_gaussians: "),
        ("up=w", "up: "),
        ("scale=0", "scale: "),
        ("scale=x", "scale: "),
        ("scale=1e7", "scale: "),
    ] {
        let path = format!("{job}/export?format=spz&{query}");
        let detail = server.get(&path).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{query}: {detail}");
    }
    assert_eq!(listed(&server, &job).await.len(), kept.len(), "what is turned is not kept");

    let plain = server.upload("?model=3dgs", "succeed plain").await.expect(201);
    let plain = plain.header("location").to_owned();
    server.reaches(&plain, "succeeded").await;
    let same = server.get(&format!("{plain}/export?format=ply")).await.expect(200);
    assert_eq!(same.body, fakes::FILE, "it is written so already");
    assert!(!same.headers.contains_key("x-export-psnr"));
    assert_eq!(server.exporter.made.load(Ordering::SeqCst), 4);

    server.send("DELETE", &job, |request| request).await.expect(204);
    server.get(exports[0]["href"].as_str().expect("a path")).await.expect(404);
    server.get(&path).await.expect_problem(404, "job-not-found");
}

pub(super) async fn an_export_that_cannot_be_is_said_so(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = curve(&server).await;
    for (query, named) in [
        ("", "format"),
        ("?format=obj", "format"),
        ("?format=tcgs", "format"),
        ("?format=ply&lambda=x", "lambda"),
        ("?format=ply&size=1", "size"),
    ] {
        let detail = server.get(&format!("{job}/export{query}")).await;
        assert!(detail.expect_problem(422, "invalid-parameter").starts_with(named));
    }
    let fails = format!("{job}/export?format=ply&lambda=0.001");
    for _ in 0..2 {
        server.get(&fails).await.expect_problem(422, "not-exportable");
    }
    server.get(&format!("{job}/export?format=ply&lambda=0.002")).await.expect_problem(500, "internal");
    server.get(&format!("{job}/export?format=ply&lambda=7")).await.expect_problem(404, "no-such-lambda");
    let failed = server.create("fail").await;
    server.reaches(&failed, "failed").await;
    server.get(&format!("{failed}/export?format=ply")).await.expect_problem(409, "no-artifact");
    server.get(&format!("{job}/export?format=spz")).await.expect(200);
}

/// A finished job of a key, and its path.
async fn finished(server: &Server, key: &TestKey) -> String {
    finished_with(server, key, "").await
}

async fn finished_with(server: &Server, key: &TestKey, query: &str) -> String {
    let path = format!("/v1/jobs{query}");
    let made = server.send("POST", &path, |request| {
        request.bearer_auth(&key.key).header("content-type", "application/zip").body("succeed")
    });
    let job = made.await.expect(201).header("location").to_owned();
    eventually("the job has succeeded", async || {
        with_key(server, "GET", &job, &key.key).await.expect(200).json()["state"] == "succeeded"
    })
    .await;
    job
}

pub(super) async fn an_export_needs_room_within_its_owners_quota(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let scopes = [Scope::Read, Scope::JobsWrite];
    let free = server.key(&scopes).await;
    let admin = server.key(&[Scope::Admin]).await;
    let job = finished(&server, &free).await;
    let stored = server.store.usage(free.project).await.expect("read").total();
    let of_free = with_key(&server, "GET", &format!("{job}/export?format=ply"), &free.key).await.expect(200);
    let length = of_free.body.len() as u64;
    let made = || server.exporter.made.load(Ordering::SeqCst);
    assert_eq!(made(), 1);

    // (room beyond the job's own files, whether an export is made before it is refused)
    for (room, tried) in [(0, 0), (length - 1, 1)] {
        let quota = ProjectLimits { quota_bytes: Some(stored + room), ..ProjectLimits::default() };
        let key = server.key_with(&scopes, quota).await;
        let path = format!("{}/export?format=ply", finished(&server, &key).await);
        for asking in [&key, &admin] {
            let before = made();
            let refused = with_key(&server, "GET", &path, &asking.key).await;
            let detail = refused.expect_problem(507, "quota-exceeded");
            assert!(detail.contains(&format!("{stored} are stored")), "{detail}");
            assert_eq!(made(), before + tried);
        }
        assert_eq!(server.store.usage(key.project).await.expect("read").total(), stored);
    }

    let quota = ProjectLimits { quota_bytes: Some(stored + length), ..ProjectLimits::default() };
    let key = server.key_with(&scopes, quota).await;
    let job = finished(&server, &key).await;
    for _ in 0..2 {
        with_key(&server, "GET", &format!("{job}/export?format=ply"), &key.key).await.expect(200);
    }
    let before = made();
    let other = with_key(&server, "GET", &format!("{job}/export?format=spz"), &key.key).await;
    other.expect_problem(507, "quota-exceeded");
    assert_eq!(made(), before, "what cannot be kept is not made");
}

pub(super) async fn few_exports_are_made_at_a_time_and_each_for_all_who_ask(coverage: Coverage) {
    let limits =
        tcgs::http::config::RequestLimits { exports: 1, exports_waiting: 0, ..Setup::default().limits };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let job = curve(&server).await;
    let slow = format!("{job}/export?format=ply&lambda=0.0005");
    // One who asks and goes away again: what was begun for it serves those who ask after it.
    let mut gone = tokio::net::TcpStream::connect(server.address).await.expect("a connection");
    let request = format!("GET {slow} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    gone.write_all(request.as_bytes()).await.expect("sent");
    server.exporter.gate.someone_waits().await;
    drop(gone);
    let other = server.get(&format!("{job}/export?format=ply")).await;
    assert!(other.expect_problem(503, "busy").starts_with("too many exports are in progress"));
    let waiting = futures_util::future::join_all((0..5).map(|_| server.get(&slow)));
    let (answers, ()) = tokio::join!(waiting, async { server.exporter.gate.open() });
    for answer in answers {
        assert_eq!(answer.expect(200).body.len(), answers_length());
    }
    assert_eq!(server.exporter.made.load(Ordering::SeqCst), 1);
    server.get(&format!("{job}/export?format=ply")).await.expect(200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_placed_export_keeps_its_turn_while_it_is_made_also_if_its_client_has_gone() {
    let limits =
        tcgs::http::config::RequestLimits { exports: 1, exports_waiting: 0, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let path = format!("{}/export?format=spz&limit_gaussians=", server.succeeded().await);
    server.get(&format!("{path}2")).await.expect(200);
    let mut gone = tokio::net::TcpStream::connect(server.address).await.expect("a connection");
    let request = format!("GET {path}1 HTTP/1.1\r\nHost: localhost\r\n\r\n");
    gone.write_all(request.as_bytes()).await.expect("sent");
    server.exporter.gate.someone_waits().await;
    drop(gone);
    for _ in 0..20 {
        server.get(&format!("{path}2")).await.expect_problem(503, "busy");
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    server.exporter.gate.open();
    eventually("the turn is given back", async || server.get(&format!("{path}2")).await.status == 200).await;
}

pub(super) async fn one_project_leaves_places_for_the_exports_of_others(coverage: Coverage) {
    let limits =
        tcgs::http::config::RequestLimits { exports: 1, exports_waiting: 1, ..Setup::default().limits };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let scopes = [Scope::Read, Scope::JobsWrite];
    let [one, other] = [server.key(&scopes).await, server.key(&scopes).await];
    let job = finished_with(&server, &one, "?rd_curve=0.004,0.0005").await;
    let job_of_other = finished(&server, &other).await;
    let export = async |job: &str, format: &str, key: &TestKey| {
        with_key(&server, "GET", &format!("{job}/export?format={format}"), &key.key).await
    };
    let refused = async {
        server.exporter.gate.someone_waits().await;
        let detail = export(&job, "spz", &one).await.expect_problem(503, "busy");
        assert!(detail.contains("your project's exports"), "{detail}");
        let waiting = export(&job_of_other, "ply", &other);
        tokio::join!(waiting, async { server.exporter.gate.open() }).0
    };
    let (first, third) = tokio::join!(export(&job, "ply&lambda=0.0005", &one), refused);
    first.expect(200);
    third.expect(200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_export_stays_while_nobody_knows_whether_it_is_recorded() {
    let server = Server::start(&Coverage::default()).await;
    let path = format!("{}/export?format=ply", server.succeeded().await);
    server.faults.set(Some(Failing::Late));
    server.get(&path).await.expect_problem(503, "busy");
    server.faults.set(None);
    server.faults.catch_up().await;
    server.get(&path).await.expect(200);
    assert_eq!(server.exporter.made.load(Ordering::SeqCst), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_that_hangs_delays_no_export_of_the_others() {
    let limits = Setup::default().limits.for_remote_views();
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = curve(&server).await;
    let hanging = format!("{job}/export?format=ply&lambda=0.0005");
    let (hung, ()) = tokio::join!(server.get(&hanging), async {
        server.exporter.gate.someone_waits().await;
        server.get(&format!("{job}/export?format=ply")).await.expect(200);
        server.exporter.gate.open();
    });
    hung.expect(200);
}

/// Length of what the fake exporter writes of the curve's second file.
fn answers_length() -> usize {
    format!("ply from 1 cameras of {} bytes", fakes::curve_file(1).len()).len()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_is_its_project_s_alone() {
    use tcgs::domain::{Digest, ProjectId};
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let digest: Digest =
        listed(&server, &job).await[0]["sha256"].as_str().expect("a hash").parse().expect("a digest");
    let other = ProjectId(uuid::Uuid::from_u128(5));
    assert!(server.store.file(digest, None).await.expect("read").is_some());
    assert_eq!(server.store.file(digest, Some(other)).await.expect("read"), None);
}
