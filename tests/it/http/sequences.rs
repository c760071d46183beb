//! Sequences of pictures: streams, animations, large batches, and their fairness to other requests.

use std::time::Duration;

use image::AnimationDecoder as _;
use serde_json::{Value, json};
use tcgs::{
    domain::{Convention, Orbit, Scope},
    http::config::RequestLimits,
};

use crate::support::{
    contract::Coverage,
    eventually::{eventually, within},
    fakes,
    server::{Server, Setup, picture as picture_of},
};

/// The parts of a multipart body: head and content.
pub(super) fn parts(body: &[u8], content_type: &str) -> Vec<(String, Vec<u8>)> {
    let boundary = content_type.split("boundary=").nth(1).expect("a boundary");
    let mut rest = body.strip_prefix(format!("--{boundary}\r\n").as_bytes()).expect("a first delimiter");
    let mut parts = Vec::new();
    while let Some(head_end) = rest.windows(4).position(|window| window == b"\r\n\r\n") {
        let head = std::str::from_utf8(&rest[..head_end]).expect("ASCII").to_owned();
        let length = head.lines().find_map(|line| line.strip_prefix("Content-Length: ")).expect("a length");
        let (content, after) = rest[head_end + 4..].split_at(length.parse().expect("a number"));
        parts.push((head, content.to_owned()));
        let delimiter = format!("\r\n--{boundary}");
        rest = after.strip_prefix(delimiter.as_bytes()).expect("a delimiter");
        if rest == b"--\r\n" {
            return parts;
        }
        rest = rest.strip_prefix(b"\r\n").expect("another part");
    }
    panic!("the body does not end");
}

/// Two views of one size.
fn path() -> Value {
    json!([{ "frame": "train/r_0" }, { "frame": "test/r_0" }])
}

pub(super) async fn an_orbit_is_streamed_part_by_part_as_often_as_asked(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let stream = server.get(&format!("{job}/stream?orbit=2&frames=3&fps=60&width=20")).await.expect(200);
    assert!(stream.header("content-type").starts_with("multipart/x-mixed-replace; boundary="));
    assert!(!stream.headers.contains_key("content-disposition"));
    let shown = parts(&stream.body, stream.header("content-type"));
    assert_eq!(shown.len(), 6);
    for (head, content) in &shown {
        assert!(head.starts_with("Content-Type: image/jpeg\r\n") && !head.contains("Disposition"), "{head}");
        let shown = picture_of(content);
        assert_eq!((shown.width(), shown.height()), (20, 16), "as the first training camera sees");
    }
    let contents: Vec<_> = shown.iter().map(|(_, content)| content).collect();
    assert_eq!(contents[..3], contents[3..], "the second turn is the first again");
    assert_eq!(server.renderer.painted(), 3, "and comes from the cache");
    assert!(contents[0] != contents[1] && contents[1] != contents[2] && contents[0] != contents[2]);

    let one = |query: &str| {
        let path = format!("{job}/stream?frames=1&{query}");
        let server = &server;
        async move {
            let stream = server.get(&path).await.expect(200);
            parts(&stream.body, stream.header("content-type")).remove(0)
        }
    };
    let usual = one("").await;
    for other in ["radius=2", "elevation=10", "elevation=-10", "height=16", "quality=30", "format=png"] {
        assert_ne!(one(other).await.1, usual.1, "{other}");
    }
    let (head, depth) = one("output=depth").await;
    assert!(head.contains("Content-Type: image/png\r\n") && head.contains("X-Depth-Scale: 0.000"), "{head}");
    assert!(matches!(picture_of(&depth), image::DynamicImage::ImageLuma16(_)));
}

/// The cameras of the dataset look past the middle of their pictures.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_orbit_has_what_it_goes_around_in_the_middle_of_each_picture() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let stream = server.get(&format!("{job}/stream?frames=1&format=png")).await.expect(200);
    let shown = parts(&stream.body, stream.header("content-type")).remove(0).1;
    let camera = fakes::cameras()[0].camera;
    let pose = Orbit::around(&[camera]).expect("an orbit").pose(0.0).expect("a view");
    let matrix = pose.camera_to_world(Convention::Opencv);
    let rows: Vec<[f64; 4]> = (0..4).map(|row| matrix.row(row).to_array()).collect();
    let view = json!({ "camera_to_world": rows, "convention": "opencv", "fx": 50, "fy": 55, "width": 40, "height": 32 });
    let centered = |cx: f64, cy: f64| {
        let mut view = view.clone();
        (view["cx"], view["cy"]) = (json!(cx), json!(cy));
        json!({ "views": [view] })
    };
    let view = server.post_json(&format!("{job}/views"), &centered(20.0, 16.0)).await.expect(200);
    assert_eq!(view.body, shown);
    let view = server.post_json(&format!("{job}/views"), &centered(21.0, 15.5)).await.expect(200);
    assert_ne!(view.body, shown);
}

