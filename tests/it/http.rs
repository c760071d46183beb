//! The API over a real socket. Every answer is held to `openapi.yaml`, and the last test asserts that every
//! operation and status of it was seen.

use std::time::Duration;

use serde_json::{Value, json};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};
use tower::ServiceExt as _;

use crate::support::{
    contract::Coverage,
    fakes,
    faults::Failing,
    server::{Answer, Server, Setup, picture as picture_of},
};

/// Statuses that no test can bring about, with the reason.
const UNSEEN: &[(&str, &str, &str)] =
    &[("createJob", "507", "needs a full disk; the mapping has a unit test")];

/// Makes each scenario a test, and one more that runs all of them and asserts that the contract is covered.
macro_rules! scenarios {
    ($($name:ident),+ $(,)?) => {
        mod one_by_one {
            use super::Coverage;
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                super::$name(Coverage::default()).await;
            })+
        }

        #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
        async fn every_operation_and_status_of_the_contract_is_seen() {
            let coverage = Coverage::default();
            $(Box::pin($name(coverage.clone())).await;)+
            let mut missing = coverage.missing();
            for (operation, status, _) in UNSEEN {
                let listed = missing.remove(&((*operation).to_owned(), (*status).to_owned()));
                assert!(listed, "{operation} {status} is listed as unseen, but was seen or is not in the contract");
            }
            assert!(missing.is_empty(), "never seen: {missing:#?}");
        }
    };
}

scenarios!(
    the_service_describes_itself,
    a_dataset_becomes_a_file_with_metrics_and_history,
    the_file_is_served_whole_in_parts_and_conditionally,
    every_file_of_a_curve_is_served_by_its_weight,
    what_is_wrong_with_a_dataset_or_an_option_is_said_before_a_job_is_made,
    bodies_that_break_off_or_dawdle_are_given_up,
    unknown_jobs_frames_paths_and_methods_are_problems,
    jobs_are_listed_newest_first_page_by_page,
    a_queued_job_is_cancelled_at_once_and_a_running_one_soon,
    views_by_frame_pose_and_query_agree,
    views_come_in_three_formats_and_as_multipart,
    impossible_views_are_refused_by_name,
    a_job_without_a_file_has_no_views,
    a_full_render_queue_and_a_broken_renderer_are_told_apart,
    too_many_uploads_at_once_are_put_off,
    a_database_that_fails_is_a_problem_not_a_crash,
    a_handler_that_panics_answers_500_and_the_server_lives,
);

async fn the_service_describes_itself(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    assert_eq!(server.get("/healthz").await.expect(200).json(), json!({ "status": "ok" }));
    let ready = server.get("/readyz").await.expect(200).json();
    assert_eq!(ready["workers"], json!({ "expected": 1, "alive": 1 }));
    assert_eq!(server.get("/version").await.expect(200).json()["version"], env!("CARGO_PKG_VERSION"));
    let contract = server.get("/openapi.yaml").await.expect(200).body;
    let file = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml")).expect("readable");
    assert_eq!(contract, file);
}

