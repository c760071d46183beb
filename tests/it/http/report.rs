//! The report page: complete, without requests to other hosts, and with every text escaped.

use std::collections::BTreeMap;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use html5gum::{Token, Tokenizer};
use tcgs::{
    domain::{Digest, Phase, Problem, ProblemType, Progress},
    store::Outcome,
};

use crate::support::{
    contract::Coverage,
    eventually::eventually,
    fakes,
    server::{Server, Setup},
};

/// Elements that have no end tag.
const VOID: [&str; 4] = ["meta", "img", "input", "link"];

/// One start tag.
#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) attributes: BTreeMap<String, String>,
    /// The text right after it.
    pub(super) text: String,
}

/// The elements of a page, which must be without syntax errors and with every element closed in order.
pub(super) fn parse(page: &str) -> Vec<Element> {
    let (mut elements, mut open): (Vec<Element>, Vec<String>) = (Vec::new(), Vec::new());
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).expect("UTF-8");
    // The tokenizer has to be told where text is not markup.
    let mut emitter = html5gum::emitters::default::DefaultEmitter::default();
    emitter.naively_switch_states(true);
    for token in Tokenizer::new_with_emitter(page, emitter) {
        let Ok(token) = token;
        match token {
            Token::StartTag(tag) => {
                let name = text(&tag.name);
                let attributes =
                    tag.attributes.iter().map(|(name, value)| (text(name), text(value))).collect();
                if !VOID.contains(&&*name) && !tag.self_closing {
                    open.push(name.clone());
                }
                elements.push(Element { name, attributes, text: String::new() });
            }
            Token::EndTag(tag) => assert_eq!(open.pop(), Some(text(&tag.name)), "elements must nest"),
            Token::String(string) => {
                if let Some(element) = elements.last_mut() {
                    element.text.push_str(&text(&string));
                }
            }
            Token::Error(error) => panic!("not HTML: {error:?}"),
            Token::Comment(_) | Token::Doctype(_) => {}
        }
    }
    assert!(open.is_empty(), "left open: {open:?}");
    elements
}

/// Asserts that the page would load nothing but what it carries, and that its policy lets its own script and style run and
/// nothing else.
fn assert_self_contained(page: &str, policy: &str) -> Vec<Element> {
    let elements = parse(page);
    let directives: BTreeMap<&str, &str> =
        policy.split("; ").map(|directive| directive.split_once(' ').expect("a name and sources")).collect();
    assert_eq!(directives["default-src"], "'none'");
    assert_eq!(directives["connect-src"], "'self'");
    assert_eq!(directives["img-src"], "'self' data: blob:");
    for (element, directive) in [("script", "script-src"), ("style", "style-src")] {
        for found in elements.iter().filter(|found| found.name == element) {
            let hash = STANDARD.encode(Digest::of(found.text.as_bytes()).as_bytes());
            assert_eq!(
                directives[directive],
                format!("'sha256-{hash}'"),
                "the policy must let {element} run"
            );
            assert!(found.attributes.is_empty(), "{found:?}");
        }
    }
    for element in &elements {
        assert!(!["iframe", "object", "embed", "form", "base"].contains(&&*element.name), "{element:?}");
        for (name, value) in &element.attributes {
            assert!(
                !name.starts_with("on") && name != "style",
                "the policy would not let {name} work: {element:?}"
            );
            if matches!(&**name, "src" | "href" | "srcset" | "poster" | "action") {
                let no_icon = element.name == "link" && value == "data:,";
                // Links are followed by people; pictures of a job in training are the service's. Both are relative.
                let is_relative = !value.starts_with('/') && !value.contains(':') && !value.contains("//");
                let is_link = is_relative && matches!(&*element.name, "a" | "img");
                assert!(no_icon || is_link || value.starts_with("data:image/jpeg;base64,"), "{element:?}");
            }
        }
    }
    elements
}

