//! Pages in a real browser when something goes wrong: a service that is slow or silent, a lost device, hidden pages, and files that are
//! gone.

use super::viewer_page::SHOWN;
use crate::support::{
    browser::{self, Page},
    contract::Coverage,
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
