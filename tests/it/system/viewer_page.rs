//! The page that shows a scene, in a real browser: it decodes the file and draws it as this machine does, and without WebGPU the service
//! draws. Chromium has WebGPU here by SwiftShader, on the processor.

use std::fs;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use glam::DVec3;
use serde_json::{Value, json};
use tcgs::{codec, viewer_page::assets};

use crate::support::{
    browser::{self, Page},
    contract::Coverage,
    program,
    server::{Server, picture},
    skip::skip,
};

/// WebGPU without a GPU, and a compositor that takes its pictures.
pub(super) const WEBGPU: [&str; 8] = [
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-vulkan-surface",
];

/// How the page shows the scene, once it has; its last line if it cannot.
pub(super) const SHOWN: &str = "(() => {
    const stage = document.getElementById('stage');
    return stage && stage.dataset.frames ? stage.dataset.mode : null;
})()";

/// The picture that a press of the button saves, as a PNG in base64.
pub(super) const SAVED: &str = "(async () => {
    const saved = new Promise(done => {
        const address = URL.createObjectURL;
        URL.createObjectURL = blob => { done(blob); return address.call(URL, blob); };
        HTMLAnchorElement.prototype.click = () => {};
    });
    document.getElementById('shot').click();
    const bytes = new Uint8Array(await (await saved).arrayBuffer());
    return btoa(bytes.reduce((text, byte) => text + String.fromCharCode(byte), ''));
})()";

/// The camera of the page's first stop for a picture of its size.
pub(super) const CAMERA: &str = "(() => {
    const stop = JSON.parse(document.getElementById('scene').textContent).stops[0];
    const { clientWidth: width, clientHeight: height } = document.getElementById('stage');
    const scale = Math.min(width / stop.width, height / stop.height);
    return JSON.stringify({
        camera_to_world: stop.camera_to_world, fx: stop.fx * scale, fy: stop.fy * scale,
        cx: width / 2 + (stop.cx - stop.width / 2) * scale, cy: height / 2 + (stop.cy - stop.height / 2) * scale, width, height,
    });
})()";

/// Where the page leads that is shown.
const PATH: &str = "location.pathname";

/// What reaches beyond the width of a phone.
const WIDER_THAN_THE_WINDOW: &str = "[...document.body.querySelectorAll('*')]
    .filter(element => element.getBoundingClientRect().right > 391)
    .map(element => `${element.tagName} of ${element.parentElement.tagName} ${element.parentElement.className}: ${element.textContent.slice(0, 40)}`)";

/// Turns the wheel away from the scene a hundred times.
const WHEEL: &str = "(() => {
    const stage = document.getElementById('stage');
    for (let i = 0; i < 100; i += 1) stage.dispatchEvent(new WheelEvent('wheel', { deltaY: 200, cancelable: true }));
})()";

/// Gives the first stop a photograph, and keeps the page from finding an adapter until `release` is called.
const BESIDE_A_PHOTOGRAPH: &str = "{
    const parse = JSON.parse;
    JSON.parse = (...asked) => {
        const read = parse(...asked);
        if (read && read.stops) read.stops[0].photograph = 'AAAA';
        return read;
    };
    const adapter = new Promise(done => { window.release = () => done(null); });
    Object.defineProperty(navigator, 'gpu', { value: { requestAdapter: () => adapter } });
}";

/// Puts the scene's center behind the first stop's camera.
const LOOKING_OUTWARDS: &str = "{
    const parse = JSON.parse;
    JSON.parse = (...asked) => {
        const read = parse(...asked);
        if (read && read.stops) read.center = read.stops[0].camera_to_world.slice(0, 3).map(row => row[3] - row[2]);
        return read;
    };
}";

/// Whether two elements are in the same place: `a` and `b` are their names.
const IN_ONE_PLACE: &str = "((a, b) => {
    const [one, other] = [a, b].map(id => document.getElementById(id).getBoundingClientRect());
    return ['left', 'top', 'width', 'height'].every(side => Math.abs(one[side] - other[side]) < 0.5);
})";