pub(super) async fn a_finished_job_is_reported_on_one_page(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.succeeded().await;
    let path =
        server.get(&job).await.expect(200).json()["links"]["report"].as_str().expect("a path").to_owned();
    let answer = server.get(&path).await.expect(200);
    assert_eq!(answer.header("content-type"), "text/html; charset=utf-8");
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = assert_self_contained(&page, answer.header("content-security-policy"));

    let count = |name: &str| elements.iter().filter(|element| element.name == name).count();
    assert_eq!((count("script"), count("style"), count("html")), (1, 1, 1));
    assert_eq!(count("input"), 0, "the page asks nobody for a key: the browser has it");
    assert_eq!(count("img"), 4, "three pictures of the held-out view and the one that leads to the viewer");
    for said in [
        "30.00 dB",
        "Where the bytes went",
        "Curves",
        "PSNR against time",
        "SSIM against time",
        "Course",
        "steps per second",
        "λ",
        "fake",
        &*Digest::of(fakes::FILE).to_string(),
    ] {
        let said = if said == "λ" { "held-out views" } else { said };
        assert!(page.contains(said), "'{said}' is missing");
    }
    // Names of types are no words: a rename in the code must not reach the page.
    let is_identifier = |word: &&str| {
        let humps = word
            .as_bytes()
            .windows(2)
            .filter(|pair| pair[0].is_ascii_lowercase() && pair[1].is_ascii_uppercase());
        word.len() > 4 && word.bytes().all(|byte| byte.is_ascii_alphanumeric()) && humps.count() > 0
    };
    let shown = elements.iter().filter(|element| !matches!(&*element.name, "script" | "style"));
    let identifiers: Vec<&str> =
        shown.flat_map(|element| element.text.split_whitespace()).filter(is_identifier).collect();
    assert!(identifiers.is_empty(), "{identifiers:?}");
    assert!(page.contains("Figures of all 2 views"), "the summary of the table");
    // What each stage costs: against floats, against rounded attributes, and the renderer against f64.
    for said in ["What each stage costs", "-0.300 dB", "-0.250 dB", "1.50e-7", "2.00e-6"] {
        assert!(page.contains(said), "'{said}' is missing");
    }
    for sources in ["cGhvdG8=", "cmVuZGVy", "ZXJyb3I="] {
        assert!(page.contains(&format!("data:image/jpeg;base64,{sources}")), "{sources}");
    }
    // What a name would inject is there as text, and only as that.
    let hostile = |text: &str| text.contains("<script>alert(1)</script>");
    assert!(!hostile(&page) && page.contains("&lt;script&gt;alert(1)"));
    assert!(elements.iter().any(|element| hostile(&element.text)), "the name itself is shown whole");
    assert!(elements.iter().any(|element| element.attributes.values().any(|value| hostile(value))));

    let viewer =
        elements.iter().find(|element| element.attributes.get("id").is_some_and(|id| id == "viewer"));
    assert_eq!(viewer.expect("a link").attributes["href"], "viewer");

    figures_are_comma_separated(&server, &path).await;
    let etag = answer.header("etag").to_owned();
    server.send("GET", &path, |request| request.header("if-none-match", etag)).await.expect(304);
    let picky = server.send("GET", &path, |request| request.header("accept", "application/json")).await;
    picky.expect_problem(406, "not-acceptable");
    server.get(&format!("{path}?width=3")).await.expect_problem(422, "invalid-parameter");
    server.get(&format!("{path}?format=pdf")).await.expect_problem(422, "invalid-parameter");
}

async fn figures_are_comma_separated(server: &Server, path: &str) {
    let by_header =
        server.send("GET", path, |request| request.header("accept", "text/csv")).await.expect(200);
    let both =
        server.send("GET", path, |request| request.header("accept", "text/csv, text/html;q=0.5")).await;
    assert!(
        both.expect(200).header("content-type").starts_with("text/html"),
        "the page unless it is not accepted"
    );
    let path = format!("{path}?format=csv");
    let answer = server.get(&path).await.expect(200);
    assert_eq!(by_header.body, answer.body);
    assert_eq!(answer.header("content-type"), "text/csv; charset=utf-8; header=present");
    let text = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let [head, line] = text.lines().collect::<Vec<_>>().try_into().expect("a head and a line");
    let cells: BTreeMap<&str, &str> = head.split(',').zip(line.split(',')).collect();
    assert_eq!(head.split(',').count(), line.split(',').count(), "{text}");
    for (column, value) in [
        ("state", "succeeded"),
        ("psnr", "30"),
        ("stage_noise", "30.2"),
        ("render_rmse", "0.00000015"),
        ("psnr_before_quantisation", "30.5"),
        ("right_half_corrected_psnr", "31.25"),
        ("exposure_corrected", "true"),
        ("crop_saved_bytes", "1234"),
        ("crop_lost_psnr", "0.25"),
        ("integer_over_float_bits", "1.002"),
    ] {
        assert_eq!(cells[column], value, "{column}: {text}");
    }
    let etag = answer.header("etag").to_owned();
    server.send("GET", &path, |request| request.header("if-none-match", etag)).await.expect(304);
    let picky = server.send("GET", &path, |request| request.header("accept", "text/html")).await;
    picky.expect_problem(406, "not-acceptable");
}

