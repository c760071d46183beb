//! The whole page: the job's state, a picture that leads to the viewer, then curves, sizes, views and settings.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{
    bars::bars,
    curves::curves,
    history::History,
    pictures::pictures,
    settings::settings,
    stages::stages,
    standing::standing,
    units::{bytes, duration, figure, grouped, size},
};
use crate::{
    domain::{HeldOut, HeldOutView, Job, JobMetrics, SceneFormat},
    http::auth::shared_link::OptionalLink,
    store::JobRecord,
};

/// The page's only style; the policy that it is served under names its hash.
pub(super) const STYLE: &str = include_str!("style.css");

/// The script of a page, which has one or none; the policy that it is served under names its hash.
pub(super) fn script(job: &Job) -> Option<&'static str> {
    if job.metrics.is_some() {
        Some(SHARE)
    } else if job.state.is_terminal() {
        None
    } else {
        Some(LIVE)
    }
}

const SHARE: &str = include_str!("share.js");
const LIVE: &str = include_str!("live.js");

/// What the page is made from.
#[derive(Debug)]
pub(super) struct Page {
    pub(super) record: JobRecord,
    pub(super) history: History,
    pub(super) held_out: Option<HeldOut>,
    /// Whether the job kept the cameras that the viewer begins with.
    pub(super) has_cameras: bool,
    /// The shared link that it is shown by.
    pub(super) link: OptionalLink,
}

impl Page {
    pub(super) fn html(&self) -> Markup {
        let job = &self.record.job;
        html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    // Or browsers would ask the service for one.
                    link rel="icon" href="data:,";
                    title { @match &self.record.name { Some(name) => { (name) " - tcgs" }, None => { "tcgs job " (job.id) } } }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    header {
                        // From the report of a job to the page of all.
                        @if !self.is_shared() { nav { a href="../../../" { "All scenes" } } }
                        h1 {
                            @match &self.record.name {
                                Some(name) => (name),
                                None => { "Report of a " (job.options.model.to_string()) " scene" },
                            }
                        }
                        p {
                            span #state.{"state " (job.state.name())} { (job.state.name()) } " job " code { (job.id) }
                            @for (key, value) in self.record.metadata.iter() { " " span.label { (key) ": " (value) } }
                        }
                        (self.downloads())
                        @if !self.is_shared() && job.metrics.is_some() {
                            p { button #share type="button" hidden { "Share this page" } " " span #shared.none role="status" {} }
                        }
                    }
                    main { (self.sections()) }
                    footer { p { "Made by tcgs " (env!("CARGO_PKG_VERSION")) ". Every figure is of the decoded file unless it says otherwise." } }
                    @if let Some(script) = script(job) { script { (PreEscaped(script)) } }
                }
            }
        }
    }

    fn sections(&self) -> Markup {
        let job = &self.record.job;
        html! {
            @match &job.metrics {
                Some(metrics) => {
                    section.top {
                        (self.viewer())
                        (summary(metrics))
                    }
                    (curves(&self.record, &self.history))
                    (bars(&metrics.bytes, metrics.anchors, metrics.gaussians))
                    (stages(metrics))
                    (pictures(&metrics.test, self.held_out.as_ref()))
                }
                None => {
                    (standing(&self.record, self.is_shared()))
                    (curves(&self.record, &self.history))
                }
            }
            (settings(&self.record))
        }
    }

    fn is_shared(&self) -> bool {
        self.link.prefix.is_some()
    }

    /// Whether the page is all that a link opens.
    fn is_alone(&self) -> bool {
        self.link.target.is_some()
    }

    /// Links to the files of a finished job. They are relative, so that a proxy may serve the page below a path.
    fn downloads(&self) -> Markup {
        let Some(first) = self.record.scenes().next().filter(|_| !self.is_alone()) else { return html! {} };
        let file = first.format.extension();
        html! {
            p.downloads {
                a href="artifact" download { "." (file) " (" (size(first.blob.bytes)) ")" }
                @if first.format != SceneFormat::Ply { a href="export?format=ply" download { ".ply" } }
                a href="export?format=spz" download { ".spz" }
                a href="report?format=csv" download { "Figures as CSV" }
                @if !self.is_shared() { a href=(format!("../{}", self.record.job.id)) { "JSON" } }
            }
        }
    }

    /// The best of the held-out views, which leads to the page that turns the scene, and links to the other files of a curve.
    fn viewer(&self) -> Markup {
        if !self.has_cameras || self.is_alone() {
            return html! {};
        }
        let weights: Vec<f64> = self.record.scenes().filter_map(|scene| scene.lambda).collect();
        let poster = self.held_out.as_ref().and_then(|sheet| sheet.views.last());
        html! {
            div.viewer {
                a #viewer href="viewer" {
                    @if let Some(HeldOutView { render, width, height, .. }) = poster {
                        img src=(format!("data:image/jpeg;base64,{render}")) width=(width) height=(height) alt="The scene";
                    }
                    span { "Turn the scene" }
                }
                @if !weights.is_empty() {
                    p.hint {
                        "Or turn the file of "
                        @for weight in weights { a href=(format!("viewer?lambda={weight}")) { "λ = " (weight) } " " }
                    }
                }
            }
        }
    }
}

fn summary(metrics: &JobMetrics) -> Markup {
    let test = &metrics.test;
    let card = |name: &str, value: String, note: String| {
        html! { div.card { dt { (name) } dd { b { (value) } span { (note) } } } }
    };
    html! {
            dl.cards {
                (card("PSNR", format!("{} dB", figure(test.psnr, 2)), format!("{} held-out views", test.views)))
                (card("SSIM", figure(test.ssim, 4), "held-out views".to_owned()))
                @if let Some(network) = test.lpips_network { (card("LPIPS", figure(test.lpips, 4), network.to_string())) }
                (card("Size", bytes(metrics.bytes.total), format!("{} Gaussians", grouped(metrics.gaussians))))
                (card("Training", duration(metrics.seconds.train), format!("{} steps", grouped(metrics.steps))))
            }
    }
}