async fn a_dataset_becomes_a_file_with_metrics_and_history(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let created = server.upload("?preset=standard&iterations=7&seed=3&background=white", "succeed").await;
    let job = created.expect(201);
    let path = job.header("location").to_owned();
    let body = job.json();
    assert_eq!((&body["state"], &body["attempt"]), (&json!("queued"), &json!(0)));
    assert_eq!(body["options"]["iterations"], 7);
    assert_eq!(body["links"]["self"], path);
    let done = server.reaches(&path, "succeeded").await;
    assert_eq!(done["phase"], "done");
    assert_eq!(done["attempt"], 1);
    assert_eq!(done["progress"]["step"], 7, "the last report must not be lost: {done:#}");
    assert_eq!(done["metrics"], serde_json::to_value(fakes::metrics()).expect("JSON"));
    let artifact = &done["artifacts"][0];
    assert_eq!(done["artifacts"].as_array().map(Vec::len), Some(1), "the cameras are not for clients");
    assert_eq!(artifact["kind"], "tcgs");
    assert_eq!(artifact["bytes"], fakes::FILE.len());
    let file = server.get(artifact["href"].as_str().expect("a path")).await.expect(200);
    assert_eq!(file.body, fakes::FILE);

    let mut next = format!("{path}/events?limit=2");
    let mut events = Vec::new();
    loop {
        let page = server.get(&next).await.expect(200).json();
        let part = page["events"].as_array().expect("events").clone();
        if part.is_empty() {
            break;
        }
        assert!(part.len() <= 2);
        events.extend(part);
        next = page["next"].as_str().expect("a path").to_owned();
    }
    let numbers: Vec<u64> = events.iter().map(|event| event["seq"].as_u64().expect("a number")).collect();
    assert_eq!(numbers, (1..=events.len() as u64).collect::<Vec<_>>());
    let states: Vec<&Value> =
        events.iter().filter(|event| event["kind"] == "state").map(|event| &event["data"]["state"]).collect();
    assert_eq!(states, ["queued", "running", "succeeded"]);
    assert!(events.iter().any(|event| event["data"]["phase"] == "publish"), "{events:#?}");

    let baseline = server.upload("?model=scaffold", "succeed baseline").await.expect(201);
    let path = baseline.header("location").to_owned();
    let artifact = server.reaches(&path, "succeeded").await["artifacts"][0].clone();
    assert_eq!(artifact["kind"], "safetensors");
    let file = server.get(artifact["href"].as_str().expect("a path")).await.expect(200);
    assert_eq!(file.header("content-type"), "application/octet-stream");
    assert!(file.header("content-disposition").ends_with(".safetensors\""), "{:?}", file.headers);
    server.get(&format!("{path}/view?frame=test/r_0")).await.expect(200);

    let failed = server.create("fail").await;
    let failed = server.reaches(&failed, "failed").await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:fake-fail");
    assert_eq!(failed["artifacts"], json!([]));
    let history = server.get(failed["links"]["events"].as_str().expect("a path")).await.expect(200).json();
    let last = history["events"].as_array().and_then(|events| events.last()).expect("an event").clone();
    assert_eq!(last["data"]["error"], failed["error"]);
}

async fn every_file_of_a_curve_is_served_by_its_weight(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let created = server.upload("?rd_curve=0.004,0.0005,1e-7", "succeed curve").await.expect(201);
    assert_eq!(created.json()["options"]["rd_curve"], json!([0.004, 0.0005, 1e-7]));
    let path = created.header("location").to_owned();
    let done = server.reaches(&path, "succeeded").await;
    let artifacts = done["artifacts"].as_array().expect("artifacts");
    let weights: Vec<&Value> = artifacts.iter().map(|artifact| &artifact["lambda"]).collect();
    assert_eq!(weights, [&json!(0.004), &json!(0.0005), &json!(1e-7)], "in the order asked for");
    for (place, artifact) in artifacts.iter().enumerate() {
        assert_eq!(artifact["kind"], "tcgs");
        let point = &done["metrics"]["rd_curve"][place];
        assert_eq!((&point["lambda"], &point["sha256"]), (&artifact["lambda"], &artifact["sha256"]));
        let file = server.get(artifact["href"].as_str().expect("a path")).await.expect(200);
        assert_eq!(file.body, fakes::curve_file(place));
        let lambda = artifact["lambda"].as_f64().expect("a number");
        let name = format!(".lambda-{lambda}.tcgs\"");
        assert!(file.header("content-disposition").ends_with(&name), "{:?}", file.headers);
    }
    let first = server.get(&format!("{path}/artifact")).await.expect(200);
    assert_eq!(first.body, fakes::FILE, "the first is what is meant where none is named");
    let same = server.get(&format!("{path}/artifact?lambda=5e-4")).await.expect(200);
    assert_eq!(same.body, fakes::curve_file(1), "a weight is a number, not a text");

    let view = format!("{path}/view?frame=test/r_0");
    let [first, second] = ["", "&lambda=0.0005"].map(|choice| format!("{view}{choice}"));
    let (first, second) = (server.get(&first).await.expect(200), server.get(&second).await.expect(200));
    assert_ne!(first.body, second.body, "views are of the file that was chosen");
    let views = format!("{path}/views");
    let body = json!({ "views": [{ "frame": "test/r_0" }], "lambda": 0.0005 });
    let posted = server.send("POST", &views, |request| request.json(&body)).await.expect(200);
    assert_eq!(posted.body, second.body);

    for path in [format!("{path}/artifact?lambda=0.1"), format!("{view}&lambda=0.1")] {
        let detail = server.get(&path).await.expect_problem(404, "no-such-lambda");
        assert!(detail.contains("0.004, 0.0005, 0.0000001"), "{detail}");
    }
    let many = format!("{path}/artifact?lambda=many");
    server.get(&many).await.expect_problem(422, "invalid-parameter");
    server.get(&format!("{path}/artifact?size=1")).await.expect_problem(422, "invalid-parameter");
    let single = server.succeeded().await;
    let detail = server.get(&format!("{single}/artifact?lambda=0.1")).await;
    assert!(detail.expect_problem(404, "no-such-lambda").contains("leave out lambda"));
    assert_eq!(server.get(&single).await.json()["artifacts"][0]["lambda"], json!(null));
}

