//! The page that shows a scene, and its module: headers, conditions, and what stands in the page.

use std::io::Read as _;

use flate2::read::GzDecoder;
use serde_json::Value;
use tcgs::viewer_page::assets;

use crate::support::{
    contract::Coverage,
    server::{Answer, Server, Setup},
    skip::skip,
};

async fn get(server: &Server, path: &str, headers: &[(&'static str, &str)]) -> Answer {
    let with = |request, (name, value): &(&'static str, &str)| {
        reqwest::RequestBuilder::header(request, *name, *value)
    };
    server.send("GET", path, |request| headers.iter().fold(request, with)).await
}

pub(super) async fn the_page_of_a_job_has_its_cameras_and_its_own_policy(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path = format!("{job}/viewer");
    let answer = server.get(&path).await.expect(200);
    let policy = answer.header("content-security-policy");
    for part in
        ["default-src 'none'", "'wasm-unsafe-eval'", "worker-src 'self' blob:", "frame-ancestors 'none'"]
    {
        assert!(policy.contains(part), "{policy}");
    }
    assert!(!policy.contains("unsafe-inline") && !policy.contains("'unsafe-eval'"), "{policy}");
    let page = String::from_utf8(answer.body.to_vec()).expect("text");
    let begin = "<script id=\"scene\" type=\"application/json\">";
    let data = page.split(begin).nth(1).and_then(|rest| rest.split("</script>").next()).expect("the scene");
    let scene: Value = serde_json::from_str(data).expect("JSON");
    assert!(scene["stops"].as_array().is_some_and(|stops| !stops.is_empty()), "{scene}");
    assert_eq!(scene["view"], "view");
    let expected = if assets().is_some() { "artifact" } else { "" };
    assert_eq!(scene["file"]["href"].as_str().unwrap_or_default(), expected);

    let etag = answer.header("etag");
    get(&server, &path, &[("if-none-match", etag)]).await.expect(304);
    get(&server, &path, &[("accept", "image/png")]).await.expect_problem(406, "not-acceptable");
    server.get(&format!("{path}?x=1")).await.expect(422);
    let nobody = "/v1/jobs/00000000-0000-7000-8000-000000000000/viewer";
    server.get(nobody).await.expect(404);
}

pub(super) async fn a_job_without_a_file_has_no_page_yet(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    server.get(&format!("{job}/viewer")).await.expect_problem(409, "no-artifact");
}

pub(super) async fn the_module_comes_compressed_to_those_who_take_it_so(coverage: Coverage) {
    let Some(built) = assets() else {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    };
    let server = Server::start(&coverage).await;
    let path = "/viewer/module.wasm";
    let packed = get(&server, path, &[("accept-encoding", "br, gzip;q=0.5")]).await.expect(200);
    assert_eq!(packed.header("content-encoding"), "gzip");
    let mut module = Vec::new();
    GzDecoder::new(&packed.body[..]).read_to_end(&mut module).expect("gzip");
    assert!(module.starts_with(b"\0asm"));
    let plain = get(&server, path, &[("accept-encoding", "gzip;q=0")]).await.expect(200);
    assert!(plain.headers.get("content-encoding").is_none());
    assert!(plain.body[..] == module[..]);
    assert_eq!(plain.header("content-type"), "application/wasm");
    let etag = packed.header("etag");
    assert!(etag != plain.header("etag"));
    get(&server, path, &[("accept-encoding", "gzip"), ("if-none-match", etag)]).await.expect(304);

    let worker = server.get("/viewer/worker.js").await.expect(200);
    assert!(worker.body[..] == *built.worker.as_bytes());
    get(&server, "/viewer/worker.js", &[("if-none-match", worker.header("etag"))]).await.expect(304);
    // A page is under 2 MB, as it travels.
    assert!(packed.body.len() + worker.body.len() < 2_000_000);
}
