//! Pages in a real browser when something goes wrong: a service that is slow or silent, a lost device, hidden pages, and files that are
//! gone.

use std::path::Path;

use serde_json::json;
use tcgs::{domain::Scope, gpu::GpuError, viewer_page::assets};

use super::{
    front::{STATES, choose},
    viewer_page::{SAVED, SHOWN},
};
use crate::support::{
    browser::{self, Page},
    contract::Coverage,
    eventually::eventually,
    server::Server,
    skip::skip,
};

const NO_GPU: [&str; 1] = ["--disable-gpu"];

/// Delays views by 80 ms, notes their widths, and refuses so many of them with `status`.
const SLOW: &str = "{
    const quick = window.fetch.bind(window);
    Object.assign(window, { widths: [], refusals: 0, status: 0 });
    window.fetch = async (address, ...more) => {
        const { pathname, searchParams } = new URL(address, location.origin + location.pathname);
        if (!pathname.endsWith('/view')) return quick(address, ...more);
        window.widths.push(Number(searchParams.get('width')));
        await new Promise(done => setTimeout(done, 80));
        if (window.refusals === 0) return quick(address, ...more);
        window.refusals -= 1;
        return new Response('{}', { status: window.status });
    };
}";

/// In place of WebGPU: a worker that draws nothing, and ends with `fault` once there is one.
const WORKER: &str = "{
    Object.defineProperty(navigator, 'gpu', { value: { requestAdapter: async () => ({}) } });
    Object.assign(window, { fault: null, terminated: 0 });
    window.Worker = class {
        constructor(address) { window.started = String(address); }
        postMessage(message) {
            const isOpening = 'open' in message;
            const data = isOpening ? { opened: { gaussians: 1, decode_sha256: '' } } : { drawn: true, depth: new Float32Array(1) };
            setTimeout(() => this.onmessage({ data: window.fault && !isOpening ? { fault: window.fault } : data }));
        }
        terminate() { window.terminated += 1; }
    };
    // Depths of a picture that nobody drew.
    CanvasRenderingContext2D.prototype.putImageData = () => {};
}";

/// Counts loads of the page and its streams. Answers to the page itself are `answer`, if there is one; an error if that is 0.
const FOLLOWING: &str = "{
    sessionStorage.loads = 1 + Number(sessionStorage.loads || 0);
    const quick = window.fetch.bind(window);
    Object.assign(window, { sources: [], answer: null, heard: false });
    window.EventSource = class extends EventSource {
        constructor(address) {
            super(address);
            window.sources.push(this);
            this.addEventListener('progress', () => { window.heard = true; });
        }
    };
    window.fetch = async (address, ...more) => {
        if (window.answer === null || new URL(address, location).pathname !== location.pathname) return quick(address, ...more);
        if (window.answer === 0) throw new TypeError('silent');
        return new Response('', { status: window.answer });
    };
}";

/// Streams that the page keeps.
const STREAMS: &str =
    "(window.sources || []).filter(source => source.readyState !== EventSource.CLOSED).length";

const LOADS: &str = "sessionStorage.loads";

/// What the page says of its service.
const TOLD: &str = "document.getElementById('told').textContent";

const SILENT: &str = "The service does not answer.";

/// As a browser does when another page comes before this one, and when it comes back.
fn visibility(state: &str) -> String {
    format!(
        "Object.defineProperty(document, 'visibilityState', {{ configurable: true, get: () => '{state}' }});
         document.dispatchEvent(new Event('visibilitychange'));"
    )
}

/// Turns by a key, and waits for a picture.
async fn turn(page: &mut Page) {
    let frames = "Number(document.getElementById('stage').dataset.frames || 0)";
    let before = page.evaluate(frames).await;
    page.key("ArrowLeft").await;
    page.until(frames, |now| now.as_f64() > before.as_f64()).await;
}

const LINE: &str = "document.getElementById('line').textContent";