/// Pixels of a picture of which at most this part may differ by more than one level.
const TOLERATED: f64 = 0.001;

fn tcgs(arguments: &[&str]) {
    let mut command = program::command();
    let output = command.args(arguments).output().expect("the program");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_page_from_a_disk_decodes_and_draws_the_scene_as_this_machine_does() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/trained_v1.tcgs");
    tcgs(&["export", file, "--output", &path("scene.html")]);
    let size = fs::metadata(path("scene.html")).expect("a page").len();
    assert!(size < 3 << 20, "{size} bytes, of which the module in base64 may have two thirds of 3 MiB");

    let mut page = Page::open_with(program, &WEBGPU, &format!("file://{}", path("scene.html"))).await;
    page.resize(256, 192).await;
    page.until(SHOWN, |shown| *shown == "webgpu").await;
    let decoded = codec::decode(&fs::read(file).expect("a file"), &codec::DecodeLimits::default());
    let digest = decoded.expect("a scene").decode_sha256.to_string();
    assert_eq!(page.evaluate("document.getElementById('stage').dataset.digest").await, json!(digest));

    let camera = page.evaluate(CAMERA).await;
    fs::write(path("camera.json"), camera.as_str().expect("a camera")).expect("written");
    tcgs(&["render", file, "--pose", &path("camera.json"), "--output", &path("native.png")]);
    let saved = page.evaluate(SAVED).await;
    let saved = STANDARD.decode(saved.as_str().expect("a picture")).expect("base64");
    let there = picture(&saved).to_rgb8();
    let here = picture(&fs::read(path("native.png")).expect("a PNG")).to_rgb8();
    assert_eq!(there.dimensions(), here.dimensions());
    let far =
        |(a, b): &(&image::Rgb<u8>, &image::Rgb<u8>)| a.0.iter().zip(b.0).any(|(a, b)| a.abs_diff(b) > 1);
    let different = there.pixels().zip(here.pixels()).filter(far).count() as f64;
    let pixels = f64::from(here.width() * here.height());
    assert!(different <= TOLERATED * pixels, "{different} of {pixels} pixels differ");
    let background = here.get_pixel(0, 0);
    assert!(here.pixels().any(|pixel| pixel != background), "the scene is in the picture");

    // It turns, and shows depths.
    let frames = page.evaluate("Number(document.getElementById('stage').dataset.frames)").await;
    page.evaluate("document.getElementById('stage').focus()").await;
    page.key("ArrowLeft").await;
    let more = |now: &Value| now.as_f64() > frames.as_f64();
    page.until("Number(document.getElementById('stage').dataset.frames)", more).await;
    page.evaluate("document.getElementById('depth').click()").await;
    page.until("document.getElementById('line').textContent.includes('depths')", |told| *told == true).await;
    assert_eq!(page.faults, Vec::<String>::new());
    let requests: Vec<_> = page.requests.iter().filter(|url| url.starts_with("http")).collect();
    assert!(requests.is_empty(), "{requests:?}");
}

/// The last view that the page asks the service for once it rests.
async fn settled_view(page: &mut Page) -> reqwest::Url {
    page.until("document.getElementById('stage').dataset.picture", |picture| *picture == "full").await;
    let of = |url: &String| reqwest::Url::parse(url).ok().filter(|url| url.path().ends_with("/view"));
    page.requests.iter().rev().find_map(of).expect("a view was asked for")
}

/// The numbers of a parameter.
fn vector(url: &reqwest::Url, name: &str) -> DVec3 {
    let (_, text) = url.query_pairs().find(|(found, _)| found == name).expect(name);
    let numbers: Vec<f64> = text.split(',').map(|number| number.parse().expect("a number")).collect();
    DVec3::from_slice(&numbers)
}