/// The lines of a page's curves, in their order.
fn lines(elements: &[Element]) -> Vec<&str> {
    let lines = elements.iter().filter(|element| element.name == "polyline");
    lines.map(|line| &*line.attributes["points"]).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn curves_are_of_the_course_that_led_to_where_the_job_is() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let report = |step: u64, elapsed_seconds: f64, psnr: Option<f64>| Progress {
        step,
        total: 100,
        elapsed_seconds,
        loss: psnr.map(|psnr| 2.0 / psnr),
        psnr,
        bytes: psnr.map(|psnr| 10_000 + 100 * psnr as u64),
        ..Progress::default()
    };
    let run = async |phase: Phase, reports: &[Progress]| {
        let lease = server.store.claim("test").await.expect("a claim").expect("a job").lease;
        for one in reports {
            server.store.record(&lease, std::slice::from_ref(one)).await.expect("stored");
            server.store.report(&lease, Phase::Train, one).await.expect("stored");
        }
        let last = reports.last().expect("a report").clone();
        let later = Progress { elapsed_seconds: last.elapsed_seconds + 2.0, ..last };
        server.store.report(&lease, phase, &later).await.expect("stored");
        lease
    };
    // The second attempt goes on from a checkpoint, which it tells of before it has any figures.
    let first = [(10, 1.0, 10.0), (20, 2.0, 14.0), (30, 3.0, 16.0), (40, 4.0, 17.0)];
    let first = run(Phase::Train, &first.map(|(step, at, psnr)| report(step, at, Some(psnr)))).await;
    let problem = Problem::new(ProblemType::DeviceLost, "as the test wants it");
    server.store.finish(&first, Outcome::Retry(problem)).await.expect("ended");
    run(
        Phase::Evaluate,
        &[
            report(25, 0.5, None),
            report(30, 1.0, Some(16.5)),
            report(60, 4.0, Some(18.0)),
            report(100, 8.0, Some(20.0)),
        ],
    )
    .await;

    let answer = server.get(&format!("{job}/report")).await.expect(200);
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = parse(&page);
    // PSNR over 0 to 10 s and over 11.0 to 12.0 kB, loss over 0 to 100 steps; y is 214 at the bottom and 12 at the top.
    assert_eq!(
        lines(&elements),
        [
            "94.6,214.0 131.2,133.2 167.8,82.7 277.6,52.4 424.0,12.0",
            "58.0,214.0 204.4,133.2 277.6,82.7 350.8,52.4 424.0,12.0",
            "94.6,12.0 131.2,127.4 167.8,171.2 277.6,191.6 424.0,214.0",
        ]
    );
}

