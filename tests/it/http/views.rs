//! Views of a finished scene.

use serde_json::{Value, json};

use glam::{DQuat, DVec3};
use tcgs::{domain::Pose, http::config::RequestLimits};

use super::sequences::parts;
use crate::support::{
    contract::Coverage,
    eventually::eventually,
    fakes,
    server::{Answer, Server, Setup, picture as picture_of},
};

pub(super) async fn views_by_frame_pose_and_query_agree(coverage: Coverage) {
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
        .match_indices("{\"views\": [{\"")
        .map(|(start, _)| {
            let text = &contract[start..start + contract[start..].find("]}").expect("an end") + 2];
            serde_json::from_str(text).expect("the example is JSON")
        })
        .collect();
    assert_eq!(examples.len(), 3, "one by position, and one for each convention");
    for example in examples {
        assert_eq!(server.post_json(&views, &example).await.expect(200).body, by_query, "{example}");
    }
}

pub(super) async fn a_view_without_a_camera_is_that_of_the_first_held_out_one(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for (query, same) in [("", "?frame=test/r_0"), ("?width=20", "?frame=test/r_0&width=20")] {
        let [plain, named] = [query, same].map(|query| format!("{job}/view{query}"));
        assert_eq!(server.get(&plain).await.expect(200).body, server.get(&named).await.expect(200).body);
    }
    let small = picture_of(&server.get(&format!("{job}/view?width=20&format=jpeg")).await.expect(200).body);
    assert_eq!((small.width(), small.height()), (20, 16));
}

pub(super) async fn the_cameras_of_a_job_are_views_of_it(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/cameras");
    let listed = server.get(&path).await.expect(200);
    let etag = listed.header("etag").to_owned();
    let held = server.send("GET", &path, |request| request.header("if-none-match", &etag)).await.expect(304);
    assert_eq!(held.header("etag"), etag);
    let cameras = listed.json()["cameras"].as_array().expect("cameras").clone();
    assert_eq!(cameras.len(), fakes::cameras().len());
    for (shown, camera) in cameras.iter().zip(fakes::cameras()) {
        assert_eq!((&shown["name"], &shown["split"]), (&json!(camera.name), &json!(camera.split)));
        let by_view = server.post_json(&format!("{job}/views"), &json!({ "views": [shown["view"]] })).await;
        let by_name = server.get(&format!("{job}/view?frame={}", camera.name)).await.expect(200);
        assert_eq!(by_view.expect(200).body, by_name.body, "{}", camera.name);
    }
    let path_of_cameras = json!({ "path": [cameras[0]["view"]], "frames": 2 });
    server.post_json(&format!("{job}/animation"), &path_of_cameras).await.expect(200);
    server.get(&format!("{path}?split=test")).await.expect_problem(422, "invalid-parameter");
}

pub(super) async fn views_come_in_three_formats_and_as_multipart(coverage: Coverage) {
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
    let parts = parts(&many.body, many.header("content-type"));
    let sizes: Vec<_> = parts
        .iter()
        .enumerate()
        .map(|(index, (head, content))| {
            assert!(head.starts_with("Content-Type: image/png\r\n"), "{head}");
            assert!(head.ends_with(&format!("inline; filename=\"{index}.png\"")), "{head}");
            let picture = picture_of(content);
            (picture.width(), picture.height())
        })
        .collect();
    assert_eq!(sizes, [(40, 32), (20, 16)]);
    let form = server
        .send("POST", &format!("{job}/views"), |request| {
            request.json(&body).header("accept", "multipart/form-data")
        })
        .await
        .expect(200);
    assert!(form.header("content-type").starts_with("multipart/form-data; boundary="));
    let fields = self::parts(&form.body, form.header("content-type"));
    for (index, ((head, content), (_, same))) in fields.iter().zip(&parts).enumerate() {
        assert!(head.ends_with(&format!("form-data; name=\"{index}\"; filename=\"{index}.png\"")), "{head}");
        assert_eq!(content, same);
    }
}