pub(super) async fn a_path_is_animated_through_its_views(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let body = json!({ "path": path(), "frames": 4, "fps": 5, "closed": true });
    let file = server.post_json(&format!("{job}/animation"), &body).await.expect(200);
    assert_eq!(file.header("content-type"), "image/apng");
    let frames = frames_of(&file.body);
    assert_eq!(frames.len(), 4);
    for (index, frame) in [(0, "train/r_0"), (2, "test/r_0")] {
        let key = server.get(&format!("{job}/view?frame={frame}")).await.expect(200);
        assert_eq!(*frames[index].buffer(), picture_of(&key.body).to_rgba8(), "{frame}");
        assert_eq!(frames[index].delay().numer_denom_ms(), (200, 1));
    }
    let between = frames[1].buffer();
    assert!(between != frames[0].buffer() && between != frames[2].buffer());
    assert_eq!(between, frames[3].buffer(), "the way back is the way there");
}

fn frames_of(file: &[u8]) -> Vec<image::Frame> {
    let decoder = image::codecs::png::PngDecoder::new(std::io::Cursor::new(file)).expect("a PNG");
    let frames = decoder.apng().expect("animated").into_frames();
    frames.collect_frames().expect("frames")
}

pub(super) async fn an_animation_is_written_as_webp_too(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let frames_of_webp = |file: &[u8]| {
        let decoder = image::codecs::webp::WebPDecoder::new(std::io::Cursor::new(file)).expect("a WebP");
        decoder.into_frames().collect_frames().expect("frames")
    };
    let path = format!("{job}/animation?frames=5&width=24&fps=10");
    let [apng, webp] = [server.get(&path).await, server.get(&format!("{path}&format=webp")).await];
    let (apng, webp) = (apng.expect(200), webp.expect(200));
    assert_eq!(webp.header("content-type"), "image/webp");
    assert_eq!(webp.header("content-length"), webp.body.len().to_string());
    assert_ne!(webp.header("etag"), apng.header("etag"));
    let [plain, same] = [frames_of(&apng.body), frames_of_webp(&webp.body)];
    assert_eq!(same.len(), 5);
    for (plain, same) in plain.iter().zip(&same) {
        assert_eq!((same.buffer(), same.delay()), (plain.buffer(), plain.delay()));
    }
    let etag = webp.header("etag");
    let webp_path = format!("{path}&format=webp");
    let held = server.send("GET", &webp_path, |request| request.header("if-none-match", etag));
    held.await.expect(304);
    let body = json!({ "path": self::path(), "frames": 3, "format": "webp" });
    let along = server.post_json(&format!("{job}/animation"), &body).await.expect(200);
    assert_eq!((along.header("content-type"), frames_of_webp(&along.body).len()), ("image/webp", 3));
    // With a quality it is smaller, and near what it shows without.
    let lossy = server.get(&format!("{webp_path}&quality=50")).await.expect(200);
    assert!(lossy.body.len() < webp.body.len() && lossy.header("etag") != etag);
    let near = frames_of_webp(&lossy.body);
    assert_eq!(near.len(), 5);
    for (exact, near) in same.iter().zip(&near) {
        // These pictures are of a few pixels without neighbors of their color, so means are compared.
        let mean = |frame: &image::Frame| {
            let samples = frame.buffer().as_raw();
            samples.iter().map(|sample| u64::from(*sample)).sum::<u64>() / samples.len() as u64
        };
        assert!(mean(exact).abs_diff(mean(near)) <= 10, "{} {}", mean(exact), mean(near));
    }
    let body = json!({ "path": self::path(), "frames": 3, "format": "webp", "quality": 50 });
    let along = server.post_json(&format!("{job}/animation"), &body).await.expect(200);
    assert_eq!(frames_of_webp(&along.body).len(), 3);
    for wrong in ["quality=50", "format=webp&quality=0"] {
        let detail = server.get(&format!("{path}&{wrong}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with("quality"), "{detail}");
    }
    let detail = server.get(&format!("{path}&format=gif")).await.expect_problem(422, "invalid-parameter");
    assert!(detail.starts_with("format"), "{detail}");
    let body = json!({ "path": self::path(), "format": "gif" });
    server.post_json(&format!("{job}/animation"), &body).await.expect_problem(422, "invalid-view");
}

pub(super) async fn an_orbit_is_one_file_with_a_tag(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/animation?frames=5&width=24&fps=10");
    let file = server.get(&path).await.expect(200);
    let frames = frames_of(&file.body);
    assert_eq!(frames.len(), 5);
    assert_eq!(frames[0].buffer().width(), 24);
    let painted = server.renderer.painted();
    let etag = file.header("etag").to_owned();
    let again = server.send("GET", &path, |request| request.header("if-none-match", &etag)).await;
    assert_eq!(again.expect(304).header("etag"), etag);
    assert_eq!(server.renderer.painted(), painted, "nothing is rendered for that");
    let slower = server.get(&format!("{path}0")).await;
    slower.expect_problem(422, "invalid-parameter");
    let slower = server.get(&format!("{job}/animation?frames=5&width=24&fps=9")).await.expect(200);
    assert_ne!(slower.header("etag"), etag);
}

pub(super) async fn impossible_sequences_are_refused_by_name(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for (query, kind, named) in [
        ("frames=0", "invalid-parameter", "frames"),
        ("frames=721", "invalid-parameter", "frames"),
        ("fps=0", "invalid-parameter", "fps"),
        ("fps=61", "invalid-parameter", "fps"),
        ("radius=0", "invalid-parameter", "radius"),
        ("radius=nan", "invalid-parameter", "radius"),
        ("elevation=90", "invalid-parameter", "elevation"),
        ("elevation=nan", "invalid-parameter", "elevation"),
        ("width=4097", "view-too-large", "4096"),
        ("frame=test/r_0", "invalid-parameter", "frame"),
    ] {
        for sequence in ["stream", "animation"] {
            let answer = server.get(&format!("{job}/{sequence}?{query}")).await;
            let detail = answer.expect_problem(422, kind);
            assert!(detail.contains(named), "{query}: {detail}");
        }
    }
    for query in
        ["orbit=0", "orbit=1001", "format=npy", "quality=0", "format=png&quality=50", "output=normal"]
    {
        server.get(&format!("{job}/stream?{query}")).await.expect_problem(422, "invalid-parameter");
    }
    let large = server.get(&format!("{job}/animation?width=4096&height=4096&frames=5")).await;
    assert!(large.expect_problem(422, "view-too-large").contains("67108864"));

    let other_size = json!([{ "frame": "train/r_0" }, { "frame": "test/r_0", "width": 20 }]);
    let unknown = json!([{ "frame": "train/r_0" }, { "frame": "r_9" }]);
    let torn = json!([{ "frame": "train/r_0", "fx": 3 }]);
    for (body, status, named) in [
        (json!({ "path": other_size }), 422, "path[1]: is 20x16"),
        (json!({ "path": torn }), 422, "path[0]"),
        (json!({ "path": [] }), 422, "path: 0 views"),
        (json!({ "path": vec![json!({ "frame": "test/r_0" }); 65] }), 422, "path: 65 views"),
        (json!({ "path": path(), "frames": 721 }), 422, "frames: 721"),
        (json!({ "path": path(), "fps": 0 }), 422, "fps: 0"),
        (json!({ "path": path(), "speed": 1 }), 422, "speed"),
        (json!({}), 422, "path"),
        (json!({ "path": unknown }), 404, "r_9"),
    ] {
        let answer = server.post_json(&format!("{job}/animation"), &body).await.expect(status).json();
        let detail = answer["detail"].as_str().expect("a detail");
        assert!(detail.contains(named), "{body}: {detail}");
    }
    assert_eq!(server.renderer.painted(), 0, "every fault is found before anything is rendered");
}

pub(super) async fn sequences_fail_as_views_do(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let queued = server.create("succeed").await;
    let body = json!({ "path": path() });
    for (job, status, kind) in [
        (queued.as_str(), 409, "no-artifact"),
        ("/v1/jobs/0190a5d8-0000-7000-8000-000000000000", 404, "job-not-found"),
    ] {
        server.get(&format!("{job}/stream")).await.expect_problem(status, kind);
        let animation = format!("{job}/animation");
        server.get(&animation).await.expect_problem(status, kind);
        server.post_json(&animation, &body).await.expect_problem(status, kind);
    }
    let animation = format!("{queued}/animation");
    server.send("POST", &animation, |r| r.body("{}")).await.expect_problem(415, "unsupported-media-type");
    let broken =
        server.send("POST", &animation, |r| r.header("content-type", "application/json").body("{\"p"));
    broken.await.expect_problem(400, "malformed-json");
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for sequence in ["stream", "animation"] {
        let sequence = format!("{job}/{sequence}");
        for (width, status, kind) in
            [(13, 500, "internal"), (14, 503, "device-lost"), (15, 507, "gpu-memory")]
        {
            server.get(&format!("{sequence}?width={width}")).await.expect_problem(status, kind);
        }
    }
    for (width, status, kind) in [(13, 500, "internal"), (14, 503, "device-lost"), (15, 507, "gpu-memory")] {
        let path = json!({ "path": [{ "frame": "test/r_0", "width": width }] });
        server.post_json(&format!("{job}/animation"), &path).await.expect_problem(status, kind);
    }
}

pub(super) async fn what_fails_after_the_first_picture_breaks_the_body_off(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    // Of this height every picture but the first is lost.
    let view = |width: u32| json!({ "frame": "test/r_0", "width": width, "height": 18 });
    let views = json!({ "views": [view(30), view(31), view(32)] });
    let (status, body) = server.broken("POST", &format!("{job}/views"), |r| r.json(&views)).await;
    assert_eq!(status, 200);
    assert!(body.starts_with(b"--") && !body.ends_with(b"--\r\n"), "one part, and no end");
    let animation = format!("{job}/animation?width=40&height=18&frames=3");
    let (status, _) = server.broken("GET", &animation, |r| r).await;
    assert_eq!(status, 503, "the first picture of this one fails, before the response begins");
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
}

pub(super) async fn each_caller_has_its_share_and_all_together_a_limit(coverage: Coverage) {
    let limits =
        RequestLimits { renders: 1, renders_waiting: 1, renders_per_caller: 1, ..Default::default() };
    refused(&coverage, RequestLimits { streams_per_caller: 0, ..limits.clone() }, 429, "too-many-views")
        .await;
    let limits = RequestLimits { renders_waiting: 0, renders_per_caller: 9, streams: 0, ..limits };
    refused(&coverage, limits, 503, "busy").await;
}

/// While one picture is being made, everything else is refused, but what is at hand.
async fn refused(coverage: &Coverage, limits: RequestLimits, status: u16, kind: &str) {
    let server = Server::start_with(coverage, Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let known = format!("{job}/view?frame=train/r_0");
    let known_body = server.get(&known).await.expect(200).body;
    let slow = format!("{job}/view?frame=test/r_0&width=17");
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    let (made, answers) = tokio::join!(server.get(&slow), async {
        server.renderer.gate.someone_waits().await;
        let answers = vec![
            server.get(&format!("{job}/view?frame=test/r_0")).await,
            server.post_json(&format!("{job}/views"), &views).await,
            server.get(&format!("{job}/stream")).await,
            server.get(&format!("{job}/animation")).await,
            server.post_json(&format!("{job}/animation"), &json!({ "path": path() })).await,
        ];
        assert_eq!(server.get(&known).await.expect(200).body, known_body, "needs no place");
        server.renderer.gate.open();
        answers
    });
    made.expect(200);
    for answer in answers {
        let wait: u64 = answer.header("retry-after").parse().expect("seconds");
        assert!((1..=120).contains(&wait));
        answer.expect_problem(status, kind);
    }
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
}

/// Pictures ahead of whoever would come now, as advice to come back tells: half a second each while none was made.
async fn advice(server: &Server, job: &str) -> u64 {
    let refused = server.get(&format!("{job}/stream")).await.expect(503);
    refused.header("retry-after").parse().expect("seconds")
}

pub(super) async fn whoever_goes_away_is_not_rendered(coverage: Coverage) {
    let limits = RequestLimits { renders: 1, streams: 0, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let slow = format!("{job}/view?frame=test/r_0&width=17");
    let (made, ()) = tokio::join!(server.get(&slow), async {
        server.renderer.gate.someone_waits().await;
        assert_eq!(advice(&server, &job).await, 1);
        let views: Vec<Value> =
            (20..40).map(|width| json!({ "frame": "test/r_0", "width": width })).collect();
        let body = json!({ "views": views });
        let many = format!("{job}/views");
        let batch = server.post_json(&many, &body);
        tokio::select! {
            answer = batch => panic!("it cannot have a turn: {}", answer.status),
            () = eventually("the batch is in the line", async || advice(&server, &job).await >= 10) => {}
        }
        // The connection is closed now; when the server knows, nobody is ahead but the first.
        eventually("the batch has left the line", async || advice(&server, &job).await <= 1).await;
        server.renderer.gate.open();
    });
    made.expect(200);
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
    assert_eq!(server.renderer.painted(), 2);
}

pub(super) async fn nothing_is_rendered_that_the_client_does_not_take(coverage: Coverage) {
    let limits = RequestLimits { view_cache_bytes: 0, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    // A megabyte each, far more in all than sockets hold.
    let view = |fx: usize| {
        json!({
            "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "fx": 50 + fx, "width": 512, "height": 512,
        })
    };
    let views: Vec<Value> = (0..64).map(view).collect();
    let body = json!({ "views": views, "output": "depth", "format": "npy" });
    let mut open = server.open("POST", &format!("{job}/views"), |r| r.json(&body)).await;
    assert_eq!(open.status(), 200);
    open.chunk().await.expect("a body").expect("a first part");
    for width in 20..60 {
        server.get(&format!("{job}/view?frame=test/r_0&width={width}&height=16")).await.expect(200);
    }
    let painted = server.renderer.painted() - 40;
    assert!(painted < 48, "{painted} of 64 pictures for a client that takes one");
    drop(open);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_reads_steadily_gets_every_picture_however_long_one_takes() {
    let limits = RequestLimits { body_idle_timeout: Duration::from_millis(50), ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    // Eight megabytes each, which take half a second to read below and sockets hold one of.
    let view = |fx: usize| {
        json!({
            "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "fx": 50 + fx, "width": 1448, "height": 1448,
        })
    };
    let views: Vec<Value> = (0..4).map(view).collect();
    let body = json!({ "views": views, "output": "depth", "format": "npy" });
    let mut open = server.open("POST", &format!("{job}/views"), |r| r.json(&body)).await;
    assert_eq!(open.status(), 200);
    let content_type = open.headers()["content-type"].to_str().expect("ASCII").to_owned();
    let (mut taken, mut pause_at) = (Vec::new(), 1 << 20);
    while let Some(chunk) = open.chunk().await.expect("not broken off") {
        taken.extend_from_slice(&chunk);
        if taken.len() >= pause_at {
            pause_at = taken.len() + (1 << 20);
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
    assert_eq!(parts(&taken, &content_type).len(), 4);
}

pub(super) async fn sequences_are_rendered_while_a_job_trains(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let training = server.create("gate").await;
    server.reaches(&training, "running").await;
    let stream = server.get(&format!("{job}/stream?frames=4&fps=60")).await.expect(200);
    assert_eq!(parts(&stream.body, stream.header("content-type")).len(), 4);
    let file = server.get(&format!("{job}/animation?frames=3")).await.expect(200);
    assert_eq!(frames_of(&file.body).len(), 3);
    server.runner.gate.open();
    server.reaches(&training, "succeeded").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_ends_when_the_server_stops() {
    let mut server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut open = server.open("GET", &format!("{job}/stream?orbit=1000&frames=2&fps=60"), |r| r).await;
    open.chunk().await.expect("a body").expect("a first part");
    server.shutdown.cancel();
    let end = async { while open.chunk().await.expect("not broken off").is_some() {} };
    within("the stream's end", end).await;
    (&mut server.serving).await.expect("the accept loop ends");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_whose_client_has_gone_makes_room() {
    let limits = RequestLimits { streams: 1, ..Default::default() };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let endless = format!("{job}/stream?orbit=1000&frames=2&fps=60");
    let mut open = server.open("GET", &endless, |r| r).await;
    open.chunk().await.expect("a body").expect("a first part");
    server.get(&endless).await.expect_problem(503, "busy");
    drop(open);
    let is_free = async || server.get(&format!("{job}/stream?frames=1")).await.status != 503;
    eventually("there is room", is_free).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_of_views_ends_soon_after_its_key_is_revoked() {
    let limits = RequestLimits { key_recheck_interval: Duration::from_millis(5), ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let key = server.key(&[Scope::Admin]).await;
    let path = format!("{job}/stream?orbit=1000&frames=3&fps=1&width=20");
    let mut stream = server.open("GET", &path, |request| request.bearer_auth(&key.key)).await;
    stream.chunk().await.expect("a picture").expect("before the end");
    server.revoke(&key).await;
    // Fifty minutes of it are left.
    while let Ok(Some(_)) = stream.chunk().await {}
}
