//! Views of a finished scene.

use serde_json::{Value, json};

use crate::support::{
    contract::Coverage,
    fakes,
    server::{Server, Setup, picture as picture_of},
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

pub(super) async fn impossible_views_are_refused_by_name(coverage: Coverage) {
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

pub(super) async fn a_job_without_a_file_has_no_views(coverage: Coverage) {
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
    server.get(&format!("{job}/view?{pose}&width=14")).await.expect_problem(500, "device-lost");
    server.get(&format!("{job}/view?{pose}&width=15")).await.expect_problem(507, "gpu-memory");
    let large = json!({ "views": [{ "frame": "test/r_0", "width": 15 }] });
    server.post_json(&format!("{job}/views"), &large).await.expect_problem(507, "gpu-memory");
    server.get(&format!("{job}/view?frame=test/r_0")).await.expect(200);
}
