//! The page for browsers: what it shows to whom, and what it loads.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use serde_json::json;
use tcgs::domain::{Digest, Scope};

use super::{
    access::{UNKNOWN, with_key},
    report::{Element, parse},
};
use crate::support::{
    contract::Coverage,
    fakes::HOSTILE,
    faults::Failing,
    server::{Answer, Server, Setup},
};

const BROWSER: &str = "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8";

async fn open(server: &Server, path: &str, key: Option<&str>) -> Answer {
    server
        .send("GET", path, |request| {
            let request = request.header("accept", BROWSER);
            key.into_iter().fold(request, |request, key| request.bearer_auth(key))
        })
        .await
}

/// The elements of a page whose policy lets its own script and style run, and whose addresses are relative.
fn read(answer: &Answer) -> (String, Vec<Element>) {
    assert_eq!(answer.header("content-type"), "text/html; charset=utf-8");
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = parse(&page);
    let policy = answer.header("content-security-policy");
    for (element, directive) in [("script", "script-src"), ("style", "style-src")] {
        let all: Vec<&Element> = elements.iter().filter(|found| found.name == element).collect();
        let [only] = all[..] else { panic!("{} of {element}", all.len()) };
        let hash = STANDARD.encode(Digest::of(only.text.as_bytes()).as_bytes());
        assert!(policy.contains(&format!("; {directive} 'sha256-{hash}';")), "{policy}");
    }
    for element in &elements {
        for (name, value) in &element.attributes {
            assert!(
                !name.starts_with("on") && name != "style",
                "the policy would not let it work: {element:?}"
            );
            if matches!(&**name, "src" | "href" | "action" | "poster") {
                let is_relative = !value.starts_with('/') && !value.contains("//");
                assert!(is_relative, "a proxy may serve the page below a path: {element:?}");
            }
        }
    }
    (page, elements)
}

fn attributes<'a>(elements: &'a [Element], name: &str) -> Vec<&'a str> {
    elements.iter().filter_map(|element| element.attributes.get(name)).map(String::as_str).collect()
}

pub(super) async fn a_browser_gets_a_page_of_its_jobs(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let (page, _) = read(&open(&server, "/", None).await.expect(200));
    assert!(page.contains("Nothing here yet."));

    let name = url::form_urlencoded::byte_serialize(HOSTILE.as_bytes()).collect::<String>();
    let done = server.upload(&format!("?name={name}"), "succeed").await.expect(201);
    let done = done.header("location").to_owned();
    server.reaches(&done, "succeeded").await;
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let answer = open(&server, "/", None).await.expect(200);
    assert_eq!(answer.header("vary"), "accept");
    let (page, elements) = read(&answer);
    assert_eq!(attributes(&elements, "data-state"), ["running", "succeeded"], "the newest first");
    assert_eq!(attributes(&elements, "data-act"), ["cancel", "delete"]);
    assert!(page.contains("30.00 dB, 55 B"), "{page}");
    assert!(!page.contains("<script>alert(1)") && attributes(&elements, "data-name").contains(&HOSTILE));
    let thumbnail = format!("{}/thumbnail", &done[1..]);
    assert!(attributes(&elements, "src").contains(&&*thumbnail));
    let links = attributes(&elements, "href");
    for job in [&done, &running] {
        let report = format!("{}/report", &job[1..]);
        assert!(links.contains(&&*report), "{links:?}");
        open(&server, &format!("/{report}"), None).await.expect(200);
    }
    let presets = elements.iter().filter(|element| element.name == "output").count();
    assert_eq!(presets, 3, "each has its estimate");

    // Older jobs are a link away.
    let (_, first) = read(&open(&server, "/?limit=1", None).await.expect(200));
    let older = *attributes(&first, "href").last().expect("links");
    let (_, second) = read(&open(&server, &older.replacen('.', "/", 1), None).await.expect(200));
    assert_eq!(attributes(&second, "data-state"), ["succeeded"]);
    assert!(attributes(&first, "data-first").len() == 1 && attributes(&second, "data-first").is_empty());
    server.post(&format!("{running}/cancel")).await;

    // Programs find nothing there, as before.
    server.get("/").await.expect_problem(404, "not-found");
    let program = server.send("GET", "/", |request| request.header("accept", "application/json")).await;
    program.expect_problem(404, "not-found");
    open(&server, "/?limit=0", None).await.expect_problem(422, "invalid-parameter");
    open(&server, "/?color=red", None).await.expect_problem(422, "invalid-parameter");
    for (failing, status, kind) in [(Failing::Busy, 503, "busy"), (Failing::Gone, 500, "internal")] {
        server.faults.set(Some(failing));
        open(&server, "/", None).await.expect_problem(status, kind);
        server.faults.set(None);
    }
}

pub(super) async fn the_page_shows_nothing_without_a_key(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let scopes = [Scope::Read, Scope::JobsWrite];
    let [mine, other] = [server.key(&scopes).await, server.key(&scopes).await];
    let created = server.send("POST", "/v1/jobs?name=mine", |request| {
        request.bearer_auth(&mine.key).header("content-type", "application/zip").body("succeed")
    });
    created.await.expect(201);
    let shows = async |key: Option<&str>| {
        let (page, elements) = read(&open(&server, "/", key).await.expect(200));
        let asks = elements.iter().any(|element| element.attributes.get("type") == Some(&"password".into()));
        (page.contains("mine"), asks)
    };
    assert_eq!(shows(None).await, (false, true));
    assert_eq!(shows(Some(&mine.key)).await, (true, false));
    assert_eq!(shows(Some(&other.key)).await, (false, false));
    open(&server, "/", Some(UNKNOWN)).await.expect_problem(401, "invalid-key");
    let narrow = server.key(&[Scope::JobsWrite]).await;
    open(&server, "/", Some(&narrow.key)).await.expect_problem(403, "insufficient-scope");
    let once = server.key_at_rate(&[Scope::Read], std::num::NonZeroU32::MIN).await;
    open(&server, "/", Some(&once.key)).await.expect(200);
    open(&server, "/", Some(&once.key)).await.expect_problem(429, "too-many-requests");
    with_key(&server, "GET", "/", &mine.key).await.expect_problem(404, "not-found");
    let listed = with_key(&server, "GET", "/v1/jobs", &mine.key).await.expect(200).json();
    assert_eq!(listed["jobs"][0]["name"], json!("mine"));
}
