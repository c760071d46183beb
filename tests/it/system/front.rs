//! The page for browsers in a real one: files become a dataset, a job and a scene, and the list follows.

use std::path::Path;

use serde_json::{Value, json};
use tcgs::{domain::MaskSource, store::JobFilter};

use crate::support::{
    browser::{self, Page},
    contract::Coverage,
    server::Server,
    skip::skip,
};

/// The states of the cards, the newest first.
pub(super) const STATES: &str =
    "[...document.querySelectorAll('.job')].map(card => card.dataset.state).join()";

/// Gives files to an input of the page, as a user does who chooses them.
pub(super) async fn choose(page: &mut Page, input: &str, files: &[&Path]) {
    page.ask("DOM.enable", json!({})).await;
    let document = page.ask("DOM.getDocument", json!({})).await;
    let at = json!({ "nodeId": document["root"]["nodeId"], "selector": input });
    let node = page.ask("DOM.querySelector", at).await;
    page.ask("DOM.setFileInputFiles", json!({ "nodeId": node["nodeId"], "files": files })).await;
}

/// Waits for the estimates, and trains.
async fn train(page: &mut Page) {
    let told = "[...document.querySelectorAll('#train output')].filter(told => told.textContent.includes(' steps, ')).length";
    page.until("document.querySelector('#train').hidden", |hidden| *hidden == false).await;
    page.until(told, |count| *count == 3).await;
    page.evaluate("document.querySelector('#train button').click()").await;
    page.until("document.querySelector('#train').hidden", |hidden| *hidden == true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn files_that_are_chosen_become_scenes_and_the_list_follows() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).expect("written");
        path
    };
    let mut page = Page::open(program, &format!("http://{}/", server.address)).await;
    page.until("document.querySelector('#drop')?.hidden === false", |shown| *shown == true).await;

    // An archive goes as it is.
    choose(&mut page, "#files", &[&write("kermit.zip", b"succeed")]).await;
    train(&mut page).await;
    page.until(STATES, |states| *states == "succeeded").await;
    let card = "document.querySelector('.job').textContent";
    page.until(card, |text| {
        text.as_str().is_some_and(|text| text.contains("kermit") && text.contains("30.00 dB"))
    })
    .await;

    // Photographs become one.
    let photographs =
        [write("b.jpg", b"the second"), write("a.jpg", b"the first"), write(".hidden", b"no photograph")];
    choose(&mut page, "#files", &photographs.each_ref().map(|path| path.as_path())).await;
    train(&mut page).await;
    page.until(STATES, |states| *states == "succeeded,succeeded").await;
    let jobs = server.store.jobs(&JobFilter::default(), None, 1).await.expect("read");
    let archive = server.services.blobs.read(jobs[0].dataset.digest).await.expect("read");
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(archive)).expect("a zip");
    let names: Vec<String> = archive.file_names().map(|name| name.expect("UTF-8").into_owned()).collect();
    assert_eq!(names, ["a.jpg", "b.jpg"]);
    let mut first = String::new();
    std::io::Read::read_to_string(&mut archive.by_name("a.jpg").expect("there"), &mut first).expect("whole");
    assert_eq!(first, "the first");

    // What is refused for its masks is read without them, and trained so.
    let astray = write("astray.zip", b"succeed with astray masks");
    choose(&mut page, "#files", &[&astray]).await;
    page.until("document.querySelector('#trouble').textContent", |text| {
        text.as_str().is_some_and(|text| text.contains("masks=none"))
    })
    .await;
    page.faults.retain(|fault| !fault.contains("422"));
    page.evaluate("document.querySelector('#unmasked').click()").await;
    choose(&mut page, "#files", &[&astray]).await;
    train(&mut page).await;
    page.until(STATES, |states| *states == "succeeded,succeeded,succeeded").await;
    let jobs = server.store.jobs(&JobFilter::default(), None, 1).await.expect("read");
    assert_eq!(jobs[0].job.options.masks, MaskSource::None);
    let unmasked = format!("/v1/jobs/{}", jobs[0].job.id);
    server.send("DELETE", &unmasked, |request| request).await.expect(204);
    page.until(STATES, |states| *states == "succeeded,succeeded").await;

    // What others do is seen, and what is running is cancelled here.
    let running = server.create("wait").await;
    page.until(STATES, |states| *states == "running,succeeded,succeeded").await;
    page.until("document.querySelectorAll('.job')[0].querySelectorAll('img').length", |count| *count == 1)
        .await;
    page.evaluate("document.querySelector('[data-act=cancel]').click()").await;
    server.reaches(&running, "cancelled").await;
    page.until(STATES, |states| *states == "cancelled,succeeded,succeeded").await;
    page.evaluate("window.confirm = () => true; document.querySelector('[data-act=delete]').click()").await;
    page.until(STATES, |states| *states == "succeeded,succeeded").await;
    server.get(&running).await.expect(404);

    // There is no picture of a job that has just begun.
    page.faults.retain(|fault| !fault.contains("/preview"));
    assert_eq!(page.faults, Vec::<String>::new());
    let origin = format!("http://{}", server.address);
    let own = |url: &String| ["data:", "blob:", &origin].iter().any(|begin| url.starts_with(begin));
    assert!(page.requests.iter().all(own), "{:?}", page.requests);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_ends_before_its_card_arrives_is_shown_as_ended() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let mut page = Page::open(program, &format!("http://{}/", server.address)).await;
    page.until("typeof page === 'object' && typeof page.refresh", |kind| *kind == "function").await;
    // The page with the new card is read from the service at once, and comes late.
    let slow = "window.release = null; window.ended = false; const quick = window.fetch; \
                window.fetch = async (...asked) => { \
                  const answer = await quick(...asked); const text = await answer.clone().text(); \
                  if (!window.release && text.includes('data-job')) await new Promise(done => window.release = done); \
                  return answer; }; \
                new EventSource('v1/jobs').addEventListener('job', event => { \
                  window.ended ||= JSON.parse(event.data).state === 'succeeded'; }); true";
    page.evaluate(slow).await;
    let job = server.create("gate").await;
    page.until("window.release !== null", |held| *held == true).await;
    server.runner.gate.open();
    server.reaches(&job, "succeeded").await;
    page.until("window.ended", |ended| *ended == true).await;
    page.evaluate("new Promise(done => setTimeout(done, 1000))").await;
    page.evaluate("window.release()").await;
    page.until(STATES, |states| *states == "succeeded").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_fits_a_phone() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}/", server.address)).await;
    page.be_a_phone().await;
    page.until(STATES, |states| *states == "succeeded").await;
    let wide = "[...document.body.querySelectorAll('*')].filter(element => element.getBoundingClientRect().right > 390).length";
    assert_eq!(page.evaluate(wide).await, Value::from(0));
}