async fn the_file_is_served_whole_in_parts_and_conditionally(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/artifact");
    let whole = server.get(&path).await.expect(200);
    assert_eq!(whole.body, fakes::FILE);
    assert_eq!(whole.header("content-length"), fakes::FILE.len().to_string());
    let etag = whole.header("etag").to_owned();
    let with = |name: &'static str, value: String| {
        let (server, path) = (&server, &path);
        async move { server.send("GET", path, |request| request.header(name, value)).await }
    };

    let head = server.send("HEAD", &path, |request| request).await.expect(200);
    assert!(head.body.is_empty());
    assert_eq!(head.header("content-length"), whole.header("content-length"));
    assert_eq!(head.header("repr-digest"), whole.header("repr-digest"));

    let part = with("range", "bytes=5-9".into()).await.expect(206);
    assert_eq!(part.body, fakes::FILE[5..10]);
    assert_eq!(part.header("content-range"), format!("bytes 5-9/{}", fakes::FILE.len()));
    assert_eq!(part.header("repr-digest"), whole.header("repr-digest"), "it covers the whole file");
    let tail = with("range", "bytes=-4".into()).await.expect(206);
    assert_eq!(tail.body, fakes::FILE[fakes::FILE.len() - 4..]);
    let beyond = with("range", "bytes=1000000-".into()).await.expect(416);
    assert_eq!(beyond.header("content-range"), format!("bytes */{}", fakes::FILE.len()));
    assert_eq!(with("range", "bytes=0-1,4-5".into()).await.expect(200).body, fakes::FILE);

    let same = with("if-none-match", etag.clone()).await.expect(304);
    assert_eq!(same.header("etag"), etag);
    with("if-none-match", "\"other\"".into()).await.expect(200);
    let stale = server
        .send("GET", &path, |request| request.header("range", "bytes=0-1").header("if-range", "\"other\""))
        .await;
    assert_eq!(stale.expect(200).body, fakes::FILE, "a part of another file is of no use");

    let resource = server.get(&job).await.expect(200);
    assert!(!resource.headers.contains_key("retry-after"), "nothing will change any more");
    let etag = resource.header("etag").to_owned();
    server.send("GET", &job, |request| request.header("if-none-match", etag)).await.expect(304);
}

async fn what_is_wrong_with_a_dataset_or_an_option_is_said_before_a_job_is_made(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let bad = server.upload("", "bad zip").await.expect(422).json();
    assert_eq!(bad["file"], "transforms.json");
    assert!(bad["detail"].as_str().expect("a detail").contains("focal length"));

    for (query, named) in [
        ("?preset=fast", "preset"),
        ("?iterations=0", "iterations"),
        ("?iterations=many", "iterations"),
        ("?colour=red", "colour"),
        ("?model=nerf", "model"),
        ("?max_bytes=0", "max_bytes"),
        ("?max_bytes=1000&model=scaffold", "max_bytes"),
        ("?max_bytes=1000&rd_curve=0.001", "max_bytes"),
        ("?rd_curve=", "rd_curve"),
        ("?rd_curve=0.001,0.001", "rd_curve"),
        ("?rd_curve=0.001,-1", "rd_curve"),
        ("?rd_curve=1,2,3,4,5,6,7,8,9", "rd_curve"),
        ("?rd_curve=0.001&model=3dgs", "rd_curve"),
        ("?rd_curve=0.001&lambda=0.1", "rd_curve"),
    ] {
        let detail = server.upload(query, "succeed").await.expect_problem(422, "invalid-option");
        assert!(detail.contains(named), "{query}: {detail}");
    }
    let twice = server.upload("?seed=1&seed=2", "succeed").await.expect_problem(422, "invalid-parameter");
    assert!(twice.contains("seed"), "{twice}");

    for content_type in ["application/json", "text/plain"] {
        let wrong = server
            .send("POST", "/v1/jobs", |request| request.header("content-type", content_type).body("{}"));
        let detail = wrong.await.expect_problem(415, "unsupported-media-type");
        assert!(detail.contains("application/zip"), "{detail}");
    }
    server.post("/v1/jobs").await.expect_problem(415, "unsupported-media-type");
    assert_eq!(server.get("/v1/jobs").await.expect(200).json()["jobs"], json!([]), "none of these is a job");

    let tight = Setup { limits: tight_limits(), ..Setup::default() };
    let server = Server::start_with(&coverage, tight).await;
    let announced = server.upload("", "succeed but too long").await;
    assert!(announced.expect_problem(413, "body-too-large").contains("10 bytes"));
    let streamed = server.send("POST", "/v1/jobs", |request| {
        let pieces = ["succeed ", "but too ", "long"].map(Ok::<_, std::io::Error>);
        let body = reqwest::Body::wrap_stream(futures_util::stream::iter(pieces));
        request.header("content-type", "application/zip").body(body)
    });
    assert!(streamed.await.expect_problem(413, "body-too-large").contains("10 bytes"));
    server.upload("", "succeed ok").await.expect(201);
}

