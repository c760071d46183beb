//! What each stage between training and the decoded file costs.

use maud::{Markup, html};

use super::units::figure;
use crate::domain::{CodingStages, JobMetrics, RenderingError};

/// The section of stages; nothing for a job of which none was measured.
pub(super) fn stages(metrics: &JobMetrics) -> Markup {
    if metrics.stages.is_none() && metrics.rendering.is_none() {
        return html! {};
    }
    html! {
        section {
            h2 { "What each stage costs" }
            div.tables {
                @if let Some(stages) = &metrics.stages { (coding(stages, metrics)) }
                @if let Some(error) = &metrics.rendering { (rendering(error)) }
            }
        }
    }
}

fn rows(title: &str, rows: &[(&str, String)]) -> Markup {
    html! {
        table.pairs {
            caption { (title) }
            tbody { @for (name, value) in rows { tr { th scope="row" { (name) } td { (value) } } } }
        }
    }
}

fn coding(stages: &CodingStages, metrics: &JobMetrics) -> Markup {
    let signed = |value: f64| format!("{value:+.3} dB");
    let title = format!("Held-out PSNR of {} views", stages.views);
    rows(
        &title,
        &[
            ("as trained, in floats", format!("{:.2} dB", stages.floats)),
            ("noise in place of rounding", signed(stages.noise - stages.floats)),
            ("rounded attributes", signed(stages.rounded - stages.floats)),
            ("quantized networks", signed(stages.decoded - stages.rounded)),
            ("the decoded file", format!("{:.2} dB", stages.decoded)),
            (
                "bits, integer over float context",
                figure(metrics.coding.and_then(|coding| coding.over_floats), 4),
            ),
            (
                "bytes over those of the model",
                figure(metrics.coding.map(|coding| coding.entropy_overhead), 4),
            ),
        ],
    )
}

fn rendering(error: &RenderingError) -> Markup {
    let [width, height] = error.size;
    rows(
        &format!("The renderer in f32 against f64, {} views of {width} x {height}", error.views),
        &[
            ("root of mean square", format!("{:.2e}", error.rmse)),
            ("largest", format!("{:.2e}", error.max)),
            ("cost of skipping faint contributions", format!("{:.2e}", error.cutoff_rmse)),
        ],
    )
}