pub(super) async fn depth_and_alpha_are_served_as_pictures_and_as_numbers(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let view = |query: &'static str| {
        let path = format!("{job}/view?frame=test/r_0&{query}");
        let server = &server;
        async move { server.get(&path).await.expect(200) }
    };
    let floats = |file: &[u8]| -> Vec<f32> {
        let values = &file[file.len() - 4 * 40 * 32..];
        values.chunks(4).map(|bytes| f32::from_le_bytes(bytes.try_into().expect("four"))).collect()
    };
    let array = view("output=depth&format=npy").await;
    assert_eq!(array.header("content-type"), "application/x-npy");
    assert!(!array.headers.contains_key("x-depth-scale"), "its numbers are in the dataset's units");
    let depths = floats(&array.body);
    let depth = view("output=depth").await;
    let scale: f64 = depth.header("x-depth-scale").parse().expect("a number");
    let image::DynamicImage::ImageLuma16(steps) = picture_of(&depth.body) else { panic!("16-bit gray") };
    assert_eq!((steps.width(), steps.height(), steps.as_raw()[0]), (40, 32, 0));
    for (step, depth) in steps.as_raw().iter().zip(&depths) {
        assert!((f64::from(*step) * scale - f64::from(*depth)).abs() <= 0.5 * scale);
    }
    let alphas = floats(&view("output=alpha&format=npy").await.body);
    let image::DynamicImage::ImageLuma8(levels) = picture_of(&view("output=alpha").await.body) else {
        panic!("8-bit gray")
    };
    for (level, alpha) in levels.as_raw().iter().zip(&alphas) {
        assert_eq!(f32::from(*level), (alpha * 255.0).round());
    }
    let both = json!({ "views": [{ "frame": "test/r_0" }, { "frame": "train/r_0" }], "output": "depth" });
    let both = server.post_json(&format!("{job}/views"), &both).await.expect(200);
    let parts = parts(&both.body, both.header("content-type"));
    assert!(parts[0].0.contains(&format!("X-Depth-Scale: {scale}")), "{}", parts[0].0);
    assert_eq!(parts[0].1, depth.body);
}

pub(super) async fn a_view_is_tagged_timed_and_rendered_once(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/view?position=4,0,0&look_at=0,0,0&width=64&height=48");
    let first = server.get(&path).await.expect(200);
    for stage in ["queue;dur=", "load;dur=", "render;dur=", "encode;dur="] {
        assert!(first.header("server-timing").contains(stage), "{}", first.header("server-timing"));
    }
    assert!(first.header("cache-control").starts_with("private, max-age="));
    let etag = first.header("etag").to_owned();
    let pose = Pose::look_at(DVec3::new(4.0, 0.0, 0.0), DVec3::ZERO, DVec3::Z).expect("a view");
    let turn = DQuat::from_mat3(&pose.rotation().transpose());
    let quat = format!("quat={},{},{},{}", -2.0 * turn.w, -2.0 * turn.x, -2.0 * turn.y, -2.0 * turn.z);
    for same in [
        path.clone(),
        format!("{path}&up=0,0,2&fov=60&format=png&output=color"),
        format!("{job}/view?width=64&height=48&position=4,0,0&{quat}"),
    ] {
        let again = server.get(&same).await.expect(200);
        assert_eq!((again.header("etag"), &again.body), (etag.as_str(), &first.body), "{same}");
        assert_eq!(again.header("server-timing"), "cache;desc=hit", "{same}");
        let held = server.send("GET", &same, |request| request.header("if-none-match", &etag)).await;
        let held = held.expect(304);
        assert_eq!((held.header("etag"), held.body.len()), (etag.as_str(), 0));
        assert!(held.header("cache-control").starts_with("private"));
    }
    assert_eq!(server.renderer.painted(), 1);
    for other in
        ["format=webp", "format=jpeg", "format=jpeg&quality=10", "output=alpha", "fov=61", "up=0,1,1"]
    {
        let other = server.get(&format!("{path}&{other}")).await.expect(200);
        assert_ne!(other.header("etag"), etag);
    }
}