const PICTURE: &str = "document.getElementById('stage').dataset.picture";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_of_a_slow_service_stay_large_and_those_it_refuses_come_later() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let url = format!("http://{}{job}/viewer", server.address);
    let mut page = Page::open_after(program, &NO_GPU, SLOW, &url).await;
    page.resize(1000, 700).await;
    page.until(SHOWN, |shown| *shown == "service").await;
    page.until("window.widths.includes(1000)", |asked| *asked == true).await;
    page.until(PICTURE, |picture| *picture == "full").await;
    page.evaluate("window.widths.length = 0; document.getElementById('stage').focus()").await;
    for _ in 0..12 {
        turn(&mut page).await;
    }
    let narrowest = page.evaluate("Math.min(...window.widths)").await;
    assert!(narrowest.as_f64() >= Some(400.0), "{narrowest}");

    // The picture in motion and that at rest, each once.
    page.evaluate("window.status = 503; window.refusals = 2").await;
    page.key("ArrowLeft").await;
    page.until("window.refusals", |left| *left == 0).await;
    page.until(PICTURE, |picture| *picture == "full").await;

    let well =
        |line: &serde_json::Value| line.as_str().is_some_and(|line| line.ends_with("draws the pictures."));
    page.evaluate("window.status = 502; window.refusals = 2").await;
    page.key("ArrowLeft").await;
    page.until(LINE, |line| *line == "The service answered 502.").await;
    page.until("window.refusals", |left| *left == 0).await;
    turn(&mut page).await;
    page.until(LINE, well).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_fault_of_the_device_the_service_draws() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let url = format!("http://{}{job}/viewer", server.address);
    let mut page = Page::open_after(program, &NO_GPU, WORKER, &url).await;
    page.until(SHOWN, |shown| *shown == "webgpu").await;
    page.evaluate("document.getElementById('stage').focus()").await;
    let large = GpuError::BufferTooLarge { label: "keys".to_owned(), bytes: 5, limit: 4 }.to_string();
    page.evaluate(&format!("window.fault = {}", json!(large))).await;
    page.key("ArrowLeft").await;
    page.until(LINE, |line| *line == large.as_str()).await;
    page.evaluate("window.fault = null").await;
    turn(&mut page).await;
    assert_eq!(page.evaluate(SHOWN).await, "webgpu", "another view may need less");

    page.evaluate("document.getElementById('depth').click()").await;
    page.until("document.getElementById('overlay').hidden", |hidden| *hidden == false).await;
    let lost = GpuError::DeviceLost("as the test wants it".to_owned()).to_string();
    page.evaluate(&format!("window.fault = {}; document.getElementById('stage').focus()", json!(lost))).await;
    page.key("ArrowLeft").await;
    page.until(SHOWN, |shown| *shown == "service").await;
    let well = format!("{lost}. The service draws the pictures.");
    page.until(LINE, |line| *line == well.as_str()).await;
    let hidden = "['canvas', 'overlay', 'depth'].every(id => document.getElementById(id).hidden)";
    assert_eq!(page.evaluate(hidden).await, true);
    // The start of a JPEG in base64.
    assert!(page.evaluate(SAVED).await.as_str().is_some_and(|saved| saved.starts_with("/9j/")));
    assert_eq!(page.evaluate("window.terminated").await, 1, "nothing more is asked of it");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_in_the_address_is_in_no_request_and_a_first_fault_leads_to_the_service() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::JobsWrite]).await.key;
    let created = server.send("POST", "/v1/jobs", |request| {
        request.bearer_auth(&key).header("content-type", "application/zip").body("succeed")
    });
    let job = created.await.expect(201).header("location").to_owned();
    eventually("the job has succeeded", async || {
        let answer = server.send("GET", &job, |request| request.bearer_auth(&key)).await;
        answer.json()["state"] == "succeeded"
    })
    .await;
    let url = format!("http://me:{key}@{}{job}/viewer", server.address);
    let large = GpuError::BufferTooLarge { label: "keys".to_owned(), bytes: 5, limit: 4 }.to_string();
    let script = format!("{WORKER} window.fault = {};", json!(large));
    let mut page = Page::open_after(program, &NO_GPU, &script, &url).await;
    page.until(SHOWN, |shown| *shown == "service").await;
    page.until(PICTURE, |picture| *picture == "full").await;
    assert_eq!(page.evaluate("window.started").await, format!("http://{}/viewer/worker.js", server.address));
    let well = format!("{large}. The service draws the pictures.");
    assert_eq!(page.evaluate(LINE).await, well);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_report_follows_its_job_while_it_is_seen_and_as_long_as_it_may() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.create("wait").await;
    server.reaches(&job, "running").await;
    let url = format!("http://{}{job}/report", server.address);
    let mut page = Page::open_after(program, &NO_GPU, FOLLOWING, &url).await;
    page.until(STREAMS, |streams| *streams == 1).await;
    page.until("window.heard", |heard| *heard == true).await;
    page.evaluate(&visibility("hidden")).await;
    assert_eq!(page.evaluate(STREAMS).await, 0);
    page.evaluate(&visibility("visible")).await;
    assert_eq!(page.evaluate(STREAMS).await, 1);
    let address = page.evaluate("window.sources.at(-1).url").await;
    assert!(address.as_str().is_some_and(|url| url.contains("/events?after=")), "{address}");

    page.evaluate("window.answer = 0").await;
    page.until(TOLD, |told| *told == SILENT).await;
    page.evaluate("window.answer = null").await;
    page.until(TOLD, |told| *told == "").await;
    // Reloaded, the page says what the service says.
    let loads = page.evaluate(LOADS).await;
    page.evaluate("window.answer = 404").await;
    page.until(LOADS, |now| *now != loads).await;
    server.post(&format!("{job}/cancel")).await.expect(202);
    server.reaches(&job, "cancelled").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_list_follows_its_jobs_while_it_is_seen() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let url = format!("http://{}/", server.address);
    let mut page = Page::open_after(program, &NO_GPU, FOLLOWING, &url).await;
    page.until(STREAMS, |streams| *streams == 1).await;
    page.evaluate(&visibility("hidden")).await;
    assert_eq!(page.evaluate(STREAMS).await, 0);
    server.succeeded().await;
    page.evaluate(&visibility("visible")).await;
    assert_eq!(page.evaluate(STREAMS).await, 1);
    page.until(STATES, |states| *states == "succeeded").await;

    page.evaluate("window.answer = 0; page.refresh()").await;
    page.until(TOLD, |told| *told == SILENT).await;
    page.evaluate("window.answer = null").await;
    page.until("page.refresh(), document.getElementById('told').textContent", |told| *told == "").await;
}

