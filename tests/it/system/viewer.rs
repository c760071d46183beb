//! The report's viewer in a real browser: it draws the scene, turns it when the pointer drags it, and breaks no rule of its page's
//! policy.

use serde_json::Value;

use crate::support::{
    browser::{self, Page},
    contract::Coverage,
    server::Server,
    skip::skip,
};

/// The picture that is shown, as pixels; null while there is none that the viewer has drawn.
const PIXELS: &str = "(() => {
    const picture = document.querySelector('#viewer img');
    if (!picture || !picture.src.startsWith('blob:') || !picture.complete || !picture.naturalWidth) return null;
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [picture.naturalWidth, picture.naturalHeight];
    const context = canvas.getContext('2d');
    context.drawImage(picture, 0, 0);
    return [picture.naturalWidth, ...context.getImageData(0, 0, 8, 1).data].join();
})()";

/// Where the picture's middle is in the window.
const MIDDLE: &str = "(() => {
    const picture = document.querySelector('#viewer img');
    picture.scrollIntoView({ block: 'center' });
    const { x, y, width, height } = picture.getBoundingClientRect();
    return [x + width / 2, y + height / 2];
})()";

/// What reaches beyond the width of a phone.
const WIDER_THAN_THE_WINDOW: &str = "[...document.body.querySelectorAll('*')]
    .filter(element => element.getBoundingClientRect().right > 390)
    .map(element => `${element.tagName} of ${element.parentElement.tagName} ${element.parentElement.className}: ${element.textContent.slice(0, 40)}`)";

/// The width of pictures at rest.
const FULL: &str = "640,";

fn is_full_and_not(value: &Value, other: &Value) -> bool {
    value != other && value.as_str().is_some_and(|pixels| pixels.starts_with(FULL))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_viewer_of_a_report_turns_the_scene() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}{job}/report", server.address)).await;
    let first = page.until(PIXELS, |pixels| is_full_and_not(pixels, &Value::Null)).await;

    let middle = page.evaluate(MIDDLE).await;
    let (x, y) = (middle[0].as_f64().expect("a place"), middle[1].as_f64().expect("a place"));
    page.mouse("mousePressed", x, y).await;
    for step in 1..=5 {
        page.mouse("mouseMoved", x + 12.0 * f64::from(step), y + 3.0 * f64::from(step)).await;
    }
    // While it moves, pictures are small.
    let moving =
        |pixels: &Value| pixels.as_str().is_some_and(|pixels| !pixels.starts_with(FULL)) && *pixels != first;
    page.until(PIXELS, moving).await;
    page.mouse("mouseReleased", x + 60.0, y + 15.0).await;
    let dragged = page.until(PIXELS, |pixels| is_full_and_not(pixels, &first)).await;
    let still = "document.querySelector('#viewer figcaption').textContent";
    page.until(still, |told| told.as_str().is_some_and(|told| told.starts_with("640 pixels wide"))).await;

    page.evaluate("document.getElementById('viewer').focus()").await;
    page.key("ArrowLeft").await;
    let turned = page.until(PIXELS, |pixels| is_full_and_not(pixels, &dragged)).await;
    assert!(turned != first);
    // Back to where it began, and to the picture that was there.
    page.key("0").await;
    page.until(PIXELS, |pixels| *pixels == first).await;

    assert_eq!(page.faults, Vec::<String>::new());
    let origin = format!("http://{}", server.address);
    let own = |url: &String| ["data:", "blob:", &origin].iter().any(|begin| url.starts_with(begin));
    assert!(page.requests.iter().all(own), "{:?}", page.requests);
    let views = page.requests.iter().filter(|url| url.contains(&format!("{job}/view?")));
    assert!(views.count() >= 4, "{:?}", page.requests);
}

/// The camera's distance from its target in each view that the page has asked for.
fn distances(page: &Page) -> Vec<f64> {
    let of = |url: &String| {
        let url = reqwest::Url::parse(url).ok().filter(|url| url.path().ends_with("/view"))?;
        let vector = |name: &str| -> Option<Vec<f64>> {
            let (_, text) = url.query_pairs().find(|(found, _)| found == name)?;
            text.split(',').map(|number| number.parse().ok()).collect()
        };
        let (from, to) = (vector("position")?, vector("look_at")?);
        Some(from.iter().zip(&to).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt())
    };
    page.requests.iter().filter_map(of).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fingers_pinch_the_viewer_and_scroll_its_page() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}{job}/report", server.address)).await;
    page.be_a_phone().await;
    let first = page.until(PIXELS, |pixels| is_full_and_not(pixels, &Value::Null)).await;
    // A page that is wider is shown smaller, and fingers are not where they seem to be.
    let wide = page.evaluate(WIDER_THAN_THE_WINDOW).await;
    assert_eq!(wide, Value::Array(Vec::new()));
    let middle = page.evaluate(MIDDLE).await;
    let (x, y) = (middle[0].as_f64().expect("a place"), middle[1].as_f64().expect("a place"));

    // Apart by five times as much as in the beginning.
    page.touch("touchStart", &[(x - 10.0, y), (x + 10.0, y)]).await;
    for step in 1..=8 {
        let apart = 10.0 + 5.0 * f64::from(step);
        page.touch("touchMove", &[(x - apart, y), (x + apart, y)]).await;
    }
    page.touch("touchEnd", &[]).await;
    page.until(PIXELS, |pixels| is_full_and_not(pixels, &first)).await;
    let distances = distances(&page);
    let (began, ended) = (distances[0], *distances.last().expect("views"));
    assert!((began / ended / 5.0 - 1.0).abs() < 0.05, "{distances:?}");

    // A finger that goes up on the picture scrolls the page.
    let scrolled = "Math.round(window.scrollY)";
    let before = page.evaluate(scrolled).await.as_f64().expect("a number");
    page.touch("touchStart", &[(x, y)]).await;
    for step in 1..=10 {
        page.touch("touchMove", &[(x, y - 15.0 * f64::from(step))]).await;
    }
    page.touch("touchEnd", &[]).await;
    page.until(scrolled, |now| now.as_f64().is_some_and(|now| now > before + 50.0)).await;
    assert_eq!(page.faults, Vec::<String>::new());
}
