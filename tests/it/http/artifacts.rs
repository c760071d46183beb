//! The finished file: whole, by range, conditionally, and by lambda of a curve.

use serde_json::{Value, json};
use tcgs::domain::Digest;

use crate::support::{
    contract::Coverage,
    eventually::eventually,
    fakes,
    server::{Answer, Server, picture},
};

pub(super) async fn every_file_of_a_curve_is_served_by_its_weight(coverage: Coverage) {
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

pub(super) async fn a_finished_job_has_a_thumbnail(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = server.get(&job).await.json()["links"]["thumbnail"].as_str().expect("a path").to_owned();
    let whole = server.get(&path).await.expect(200);
    assert_eq!((whole.header("content-type"), &whole.body[..]), ("image/jpeg", fakes::THUMBNAIL));
    let name = format!("{}.thumbnail.jpg\"", job.rsplit('/').next().expect("an id"));
    assert!(whole.header("content-disposition").ends_with(&name), "{:?}", whole.headers);
    let with = async |name: &'static str, value: &str| {
        server.send("GET", &path, |request| request.header(name, value)).await
    };
    with("if-none-match", whole.header("etag")).await.expect(304);
    assert_eq!(&with("range", "bytes=0-1").await.expect(206).body[..], b"\xff\xd8");
    with("range", "bytes=999-").await.expect_problem(416, "range-not-satisfiable");
    with("if-match", "\"another\"").await.expect_problem(412, "precondition-failed");
    server.get(&format!("{path}?width=3")).await.expect_problem(422, "invalid-parameter");
    let waiting = server.create("wait").await;
    server.get(&format!("{waiting}/thumbnail")).await.expect_problem(409, "no-artifact");
    server.post(&format!("{waiting}/cancel")).await;
    let listed = server.get(&format!("{job}/artifacts")).await.expect(200).json();
    let kinds: Vec<&Value> =
        listed["artifacts"].as_array().expect("files").iter().map(|file| &file["kind"]).collect();
    assert!(kinds.contains(&&json!("thumbnail")), "{kinds:?}");
}

pub(super) async fn a_job_in_training_has_a_preview(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.create("wait").await;
    let path = server.get(&job).await.json()["links"]["preview"].as_str().expect("a path").to_owned();
    let mut preview = None;
    eventually("there is a picture", async || {
        let answer = server.get(&path).await;
        preview = (answer.status == 200).then(|| answer.clone());
        assert!(matches!(answer.status, 200 | 404), "{answer:?}");
        preview.is_some()
    })
    .await;
    let preview = preview.expect("a picture");
    let size = |answer: &Answer| {
        let picture = picture(&answer.body);
        (picture.width(), picture.height())
    };
    assert_eq!((preview.header("content-type"), size(&preview)), ("image/jpeg", (4, 3)));
    let photograph = server.get(&format!("{path}?of=photograph")).await.expect(200);
    assert_eq!(size(&photograph), (8, 6));
    let first = preview.header("etag").to_owned();
    // Each picture replaces the one before, and the photograph stays.
    eventually("there is another", async || server.get(&path).await.expect(200).header("etag") != first)
        .await;
    let tag = photograph.header("etag").to_owned();
    let same = format!("{path}?of=photograph");
    server.send("GET", &same, |request| request.header("if-none-match", tag)).await.expect(304);
    let listed = server.get(&format!("{job}/artifacts")).await.expect(200).json();
    assert_eq!(listed["artifacts"].as_array().map(Vec::len), Some(2), "{listed:#}");
    server.get(&format!("{path}?of=depth")).await.expect_problem(422, "invalid-parameter");
    server.post(&format!("{job}/cancel")).await;

    // A finished job has its thumbnail there, and its last picture is gone.
    let done = server.succeeded().await;
    assert_eq!(&server.get(&format!("{done}/preview")).await.expect(200).body[..], fakes::THUMBNAIL);
    server.get(&format!("{done}/preview?of=photograph")).await.expect_problem(404, "artifact-not-found");
}

pub(super) async fn the_file_is_served_whole_in_parts_and_conditionally(coverage: Coverage) {
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
    for range in ["bytes=0-1", "bytes=1000000-"] {
        let head = server.send("HEAD", &path, |request| request.header("range", range)).await.expect(200);
        assert_eq!(head.header("content-length"), whole.header("content-length"), "ranges are of GET");
    }

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

pub(super) async fn a_damaged_file_is_not_sent_as_the_whole_one(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/artifact");
    server.get(&path).await.expect(200);
    let hex = Digest::of(fakes::FILE).to_string();
    let file = server.data.path().join("blobs/sha256").join(&hex[..2]).join(&hex[2..4]).join(&hex);
    let mut bytes = fakes::FILE.to_vec();
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(file, bytes).expect("written");
    server.get(&path).await.expect_problem(500, "internal");
    // A part cannot be checked; the digest of the whole, which comes with it, tells.
    let part = server.send("GET", &path, |request| request.header("range", "bytes=0-4")).await.expect(206);
    assert_eq!(part.body, fakes::FILE[..5]);
}