/// Holds parts of uploads until `release` is called, or with `silent` answers none and lets no second pass.
const SENDING: &str = "{
    const quick = window.fetch.bind(window);
    const timer = window.setTimeout.bind(window);
    Object.assign(window, { parts: 0, silent: false, release: null });
    window.setTimeout = (done, ms, ...more) => (window.silent && ms >= 1000 ? 0 : timer(done, ms, ...more));
    window.fetch = async (address, options = {}) => {
        if (options.method !== 'PATCH') return quick(address, options);
        window.parts += 1;
        if (window.silent) throw new TypeError('silent');
        await new Promise(done => { window.release = done; });
        return quick(address, options);
    };
}";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_ends_with_its_file_and_at_once_when_it_is_stopped() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, [7; 100_000]).expect("written");
        path
    };
    let mut page = Page::open_after(program, &NO_GPU, SENDING, &format!("http://{}/", server.address)).await;
    let is_open = "document.querySelector('#drop')?.hidden === false";
    page.until(is_open, |open| *open == true).await;

    let path = write("gone.zip");
    choose(&mut page, "#files", &[&path]).await;
    page.until("window.release !== null", |held| *held == true).await;
    std::fs::remove_file(&path).expect("removed");
    page.evaluate("window.release()").await;
    let trouble = "document.getElementById('trouble').textContent";
    page.until(trouble, |text| *text == "A file cannot be read any more; choose the files again.").await;
    assert_eq!(page.evaluate(is_open).await, true);

    let photographs = ["a.jpg", "b.jpg"].map(write);
    page.evaluate("window.silent = true; window.parts = 0").await;
    choose(&mut page, "#files", &photographs.each_ref().map(Path::new)).await;
    page.until("window.parts", |parts| *parts == 1).await;
    page.evaluate("document.getElementById('stop').click()").await;
    page.until(is_open, |open| *open == true).await;
    assert_eq!(page.evaluate(trouble).await, "");
}