fn tight_limits() -> tcgs::http::config::RequestLimits {
    tcgs::http::config::RequestLimits {
        upload_bytes: 10,
        json_bytes: 100,
        body_idle: Duration::from_millis(50),
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
fn check_raw(server: &Server, method: &str, path: &str, answer: &[u8]) -> u16 {
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

async fn bodies_that_break_off_or_dawdle_are_given_up(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { limits: tight_limits(), ..Setup::default() }).await;
    let job = server.create("succeed").await;
    server.reaches(&job, "succeeded").await;
    for (path, media_type) in
        [("/v1/jobs".to_owned(), "application/zip"), (format!("{job}/views"), "application/json")]
    {
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: test\r\nContent-Type: {media_type}\r\nConnection: close\r\n"
        );
        let slow = raw(&server, &format!("{head}Content-Length: 9\r\n\r\n{{\"v"), false).await;
        assert_eq!(check_raw(&server, "POST", &path, &slow), 408);
        let broken =
            raw(&server, &format!("{head}Transfer-Encoding: chunked\r\n\r\nnot a length\r\n"), false).await;
        assert_eq!(check_raw(&server, "POST", &path, &broken), 400);
    }
    let views = format!("{job}/views");
    let long = json!({ "views": vec![json!({ "frame": "test/r_0" }); 50] });
    server.post_json(&views, &long).await.expect_problem(413, "body-too-large");
    server.upload("", "succeed").await.expect(201);
}

async fn unknown_jobs_frames_paths_and_methods_are_problems(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let done = server.succeeded().await;
    let absent = "/v1/jobs/0190a5d8-0000-7000-8000-000000000000";
    for job in [absent, "/v1/jobs/17", "/v1/jobs/..%2F..%2Fetc%2Fpasswd", "/v1/jobs/%00"] {
        server.get(job).await.expect_problem(404, "job-not-found");
        server.post(&format!("{job}/cancel")).await.expect_problem(404, "job-not-found");
        for part in ["events", "artifact", "view?frame=test/r_0"] {
            server.get(&format!("{job}/{part}")).await.expect_problem(404, "job-not-found");
        }
        let views = json!({ "views": [{ "frame": "test/r_0" }] });
        server.post_json(&format!("{job}/views"), &views).await.expect_problem(404, "job-not-found");
    }
    for frame in ["test/r_9", "", "..", &"x".repeat(3000)] {
        let detail =
            server.get(&format!("{done}/view?frame={frame}")).await.expect_problem(404, "frame-not-found");
        assert!(detail.contains("3 frames") && detail.len() < 500, "{detail}");
    }
    for path in ["/", "/v2/jobs", "/v1", "/v1/jobs/", "/v1/jobs/a/b/c"] {
        server.get(path).await.expect_problem(404, "not-found");
    }
    for (method, path, allow) in [
        ("DELETE", "/v1/jobs", "GET,HEAD,POST"),
        ("PUT", &done, "GET,HEAD"),
        ("GET", &format!("{done}/cancel"), "POST"),
    ] {
        let answer = server.send(method, path, |request| request).await.expect(405);
        assert_eq!(answer.header("allow"), allow);
    }
    let events = format!("{done}/events");
    let stream = server.send("GET", &events, |request| request.header("accept", "text/event-stream"));
    stream.await.expect_problem(406, "not-acceptable");
    for (query, named) in
        [("?after=x", "after"), ("?limit=0", "limit"), ("?limit=1001", "limit"), ("?since=1", "since")]
    {
        let detail =
            server.get(&format!("{done}/events{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

async fn jobs_are_listed_newest_first_page_by_page(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let mut made = Vec::new();
    for index in 0..5 {
        made.push(server.create(&format!("succeed {index}")).await);
    }
    made.reverse();
    let mut next = Some("/v1/jobs?limit=2".to_owned());
    let (mut listed, mut pages) = (Vec::new(), 0);
    while let Some(path) = next {
        let page = server.get(&path).await.expect(200).json();
        listed.extend(page["jobs"].as_array().expect("jobs").iter().map(|job| job["links"]["self"].clone()));
        next = page["next"].as_str().map(str::to_owned);
        pages += 1;
    }
    assert_eq!((listed, pages), (made.into_iter().map(Value::from).collect(), 3));
    for (query, named) in [
        ("?limit=0", "limit"),
        ("?limit=101", "limit"),
        ("?cursor=abc", "cursor"),
        ("?cursor=9223372036854775807.x", "cursor"),
        ("?page=2", "page"),
    ] {
        let detail = server.get(&format!("/v1/jobs{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }
}

async fn a_queued_job_is_cancelled_at_once_and_a_running_one_soon(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let queued = server.create("succeed").await;
    let cancelled = server.post(&format!("{queued}/cancel")).await.expect(200).json();
    assert_eq!((&cancelled["state"], &cancelled["attempt"]), (&json!("cancelled"), &json!(0)));
    let asked = server.post(&format!("{running}/cancel")).await.expect(202).json();
    assert_eq!(asked["cancel_requested"], true);
    server.reaches(&running, "cancelled").await;
    for job in [&queued, &running] {
        server.post(&format!("{job}/cancel")).await.expect(200);
    }
    let done = server.succeeded().await;
    let late = server.post(&format!("{done}/cancel")).await.expect_problem(409, "job-finished");
    assert!(late.contains("succeeded"), "{late}");
}

async fn views_by_frame_pose_and_query_agree(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let views = format!("{job}/views");
    let view = |query: &str| {
        let path = format!("{job}/view?{query}");
        let server = &server;
        async move { server.get(&path).await.expect(200).body }
    };
    let by_frame = view("frame=test/r_0").await;
    assert_eq!(view("frame=test/r_0.png").await, by_frame);
    assert_ne!(view("frame=train/r_0").await, by_frame);
    assert_eq!(view("frame=r_1").await, view("frame=test/r_1").await, "a stem that only one frame has");

    let camera = &fakes::cameras()[1].camera;
    for convention in [tcgs::domain::Convention::Opencv, tcgs::domain::Convention::Opengl] {
        let matrix = camera.pose.camera_to_world(convention);
        let rows: Vec<[f64; 4]> = (0..4).map(|row| matrix.row(row).to_array()).collect();
        let k = camera.intrinsics;
        let body = json!({ "views": [{
            "camera_to_world": rows, "convention": convention, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
            "width": k.width, "height": k.height,
        }]});
        let by_pose = server.post_json(&views, &body).await.expect(200);
        assert_eq!(by_pose.header("content-type"), "image/png");
        assert_eq!(by_pose.body, by_frame, "{convention:?}");
    }
    let named = json!({ "views": [{ "frame": "test/r_0" }] });
    assert_eq!(server.post_json(&views, &named).await.expect(200).body, by_frame);

    let size = |picture: &[u8]| {
        let picture = picture_of(picture);
        (picture.width(), picture.height())
    };
    assert_eq!(size(&by_frame), (40, 32));
    assert_eq!(size(&view("frame=test/r_0&width=20").await), (20, 16));

    // The worked example of the contract.
    let by_query = view("position=4,0,0&look_at=0,0,0&up=0,0,1&fov=60&width=640&height=480").await;
    assert_eq!(view("position=4,0,0&look_at=0,0,0").await, by_query, "the documented defaults");
    let contract =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml")).expect("readable");
    let examples: Vec<Value> = contract
        .match_indices("{\"views\": [{\"camera_to_world\"")
        .map(|(start, _)| {
            let text = &contract[start..start + contract[start..].find("]}").expect("an end") + 2];
            serde_json::from_str(text).expect("the example is JSON")
        })
        .collect();
    assert_eq!(examples.len(), 2, "one example for each convention");
    for example in examples {
        assert_eq!(server.post_json(&views, &example).await.expect(200).body, by_query, "{example}");
    }
}

async fn views_come_in_three_formats_and_as_multipart(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for format in ["png", "jpeg", "webp"] {
        let one = server.get(&format!("{job}/view?frame=test/r_0&format={format}")).await.expect(200);
        assert_eq!(one.header("content-type"), format!("image/{format}"));
        picture_of(&one.body);
        let body = json!({ "views": [{ "frame": "test/r_0" }], "format": format });
        let posted = server.post_json(&format!("{job}/views"), &body).await.expect(200);
        assert_eq!(posted.body, one.body);
    }
    let body =
        json!({ "views": [{ "frame": "test/r_0" }, { "frame": "train/r_0", "width": 20 }], "format": "png" });
    let many = server.post_json(&format!("{job}/views"), &body).await.expect(200);
    let boundary =
        many.header("content-type").strip_prefix("multipart/mixed; boundary=").expect("multipart").to_owned();
    let mut rest: &[u8] = &many.body;
    let mut sizes = Vec::new();
    while let Some(head_end) = rest.windows(4).position(|window| window == b"\r\n\r\n") {
        let head = std::str::from_utf8(&rest[..head_end]).expect("ASCII");
        assert!(head.starts_with(&format!("--{boundary}\r\nContent-Type: image/png\r\n")), "{head}");
        let length = head.lines().find_map(|line| line.strip_prefix("Content-Length: ")).expect("a length");
        let length: usize = length.parse().expect("a number");
        let picture = picture_of(&rest[head_end + 4..head_end + 4 + length]);
        sizes.push((picture.width(), picture.height()));
        rest = &rest[head_end + 4 + length + 2..];
    }
    assert_eq!(sizes, [(40, 32), (20, 16)]);
    assert_eq!(rest, format!("--{boundary}--\r\n").as_bytes());
}

async fn impossible_views_are_refused_by_name(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for (query, kind, named) in [
        ("", "invalid-parameter", "position"),
        ("position=1,2,3", "invalid-parameter", "look_at"),
        ("position=1,2&look_at=0,0,0", "invalid-parameter", "position"),
        ("position=1,2,3,4&look_at=0,0,0", "invalid-parameter", "position"),
        ("position=nan,0,0&look_at=0,0,0", "invalid-parameter", "position"),
        ("position=1,0,0&look_at=1,0,inf", "invalid-parameter", "look_at"),
        ("position=1,0,0&look_at=1,0,0", "impossible-view", "look_at equals position"),
        ("position=0,0,5&look_at=0,0,0", "impossible-view", "up"),
        ("position=1,0,0&look_at=0,0,0&fov=180", "invalid-parameter", "fov"),
        ("position=1,0,0&look_at=0,0,0&fov=-5", "invalid-parameter", "fov"),
        ("position=1,0,0&look_at=0,0,0&fov=nan", "invalid-parameter", "fov"),
        ("position=1,0,0&look_at=0,0,0&fov=wide", "invalid-parameter", "fov"),
        ("position=1,0,0&look_at=0,0,0&width=0", "invalid-parameter", "width"),
        ("position=1,0,0&look_at=0,0,0&width=-1", "invalid-parameter", "width"),
        ("position=1,0,0&look_at=0,0,0&width=4097", "view-too-large", "4096"),
        ("position=1,0,0&look_at=0,0,0&width=99999999999", "invalid-parameter", "width"),
        ("frame=test/r_0&fov=60", "invalid-parameter", "fov"),
        ("frame=test/r_0&format=gif", "invalid-parameter", "format"),
        ("frame=test/r_0&zoom=2", "invalid-parameter", "zoom"),
        ("frame=test/r_0&width=1000000", "impossible-view", "1000000"),
    ] {
        let detail = server.get(&format!("{job}/view?{query}")).await.expect_problem(422, kind);
        assert!(detail.contains(named), "{query}: {detail}");
    }
    let pose = |change: &dyn Fn(&mut Value)| {
        let mut view = json!({
            "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "fx": 50, "width": 40, "height": 30,
        });
        change(&mut view);
        json!({ "views": [view] })
    };
    let views = format!("{job}/views");
    server.post_json(&views, &pose(&|_| {})).await.expect(200);
    type Change = dyn Fn(&mut Value);
    let faults: [(&Change, &str); 10] = [
        (&|view| view["camera_to_world"][0][0] = json!(2), "rigid"),
        (&|view| view["camera_to_world"][0][0] = json!(-1), "rigid"),
        (&|view| view["camera_to_world"][3][0] = json!(1), "last row"),
        (&|view| view["fx"] = json!(0), "focal length"),
        (&|view| view["fy"] = json!(-1), "focal length"),
        (&|view| view["width"] = json!(5000), "4096"),
        (&|view| view["convention"] = json!("colmap"), "convention"),
        (&|view| view["roll"] = json!(1), "roll"),
        (&|view| view["frame"] = json!("test/r_0"), "frame"),
        (&|view| drop(view.as_object_mut().expect("an object").remove("fx")), "fx"),
    ];
    for (change, named) in faults {
        let answer = server.post_json(&views, &pose(change)).await.expect(422).json();
        let detail = answer["detail"].as_str().expect("a detail");
        assert!(
            detail.contains(named) || (named == "convention" && detail.contains("colmap")),
            "{named}: {detail}"
        );
    }
    let large = json!({ "frame": "test/r_0", "width": 4096, "height": 4096 });
    for views_asked in [json!([]), json!(vec![json!({ "frame": "test/r_0" }); 65]), json!([large, large])] {
        server.post_json(&views, &json!({ "views": views_asked })).await.expect(422);
    }
    let broken = server
        .send("POST", &views, |request| request.header("content-type", "application/json").body("{\"v"));
    broken.await.expect_problem(400, "malformed-json");
    let untyped = server.send("POST", &views, |request| request.body("{}"));
    untyped.await.expect_problem(415, "unsupported-media-type");
}

async fn a_job_without_a_file_has_no_views(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let queued = server.get(&job).await.expect(200);
    assert!(queued.headers.contains_key("retry-after"), "a poller is told when to ask again");
    for part in ["artifact", "view?frame=test/r_0"] {
        let detail = server.get(&format!("{job}/{part}")).await.expect_problem(409, "no-artifact");
        assert!(detail.contains("queued"), "{detail}");
    }
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    server.post_json(&format!("{job}/views"), &views).await.expect_problem(409, "no-artifact");
}

async fn a_full_render_queue_and_a_broken_renderer_are_told_apart(coverage: Coverage) {
    let limits = tcgs::http::config::RequestLimits { renders: 1, renders_waiting: 0, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let pose = "position=1,0,0&look_at=0,0,0&height=16";
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    let slow = format!("{job}/view?{pose}&width=17");
    let (waiting, full) = tokio::join!(server.get(&slow), async {
        server.renderer.gate.someone_waits().await;
        let full = [
            server.get(&format!("{job}/view?frame=test/r_0")).await,
            server.post_json(&format!("{job}/views"), &views).await,
        ];
        server.renderer.gate.open();
        full
    });
    waiting.expect(200);
    for answer in full {
        answer.expect_problem(503, "busy");
    }
    server.get(&format!("{job}/view?{pose}&width=13")).await.expect_problem(500, "internal");
    server.get(&format!("{job}/view?{pose}&width=14")).await.expect_problem(500, "device-lost");
    server.get(&format!("{job}/view?{pose}&width=15")).await.expect_problem(507, "gpu-memory");
    let large = json!({ "views": [{ "frame": "test/r_0", "width": 15 }] });
    server.post_json(&format!("{job}/views"), &large).await.expect_problem(507, "gpu-memory");
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
}

async fn too_many_uploads_at_once_are_put_off(coverage: Coverage) {
    let limits = tcgs::http::config::RequestLimits { uploads: 0, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    server.upload("", "succeed").await.expect_problem(503, "busy");
}

async fn a_database_that_fails_is_a_problem_not_a_crash(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    for (failing, status, kind) in [(Failing::Busy, 503, "busy"), (Failing::Gone, 500, "internal")] {
        server.store.set(Some(failing));
        let answers: Vec<Answer> = vec![
            server.upload("", "succeed").await,
            server.get("/v1/jobs").await,
            server.get(&job).await,
            server.post(&format!("{job}/cancel")).await,
            server.get(&format!("{job}/events")).await,
            server.get(&format!("{job}/artifact")).await,
            server.get(&format!("{job}/view?frame=test/r_0")).await,
            server.post_json(&format!("{job}/views"), &views).await,
        ];
        for answer in answers {
            let detail = answer.expect_problem(status, kind);
            assert!(!detail.to_lowercase().contains("pool"), "what is inside stays inside: {detail}");
        }
        server.get("/readyz").await.expect_problem(503, "not-ready");
        server.get("/healthz").await.expect(200);
        server.store.set(None);
        server.get("/readyz").await.expect(200);
    }
}

async fn a_handler_that_panics_answers_500_and_the_server_lives(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    server.upload("", "bomb").await.expect_problem(500, "internal");
    server.succeeded().await;
}

#[tokio::test]
async fn request_ids_are_kept_if_fit_and_made_if_not() {
    let server = Server::start(&Coverage::default()).await;
    let given =
        server.send("GET", "/v1/jobs/17", |request| request.header("x-request-id", "my-id_1.2")).await;
    assert_eq!(given.header("x-request-id"), "my-id_1.2");
    assert_eq!(given.json()["instance"], "my-id_1.2");
    for unfit in ["", "two words", "<script>", &"x".repeat(129)] {
        let answer = server.send("GET", "/healthz", |request| request.header("x-request-id", unfit)).await;
        assert_eq!(answer.header("x-request-id").len(), 36, "a fresh UUID instead of '{unfit}'");
    }
}

#[tokio::test]
async fn a_connection_that_dawdles_over_its_headers_is_closed() {
    let setup = Setup { header_timeout: Duration::from_millis(50), ..Setup::default() };
    let server = Server::start_with(&Coverage::default(), setup).await;
    let answer = raw(&server, "GET /healthz HTTP/1.1\r\nHost: te", false).await;
    assert!(!String::from_utf8_lossy(&answer).contains("200"), "the read ended because the server closed");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_early_refusal_reaches_a_client_that_sends_its_whole_body_first() {
    let server = Server::start(&Coverage::default()).await;
    let size = 32 << 20;
    for (query, status) in [("?preset=fast", 422), ("", 413)] {
        let mut stream = TcpStream::connect(server.address).await.expect("connects");
        let head = format!(
            "POST /v1/jobs{query} HTTP/1.1\r\nHost: test\r\nContent-Type: application/zip\r\n\
             Connection: close\r\nContent-Length: {size}\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).await.expect("sent");
        stream.write_all(&vec![b'x'; size]).await.expect("the server takes the whole body");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.expect("an end");
        assert_eq!(check_raw(&server, "POST", "/v1/jobs", &answer), status);
    }
}

#[tokio::test]
async fn a_client_that_waits_for_leave_to_send_is_refused_without_it() {
    let server = Server::start(&Coverage::default()).await;
    let request = "POST /v1/jobs?preset=fast HTTP/1.1\r\nHost: test\r\nContent-Type: application/zip\r\n\
                   Expect: 100-continue\r\nContent-Length: 1000\r\nConnection: close\r\n\r\n";
    let answer = raw(&server, request, false).await;
    assert_eq!(check_raw(&server, "POST", "/v1/jobs", &answer), 422, "and not 100");
}

#[tokio::test]
async fn connections_beyond_the_cap_wait_for_a_place() {
    let server =
        Server::start_with(&Coverage::default(), Setup { max_connections: 1, ..Setup::default() }).await;
    let mut first = TcpStream::connect(server.address).await.expect("connects");
    first.write_all(b"GET /healthz HTTP/1.1\r\nHost: te").await.expect("sent");
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
        while TcpStream::connect(server.address).await.is_ok() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        server.renderer.gate.open();
    });
    open.expect(200);
    (&mut server.serving).await.expect("the accept loop ends");
}

#[tokio::test]
async fn a_server_that_drains_is_not_ready() {
    let server = Server::start(&Coverage::default()).await;
    let draining = tokio_util::sync::CancellationToken::new();
    draining.cancel();
    let state = tcgs::http::AppState::new(server.services.clone(), Default::default(), draining);
    let request = axum::http::Request::get("/readyz").body(axum::body::Body::empty()).expect("a request");
    let answer = tcgs::http::router(state).oneshot(request).await.expect("an answer");
    assert_eq!(answer.status(), 503);
}
