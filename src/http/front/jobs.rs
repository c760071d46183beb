//! The list of jobs, one card each.

use maud::{Markup, html};

use crate::{
    domain::{Job, JobState},
    http::report::units::{duration, grouped, size},
    store::{ArtifactKind, JobRecord},
};

/// The section of jobs, newest first.
pub(super) fn section(jobs: &[JobRecord], is_first: bool, next: Option<&str>) -> Markup {
    html! {
        section {
            h2 { "Scenes" }
            p #told role="status" {}
            p #none.none hidden[!jobs.is_empty()] { @if is_first { "Nothing here yet." } @else { "There are no older ones." } }
            div #jobs.jobs data-first[is_first] { @for record in jobs { (card(record)) } }
            nav.pages {
                @if !is_first { a href="." { "Newest" } }
                @if let Some(next) = next { a rel="next" href=(next) { "Older" } }
            }
        }
    }
}

/// A job; the script of the page updates the figures of a running one, and replaces the card when the state changes.
fn card(record: &JobRecord) -> Markup {
    let job = &record.job;
    let (id, state) = (job.id, job.state.name());
    let is_done = job.state == JobState::Succeeded;
    let name = name(record);
    html! {
        article.job data-job=(id) data-state=(state) data-name=(name) {
            a.thumb href=(format!("v1/jobs/{id}/{}", if is_done { "viewer" } else { "report" })) tabindex="-1" aria-hidden="true" {
                @if record.artifact(ArtifactKind::Thumbnail).is_some() {
                    img src=(format!("v1/jobs/{id}/thumbnail")) alt="" loading="lazy";
                } @else if record.artifact(ArtifactKind::Preview).is_some() {
                    img src=(format!("v1/jobs/{id}/preview")) alt="" loading="lazy";
                } @else if is_done {
                    // A job of an earlier version.
                    img src=(format!("v1/jobs/{id}/view?width=320&format=jpeg")) alt="" loading="lazy";
                }
            }
            div.what {
                h3 { a.name href=(format!("v1/jobs/{id}/report")) { (name) } }
                p { span.{"state " (state)} { (state) } " " span.figures { (figures(record)) } }
                @if job.state == JobState::Running {
                    progress max=(job.progress.total.max(1)) value=(job.progress.step) aria-label="Steps" {}
                }
                p.hint { (job.options.model.name()) " " (job.options.preset.name()) ", " time datetime=(job.created_at) { (job.created_at.strftime("%Y-%m-%d %H:%M")) " UTC" } }
                div.actions { (actions(job)) }
            }
        }
    }
}

fn name(record: &JobRecord) -> String {
    let short = || {
        let id = record.job.id.to_string();
        // The first digits are those of the time.
        format!("Job {}", id.rsplit('-').next().unwrap_or_default())
    };
    record.name.clone().unwrap_or_else(short)
}

fn actions(job: &Job) -> Markup {
    let button = |action: &str, text: &str| html! { button type="button" data-act=(action) { (text) } };
    html! {
        @match job.state {
            JobState::Queued | JobState::Running if job.cancel_requested => span.hint { "is being cancelled" },
            JobState::Queued | JobState::Running => (button("cancel", "Cancel")),
            JobState::Failed | JobState::Cancelled => { (button("retry", "Retry")) " " (button("delete", "Delete")) },
            JobState::Succeeded => { a.button href=(format!("v1/jobs/{}/viewer", job.id)) { "View" } " " (button("delete", "Delete")) },
        }
    }
}

/// PSNR and bytes of a result, progress of a run, or why there is neither.
fn figures(record: &JobRecord) -> String {
    let job = &record.job;
    match (&job.metrics, &job.error, record.queue_position) {
        (Some(metrics), ..) => {
            let psnr = metrics.test.psnr.map(|psnr| format!("{psnr:.2} dB"));
            joined([psnr, Some(size(metrics.bytes.total))])
        }
        (None, Some(problem), _) => problem.title.clone(),
        (None, None, Some(position)) => format!("place {position} in the queue"),
        (None, None, None) => progress(job),
    }
}

fn progress(job: &Job) -> String {
    let progress = &job.progress;
    if job.state != JobState::Running {
        let has_begun = progress.step > 0;
        let at = || format!("at step {} of {}", grouped(progress.step), grouped(progress.total));
        return if has_begun { at() } else { String::new() };
    }
    let steps =
        (progress.step > 0).then(|| format!("{} of {}", grouped(progress.step), grouped(progress.total)));
    joined([
        Some(job.phase.name().to_owned()),
        steps,
        progress.psnr.map(|psnr| format!("{psnr:.1} dB")),
        progress.bytes.map(|bytes| format!("about {}", size(bytes))),
        progress.eta_seconds.map(|left| format!("{} left", duration(left))),
    ])
}

fn joined<const N: usize>(parts: [Option<String>; N]) -> String {
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}