pub(super) async fn a_curve_is_reported_with_each_of_its_files(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job =
        server.upload("?rd_curve=0.001,0.004", "succeed").await.expect(201).header("location").to_owned();
    server.reaches(&job, "succeeded").await;
    let answer = server.get(&format!("{job}/report")).await.expect(200);
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = assert_self_contained(&page, answer.header("content-security-policy"));
    let links = elements.iter().filter_map(|element| element.attributes.get("href"));
    let viewers: Vec<&str> = links.map(|link| &**link).filter(|link| link.starts_with("viewer?")).collect();
    assert_eq!(viewers, ["viewer?lambda=0.001", "viewer?lambda=0.004"]);
    for (link, weight) in viewers.iter().zip(["0.001", "0.004"]) {
        let page = server.get(&format!("{job}/{link}")).await.expect(200);
        let page = String::from_utf8(page.body.to_vec()).expect("UTF-8");
        assert!(page.contains(&format!("λ = {weight}</h1>")), "its title names the file");
        for address in [format!("artifact?lambda={weight}"), format!("view?lambda={weight}")] {
            let is_optional = address.starts_with("artifact") && tcgs::viewer_page::assets().is_none();
            assert!(is_optional || page.contains(&format!("\"{address}\"")), "{address}: {page}");
        }
    }
    server.get(&format!("{job}/viewer?lambda=0.5")).await.expect_problem(404, "no-such-lambda");
    let dots =
        elements.iter().filter(|element| element.name == "title" && element.text.starts_with("λ = ")).count();
    assert_eq!(dots, 2, "each file has its dot");
}

pub(super) async fn a_report_has_the_names_and_files_of_its_job(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let job = server.upload("?name=kermit&metadata[site]=north", "succeed").await.expect(201);
    let job = job.header("location").to_owned();
    server.reaches(&job, "succeeded").await;
    let answer = server.get(&format!("{job}/report")).await.expect(200);
    let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
    let elements = assert_self_contained(&page, answer.header("content-security-policy"));
    assert!(page.contains("<title>kermit - tcgs</title>") && page.contains("site: north"));
    let links = elements.iter().filter(|element| element.name == "a").map(|link| &*link.attributes["href"]);
    let origin = format!("http://{}{job}/report", server.address);
    let base = reqwest::Url::parse(&origin).expect("an address");
    let links: Vec<String> = links.map(|link| base.join(link).expect("an address").to_string()).collect();
    let files =
        ["/", "/artifact", "/export?format=ply", "/export?format=spz", "/report?format=csv", "", "/viewer"];
    let expected = files.iter().enumerate().map(|(place, rest)| match place {
        0 => format!("http://{}/", server.address),
        _ => format!("http://{}{job}{rest}", server.address),
    });
    assert_eq!(links, expected.collect::<Vec<_>>());
    for link in &links[1..] {
        let path = link.strip_prefix(&format!("http://{}", server.address)).expect("of this service");
        server.get(path).await.expect(200);
    }
}

pub(super) async fn a_job_without_a_result_is_reported_as_it_stands(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let failed = server.create("fail").await;
    let read = async |job: &str| {
        let answer = server.get(&format!("{job}/report")).await.expect(200);
        let page = String::from_utf8(answer.body.to_vec()).expect("UTF-8");
        let elements = assert_self_contained(&page, answer.header("content-security-policy"));
        (page, elements)
    };
    let has = |elements: &[Element], id: &str| {
        elements.iter().any(|element| element.attributes.get("id").is_some_and(|found| found == id))
    };
    let (page, elements) = read(&running).await;
    assert!(page.contains("In progress") && has(&elements, "live") && has(&elements, "cancel"));
    assert!(!page.contains("http-equiv"), "it is its script that follows the job");
    let follows = elements.iter().filter(|element| element.name == "script");
    assert_eq!(follows.map(|script| script.text.contains("new EventSource")).collect::<Vec<_>>(), [true]);
    eventually("there is a picture", async || server.get(&format!("{running}/preview")).await.status == 200)
        .await;
    let (page, _) = read(&running).await;
    assert!(page.contains("src=\"preview\"") && page.contains("src=\"preview?of=photograph\""), "{page}");
    server.post(&format!("{running}/cancel")).await;
    server.reaches(&running, "cancelled").await;
    let (page, elements) = read(&running).await;
    assert!(page.contains("was cancelled") && !has(&elements, "live"));
    assert!(
        !elements.iter().any(|element| element.name == "script"),
        "there is nothing to follow or to turn"
    );
    let id = running.rsplit('/').next().expect("an id");
    assert!(page.contains("It came to step") && page.contains(&format!("tcgs retry {id}")), "{page}");
    assert!(page.contains("src=\"preview\""), "as it looked then");
    server.reaches(&failed, "failed").await;
    let (page, _) = read(&failed).await;
    assert!(
        page.contains("as the test wants it") && page.contains("urn:tcgs:problem:worker-panicked"),
        "{page}"
    );
}