#[tokio::test]
async fn pictures_may_be_kept_in_as_much_memory_as_an_operator_says() {
    for (view_cache_bytes, painted) in [(0, 2), (64 << 20, 1), (u64::MAX, 1)] {
        let limits = tcgs::http::config::RequestLimits { view_cache_bytes, ..Setup::default().limits };
        let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
        let path = format!("{}/view?frame=test/r_0&width=64", server.succeeded().await);
        for _ in 0..2 {
            server.get(&path).await.expect(200);
        }
        assert_eq!(server.renderer.painted(), painted, "with {view_cache_bytes} bytes");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_pictures_for_clients_that_read_slowly_are_bounded_together() {
    let limits = RequestLimits { held_bytes: 20 << 20, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    // 16 MiB of numbers, more than sockets take.
    let large =
        format!("{job}/view?position=4,0,0&look_at=0,0,0&width=4096&height=1024&output=alpha&format=npy");
    let unread = server.open("GET", &large, |request| request).await;
    assert_eq!(unread.status(), 200);
    let detail = server.get(&large).await.expect_problem(503, "busy");
    assert!(detail.contains("read slowly"), "{detail}");
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
    drop(unread);
    eventually("there is room again", async || server.get(&large).await.status == 200).await;
    let whole = server.get(&large).await.expect(200);
    assert_eq!(whole.header("content-length"), whole.body.len().to_string());
}

pub(super) async fn a_view_that_many_ask_for_at_once_is_rendered_once(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/view?frame=test/r_0&width=17");
    let (first, second, third, ()) =
        tokio::join!(server.get(&path), server.get(&path), server.get(&path), async {
            server.renderer.gate.someone_waits().await;
            server.renderer.gate.open();
        });
    let first = first.expect(200);
    for other in [second, third] {
        assert_eq!(other.expect(200).body, first.body);
    }
    assert_eq!(server.renderer.painted(), 1);
}

pub(super) async fn impossible_views_are_refused_by_name(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    for (query, kind, named) in [
        ("fov=50", "invalid-parameter", "position"),
        ("look_at=0,0,0", "invalid-parameter", "position"),
        ("pos=1,2,3", "invalid-parameter", "pos: is not a parameter"),
        ("position=1,2,3&lookat=0,0,0", "invalid-parameter", "lookat: is not a parameter"),
        ("position=1,0,0&look_at=0,0,0&fx=50", "invalid-parameter", "fx"),
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
        ("frame=test/r_0&quat=1,0,0,0", "invalid-parameter", "quat"),
        ("position=1,0,0&quat=0,0,0,0", "invalid-parameter", "quat"),
        ("position=1,0,0&quat=1,0,0", "invalid-parameter", "quat"),
        ("position=1,0,0&quat=1,0,0,0&up=0,0,1", "invalid-parameter", "up"),
        ("quat=1,0,0,0", "invalid-parameter", "position"),
        ("frame=test/r_0&output=normals", "invalid-parameter", "output"),
        ("frame=test/r_0&output=depth&format=jpeg", "invalid-parameter", "format"),
        ("frame=test/r_0&format=npy", "invalid-parameter", "format"),
        ("frame=test/r_0&quality=90", "invalid-parameter", "quality"),
        ("frame=test/r_0&format=jpeg&quality=0", "invalid-parameter", "quality"),
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
    let painted = server.renderer.painted();
    type Change = dyn Fn(&mut Value);
    let faults: [(&Change, &str); 14] = [
        (&|view| *view = json!({}), "frame, position or camera_to_world is needed"),
        (&|view| *view = json!({ "position": [1, 2, 3] }), "look_at"),
        (&|view| *view = json!({ "position": [1, 2], "look_at": [0, 0, 0] }), "length"),
        (&|view| view["position"] = json!([1, 2, 3]), "camera_to_world cannot be combined with position"),
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
    for (field, value) in [("output", "normals"), ("format", "gif"), ("format", "npy"), ("speed", "high")] {
        let body = json!({ "views": [{ "frame": "test/r_0" }], field: value });
        let detail = server.post_json(&views, &body).await.expect_problem(422, "invalid-view");
        assert!(detail.contains(value) || detail.contains(field), "{detail}");
    }
    for views_asked in [json!([]), json!(vec![json!({ "frame": "test/r_0" }); 65]), json!([large, large])] {
        server.post_json(&views, &json!({ "views": views_asked })).await.expect(422);
    }
    assert_eq!(server.renderer.painted(), painted, "every fault is found before anything is rendered");
    let broken = server
        .send("POST", &views, |request| request.header("content-type", "application/json").body("{\"v"));
    broken.await.expect_problem(400, "malformed-json");
    let untyped = server.send("POST", &views, |request| request.body("{}"));
    untyped.await.expect_problem(415, "unsupported-media-type");
}

pub(super) async fn a_job_without_a_file_has_no_views(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let queued = server.get(&job).await.expect(200);
    assert!(queued.headers.contains_key("retry-after"), "a poller is told when to ask again");
    for part in ["artifact", "cameras", "view", "view?frame=test/r_0"] {
        let detail = server.get(&format!("{job}/{part}")).await.expect_problem(409, "no-artifact");
        assert!(detail.contains("queued"), "{detail}");
    }
    let views = json!({ "views": [{ "frame": "test/r_0" }] });
    server.post_json(&format!("{job}/views"), &views).await.expect_problem(409, "no-artifact");
}

/// Milliseconds of a step in `Server-Timing`.
fn timing(answer: &Answer, step: &str) -> f64 {
    let header = answer.header("server-timing");
    let (_, rest) = header.split_once(&format!("{step};dur=")).expect("the step is there");
    rest.split(',').next().and_then(|number| number.trim().parse().ok()).expect("a number")
}

/// They take turns at one renderer, where the small one waits while the large one is rendered.
pub(super) async fn a_picture_is_rendered_while_another_is_encoded(coverage: Coverage) {
    let limits = tcgs::http::config::RequestLimits { renders: 1, ..Default::default() };
    let server = Server::start_with(&coverage, Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let large = format!("{job}/view?position=1,0,0&look_at=0,0,0&width=4096&height=4096&format=webp");
    let (large, small) = tokio::join!(server.get(&large), async {
        while server.renderer.painted() == 0 {
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
        server.get(&format!("{job}/view?frame=test/r_0")).await
    });
    let (waited, encoded) = (timing(&small.expect(200), "queue"), timing(&large.expect(200), "encode"));
    assert!(waited < encoded, "waited {waited} ms for a picture that took {encoded} ms to encode");
}

pub(super) async fn a_full_render_queue_and_a_broken_renderer_are_told_apart(coverage: Coverage) {
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
    server.get(&format!("{job}/view?{pose}&width=14")).await.expect_problem(503, "device-lost");
    server.get(&format!("{job}/view?{pose}&width=15")).await.expect_problem(507, "gpu-memory");
    let large = json!({ "views": [{ "frame": "test/r_0", "width": 15 }] });
    server.post_json(&format!("{job}/views"), &large).await.expect_problem(507, "gpu-memory");
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_that_hangs_delays_no_view_of_the_others() {
    let limits = Setup::default().limits.for_remote_views();
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let hanging = format!("{job}/view?position=1,0,0&look_at=0,0,0&height=16&width=17");
    let (hung, ()) = tokio::join!(server.get(&hanging), async {
        server.renderer.gate.someone_waits().await;
        server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
        server.renderer.gate.open();
    });
    hung.expect(200);
}
