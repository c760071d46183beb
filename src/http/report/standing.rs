//! How a job without a result stands: its progress with a picture of the model, or why and where it ended.

use maud::{Markup, html};

use super::units::{duration, grouped};
use crate::{
    domain::Job,
    store::{ArtifactKind, JobRecord},
};

/// The section. The page's script keeps that of an unfinished job up to date.
pub(super) fn standing(record: &JobRecord, is_shared: bool) -> Markup {
    let job = &record.job;
    html! {
        @match &job.error {
            Some(problem) => section {
                h2 { (problem.title) }
                p { (problem.detail) @if let Some(file) = &problem.file { " File: " code { (file) } "." } }
                p { code { (problem.kind) } }
                (ended(record, is_shared))
            },
            None if job.state.is_terminal() => section {
                h2 { "The job was cancelled" }
                (ended(record, is_shared))
            },
            None => section #live {
                h2 { "In progress" }
                p #progress { (progress(job)) }
                (pictures(record))
                p {
                    @if !is_shared { button #cancel type="button" hidden disabled[job.cancel_requested] { "Cancel" } " " }
                    span #told.none role="status" { noscript { "The page follows the job in a browser with scripts." } }
                }
            },
        }
    }
}

fn progress(job: &Job) -> Markup {
    let progress = &job.progress;
    html! {
        @match &progress.poses {
            Some(poses) => {
                progress max=(poses.total.max(1)) value=(poses.done) {}
                " cameras are found: " (poses.stage.name()) " " (grouped(poses.done)) " of " (grouped(poses.total))
            },
            None => {
                progress max=(progress.total.max(1)) value=(progress.step) {}
                " " (grouped(progress.step)) " of " (grouped(progress.total)) " steps"
                @if let Some(psnr) = progress.psnr { ", " (format!("{psnr:.2}")) " dB" }
                @if let Some(eta) = progress.eta_seconds { ", about " (duration(eta)) " of training left" }
            },
        }
    }
}

/// How far the job came, what it looked like then, and how to go on.
fn ended(record: &JobRecord, is_shared: bool) -> Markup {
    let progress = &record.job.progress;
    html! {
        p {
            @if progress.step > 0 {
                "It came to step " (grouped(progress.step)) " of " (grouped(progress.total)) ". "
            }
            @if !is_shared {
                "Another job of the same kind, from its last checkpoint if there is one: " code { "tcgs retry " (record.job.id) }
            }
        }
        @if record.artifact(ArtifactKind::Preview).is_some() { (pictures(record)) }
    }
}

/// The model's view beside the photograph. Their addresses are relative, so that a proxy may serve the page below a path.
fn pictures(record: &JobRecord) -> Markup {
    let is_there = record.artifact(ArtifactKind::Preview).is_some();
    let source = |address: &'static str| is_there.then_some(address);
    html! {
        div #pictures.beside hidden[!is_there] {
            figure {
                img #photograph src=[source("preview?of=photograph")] alt="The photograph of a view";
                figcaption { "The photograph" }
            }
            figure {
                img #preview src=[source("preview")] alt="The same view of the scene as it is";
                figcaption { "The scene now, from the same place" }
            }
        }
    }
}