/// The camera's distance from what it looks at in that view.
async fn settled_distance(page: &mut Page) -> f64 {
    let view = settled_view(page).await;
    vector(&view, "position").distance(vector(&view, "look_at"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_webgpu_the_service_draws_the_page_s_pictures() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}{job}/viewer", server.address)).await;
    page.until(SHOWN, |shown| *shown == "service").await;
    let line = "document.getElementById('line').textContent";
    page.until(line, |told| {
        told.as_str().is_some_and(|told| told.ends_with("The service draws the pictures."))
    })
    .await;

    let source = "document.getElementById('picture').src";
    let before = page.evaluate(source).await;
    page.mouse("mousePressed", 200.0, 300.0).await;
    for step in 1..=5 {
        page.mouse("mouseMoved", 200.0 + 12.0 * f64::from(step), 300.0 + 3.0 * f64::from(step)).await;
    }
    page.until(source, |now| *now != before).await;
    // The scene follows to the end: the picture under the mouse is not what is dragged.
    let before = settled_view(&mut page).await;
    for step in 6..=10 {
        page.mouse("mouseMoved", 200.0 + 12.0 * f64::from(step), 300.0 + 3.0 * f64::from(step)).await;
    }
    assert_ne!(settled_view(&mut page).await, before);
    page.mouse("mouseReleased", 320.0, 330.0).await;
    let first = page.evaluate(source).await;
    for (name, by) in [("ArrowLeft", "turned"), ("+", "nearer"), (".", "at the next camera")] {
        let before = page.evaluate(source).await;
        page.evaluate("document.getElementById('stage').focus()").await;
        page.key(name).await;
        page.until(source, |now| *now != before).await;
        assert!(first != page.evaluate(source).await, "{by}");
    }
    // However often the wheel is turned, the scene stays in sight.
    page.evaluate(WHEEL).await;
    let farthest = settled_distance(&mut page).await;
    page.evaluate(WHEEL).await;
    assert!((settled_distance(&mut page).await / farthest - 1.0).abs() < 1e-6, "{farthest}");
    assert_eq!(page.faults, Vec::<String>::new());
    let origin = format!("http://{}", server.address);
    let own = |url: &String| ["data:", "blob:", &origin].iter().any(|begin| url.starts_with(begin));
    assert!(page.requests.iter().all(own), "{:?}", page.requests);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_page_over_http_says_that_webgpu_needs_https() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open_with(program, &WEBGPU, &format!("http://{}{job}/viewer", server.address)).await;
    // As browsers show themselves to a page over http that is not from the same machine.
    let insecure = "Object.defineProperty(window, 'isSecureContext', { value: false }); \
                    Object.defineProperty(Navigator.prototype, 'gpu', { value: undefined });";
    page.ask("Page.addScriptToEvaluateOnNewDocument", json!({ "source": insecure })).await;
    page.ask("Page.reload", json!({})).await;
    let line = "document.getElementById('line')?.textContent";
    page.until(line, |told| *told == "WebGPU needs this page over https. The service draws the pictures.")
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_a_phone_the_page_fits_and_fingers_come_nearer() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}{job}/viewer", server.address)).await;
    page.be_a_phone().await;
    page.until(SHOWN, |shown| *shown == "service").await;
    assert_eq!(page.evaluate(WIDER_THAN_THE_WINDOW).await, Value::Array(Vec::new()));
    let began = settled_distance(&mut page).await;
    // Apart by five times as much as in the beginning.
    page.touch("touchStart", &[(185.0, 400.0), (205.0, 400.0)]).await;
    for step in 1..=8 {
        let apart = 10.0 + 5.0 * f64::from(step);
        page.touch("touchMove", &[(195.0 - apart, 400.0), (195.0 + apart, 400.0)]).await;
    }
    page.touch("touchEnd", &[]).await;
    let ended = settled_distance(&mut page).await;
    assert!((began / ended / 5.0 - 1.0).abs() < 0.05, "from {began} to {ended}");
    assert_eq!(page.faults, Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_report_fits_a_phone_and_its_picture_leads_to_the_viewer() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let mut page = Page::open(program, &format!("http://{}{job}/report", server.address)).await;
    page.be_a_phone().await;
    page.until("Boolean(document.getElementById('viewer'))", |there| *there == true).await;
    // A page that is wider is shown smaller, and fingers are not where they seem to be.
    assert_eq!(page.evaluate(WIDER_THAN_THE_WINDOW).await, Value::Array(Vec::new()));
    page.evaluate("document.getElementById('viewer').click()").await;
    page.until(PATH, |path| *path == format!("{job}/viewer")).await;
    page.until(SHOWN, |shown| *shown == "service").await;
    assert_eq!(page.faults, Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn beside_a_photograph_the_page_shows_its_frame_in_its_place() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    if assets().is_none() {
        return skip("the viewer for browsers was not built: scripts/web.sh does, before the program");
    }
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let url = format!("http://{}{job}/viewer", server.address);
    let mut page = Page::open_after(program, &["--disable-gpu"], BESIDE_A_PHOTOGRAPH, &url).await;
    let is_beside = "document.getElementById('photograph')?.hidden === false";
    page.until(is_beside, |beside| *beside == true).await;
    // Who moves while the page opens stays there.
    page.evaluate("document.getElementById('stage').focus()").await;
    page.key("ArrowLeft").await;
    page.evaluate("window.release()").await;
    page.until(SHOWN, |shown| *shown == "service").await;
    settled_view(&mut page).await;
    assert_eq!(page.evaluate(is_beside).await, false);

    page.key("0").await;
    let view = settled_view(&mut page).await;
    assert!(view.query_pairs().any(|(name, value)| name == "frame" && value == "test/r_0"), "{view}");
    assert_eq!(page.evaluate(is_beside).await, true);
    assert_eq!(page.evaluate(&format!("{IN_ONE_PLACE}('picture', 'photograph')")).await, true);
    // The slider's keys move the slider.
    page.evaluate("document.getElementById('wipe').focus()").await;
    page.key("ArrowRight").await;
    page.until("document.getElementById('wipe').value", |value| *value == "51").await;
    assert_eq!(page.evaluate(is_beside).await, true);

    page.evaluate("document.getElementById('stage').focus()").await;
    page.key("ArrowRight").await;
    let view = settled_view(&mut page).await;
    assert!(view.query_pairs().any(|(name, _)| name == "position"), "{view}");
    assert_eq!(page.evaluate(&format!("{IN_ONE_PLACE}('picture', 'stage')")).await, true);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_drag_puts_the_camera_on_its_head_and_outward_cameras_come_nearer() {
    let Some(program) = browser::find() else { return skip("Chromium is not installed") };
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let url = format!("http://{}{job}/viewer", server.address);
    let mut page = Page::open_after(program, &["--disable-gpu"], LOOKING_OUTWARDS, &url).await;
    page.resize(800, 600).await;
    page.until(SHOWN, |shown| *shown == "service").await;
    let began = settled_distance(&mut page).await;
    let wheel = "document.getElementById('stage').dispatchEvent(new WheelEvent('wheel', { deltaY: -500, cancelable: true }))";
    page.evaluate(wheel).await;
    let ended = settled_distance(&mut page).await;
    assert!(ended < 0.7 * began, "from {began} to {ended}");

    let up = page.evaluate("JSON.parse(document.getElementById('scene').textContent).up.join()").await;
    let up: Vec<f64> = up.as_str().expect("text").split(',').map(|v| v.parse().expect("a number")).collect();
    // Each by 1.5 rad in one event: from any camera, one of them leads over a pole.
    for (from, to) in [(100.0, 500.0), (500.0, 100.0), (500.0, 100.0)] {
        page.mouse("mousePressed", 400.0, from).await;
        page.mouse("mouseMoved", 401.0, to).await;
        page.mouse("mouseReleased", 401.0, to).await;
        let view = settled_view(&mut page).await;
        assert!(vector(&view, "up").dot(DVec3::from_slice(&up)) > 0.0, "{view}");
    }
}
