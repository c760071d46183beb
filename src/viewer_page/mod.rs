//! The page that shows a scene in a browser: served by a service, or complete in one file that opens from a disk.
//!
//! What always holds: the page requests nothing from other hosts; every text is escaped; its content security policy allows its own
//! script and style by their hashes, WebAssembly, and nothing else that runs.

mod assets;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use glam::DVec3;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde::Serialize;

pub use assets::{Assets, assets};

use crate::domain::{Camera, CameraView, Digest};

const SCRIPT: &str = include_str!("page.js");
const STYLE: &str = include_str!("page.css");

/// A camera that the page stops at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Stop {
    /// The frame's name.
    pub name: String,
    #[serde(flatten)]
    view: CameraView,
    /// A JPEG in base64 of the camera's field of view, if there is one.
    photograph: Option<String>,
}

impl Stop {
    /// The stop at a camera.
    #[must_use]
    pub fn new(name: String, camera: &Camera, photograph: Option<String>) -> Self {
        Self { name, view: CameraView::from(camera), photograph }
    }

    /// Whether it shows a photograph.
    #[must_use]
    pub fn has_photograph(&self) -> bool {
        self.photograph.is_some()
    }
}

/// What a page shows, and from where.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewerScene {
    /// The page's title.
    pub title: String,
    /// At least one.
    pub stops: Vec<Stop>,
    /// The point that the scene turns about.
    pub center: DVec3,
    /// What is up there.
    pub up: DVec3,
    /// Where a page of a service has everything.
    #[serde(flatten)]
    pub links: Option<Links>,
}

/// Addresses, relative to the page's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Links {
    /// The `.tcgs` file; none if the scene has none that the module reads.
    pub file: Option<FileLink>,
    /// Why there is no file; a sentence.
    pub why: Option<String>,
    /// The module.
    pub module: String,
    /// Its worker's script.
    pub worker: String,
    /// Views by the service.
    pub view: String,
    /// The job's report; none where it cannot be opened.
    pub report: Option<String>,
}

/// A file to show.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FileLink {
    /// Its address.
    pub href: String,
    /// Its size.
    pub bytes: u64,
}

/// The page of a service.
#[must_use]
pub fn served(scene: &ViewerScene) -> Markup {
    page(scene, None, &html! {})
}

/// A complete page that shows `file`, a `.tcgs` file.
#[must_use]
pub fn complete(scene: &ViewerScene, assets: Assets, file: &[u8]) -> String {
    let parts = html! {
        script #module type="text/plain" data-gzip="yes" { (PreEscaped(STANDARD.encode(assets.module))) }
        script #file type="text/plain" { (PreEscaped(STANDARD.encode(file))) }
        script #worker type="text/plain" { (PreEscaped(in_script(assets.worker))) }
    };
    page(scene, Some(&policy("blob:")), &parts).into_string()
}

/// The content security policy of a page of a service.
#[must_use]
pub fn served_policy() -> String {
    format!("{}; connect-src 'self'; frame-ancestors 'none'", policy("'self' blob:"))
}

/// A script or style as a content security policy names it.
#[must_use]
pub fn source_of(text: &str) -> String {
    format!("'sha256-{}'", STANDARD.encode(Digest::of(text.as_bytes()).as_bytes()))
}

/// What every page allows, with workers from `workers`.
fn policy(workers: &str) -> String {
    format!(
        "default-src 'none'; script-src {} 'wasm-unsafe-eval'; style-src {}; img-src 'self' data: blob:; worker-src {workers}; \
         base-uri 'none'; form-action 'none'",
        source_of(SCRIPT),
        source_of(STYLE)
    )
}

/// A script within a `script` element, which would end at its end tag and not at an escaped one.
fn in_script(text: &str) -> String {
    text.replace("</", "<\\/").replace("<!--", "<\\!--")
}

/// JSON within a `script` element. Only texts of it have the sign, and `\!` is no escape in them.
fn data_in_script(json: &str) -> String {
    json.replace('<', "\\u003c")
}

fn page(scene: &ViewerScene, policy: Option<&str>, parts: &Markup) -> Markup {
    let data = serde_json::to_string(scene).unwrap_or_default();
    let links = scene.links.as_ref();
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1, viewport-fit=cover";
                @if let Some(policy) = policy { meta http-equiv="Content-Security-Policy" content=(policy); }
                // Or browsers would ask for one.
                link rel="icon" href="data:,";
                title { (scene.title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main #stage tabindex="0" aria-label="The scene; drag or use the arrow keys to turn it" {
                    canvas #canvas {}
                    img #picture alt="The scene from the chosen place" draggable="false" hidden;
                    canvas #overlay hidden {}
                    img #photograph alt="The photograph" hidden;
                    input #wipe type="range" min="0" max="100" value="50" aria-label="Photograph beside the scene" hidden;
                }
                header {
                    h1 { (scene.title) }
                    p #line role="status" { "This page needs scripts." }
                }
                progress #loading aria-label="Loading" {}
                nav aria-label="Viewer" {
                    button #previous type="button" aria-label="Previous camera" { "‹" }
                    select #stops aria-label="Camera" {}
                    button #next type="button" aria-label="Next camera" { "›" }
                    button #again type="button" title="0" { "Reset" }
                    button #fly type="button" aria-pressed="false" title="W A S D, Q and E move; drag looks around" { "Fly" }
                    button #depth type="button" aria-pressed="false" hidden { "Depth" }
                    button #shot type="button" { "Save picture" }
                    button #full type="button" { "Full screen" }
                    @if let Some(links) = links {
                        @if let Some(report) = &links.report { a href=(report) { "Report" } }
                        @if let Some(file) = &links.file { a href=(file.href) download { "Download" } }
                    }
                }
                script #scene type="application/json" { (PreEscaped(data_in_script(&data))) }
                (parts)
                script { (PreEscaped(SCRIPT)) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::domain::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn any_text_of_a_scene_survives_the_page() {
        let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 20.0, cy: 15.0, width: 40, height: 30 };
        let pose = Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z).expect("a pose");
        let camera = Camera::new(intrinsics, pose).expect("a camera");
        let name = "<!-- <script> </script> --> <\\ & \" '";
        let scene = ViewerScene {
            title: name.to_owned(),
            stops: vec![Stop::new(name.to_owned(), &camera, None)],
            center: DVec3::ZERO,
            up: DVec3::Z,
            links: None,
        };
        let page = served(&scene).into_string();
        let begin = "<script id=\"scene\" type=\"application/json\">";
        let data = page.split(begin).nth(1).and_then(|rest| rest.split("</script>").next()).expect("data");
        assert!(!data.contains('<'), "{data}");
        let read: serde_json::Value = serde_json::from_str(data).expect("JSON");
        assert_eq!(read["title"], name);
        assert_eq!(read["stops"][0]["name"], name);
    }
}
