//! The job's options, dataset, adapter, times and digests.

use maud::{Markup, html};
use serde_json::Value;

use super::units::{bytes, duration, figure, grouped};
use crate::{domain::JobMetrics, store::JobRecord};

/// The section of settings.
pub(super) fn settings(record: &JobRecord) -> Markup {
    let job = &record.job;
    html! {
        section {
            h2 { "Settings and origin" }
            div.tables {
                (table("Options", options(record)))
                (table("Origin", origin(record)))
                @if let Some(metrics) = &job.metrics {
                    (table("Course", course(metrics)))
                    (table("How it was measured", conventions(metrics)))
                    @if metrics.convergence.is_some() { (table("Convergence", convergence(metrics))) }
                    @if metrics.byte_budget.is_some() { (table("The target size", budget(metrics))) }
                    @if metrics.crop.is_some() { (table("The crop", crop(metrics))) }
                }
            }
        }
    }
}

type Rows = Vec<(String, String)>;

fn row(name: &str, value: impl Into<String>) -> (String, String) {
    (name.to_owned(), value.into())
}

fn table(title: &str, rows: Rows) -> Markup {
    html! {
        table.pairs {
            caption { (title) }
            tbody {
                @for (name, value) in rows { tr { th scope="row" { (name) } td { (value) } } }
            }
        }
    }
}

/// Every option by its name in the API.
fn options(record: &JobRecord) -> Rows {
    let Ok(Value::Object(options)) = serde_json::to_value(&record.job.options) else { return Rows::new() };
    let text = |value: &Value| match value {
        Value::Null => "–".to_owned(),
        Value::String(text) => text.clone(),
        Value::Array(items) if items.is_empty() => "–".to_owned(),
        Value::Array(items) => {
            let item = |item: &Value| item.as_str().map_or_else(|| item.to_string(), str::to_owned);
            items.iter().map(item).collect::<Vec<_>>().join(", ")
        }
        other => other.to_string(),
    };
    options.iter().map(|(name, value)| (name.clone(), text(value))).collect()
}

fn origin(record: &JobRecord) -> Rows {
    let job = &record.job;
    let mut rows = vec![
        row("job", job.id.to_string()),
        row("dataset", bytes(record.dataset.bytes)),
        row("dataset SHA-256", record.dataset.digest.to_string()),
        row("attempts", job.attempt.to_string()),
        row("created", job.created_at.to_string()),
    ];
    rows.extend(job.started_at.map(|at| row("last started", at.to_string())));
    rows.extend(job.finished_at.map(|at| row("finished", at.to_string())));
    for scene in record.scenes() {
        let weight = scene.lambda.map_or_else(String::new, |lambda| format!(", λ = {lambda}"));
        rows.push((format!(".{} SHA-256{weight}", scene.format.name()), scene.blob.digest.to_string()));
    }
    if let Some(metrics) = &job.metrics {
        rows.push(row("decoded SHA-256", metrics.decode_sha256.to_string()));
        rows.push(row("adapter", metrics.adapter.clone()));
    }
    rows.push(row("service", concat!("tcgs ", env!("CARGO_PKG_VERSION"))));
    rows
}

fn course(metrics: &JobMetrics) -> Rows {
    let seconds = &metrics.seconds;
    let mut rows = vec![
        row("reading the dataset", duration(seconds.ingest)),
        row("training", duration(seconds.train)),
        row("encoding", duration(seconds.encode)),
        row("decoding", duration(seconds.decode)),
        row("steps", grouped(metrics.steps)),
        row("steps per second", figure(Some(metrics.steps_per_second), 2)),
        row("anchors", grouped(metrics.anchors)),
        row("Gaussians", grouped(metrics.gaussians)),
        row("PSNR before quantization, dB", figure(metrics.psnr_before_quantisation, 2)),
        row("PSNR of training views, dB", figure(metrics.train.psnr, 2)),
    ];
    if let Some(fit) = &metrics.color_fit {
        rows.push(row("PSNR of right halves, dB", figure(Some(fit.psnr), 2)));
        let corrected = figure(Some(fit.corrected_psnr), 2);
        rows.push(row("with color corrections fitted to left halves, dB", corrected));
    }
    if let Some(choice) = &metrics.exposure {
        let state = if choice.corrected { "on" } else { "off" };
        rows.push(row("color corrections of photographs", format!("{state}: {}", choice.because())));
    }
    rows
}

fn conventions(metrics: &JobMetrics) -> Rows {
    let conventions = &metrics.conventions;
    let mut rows = vec![
        row("images", conventions.images.clone()),
        row("background", metrics.background.to_string()),
        row("PSNR", conventions.psnr.clone()),
        row("SSIM", conventions.ssim.clone()),
    ];
    rows.extend(conventions.lpips.clone().map(|lpips| row("LPIPS", lpips)));
    rows.push(row("held out", conventions.held_out.clone()));
    rows.push(row("means", conventions.means.clone()));
    rows
}

fn convergence(metrics: &JobMetrics) -> Rows {
    let Some(convergence) = &metrics.convergence else { return Rows::new() };
    let views = if convergence.views.is_empty() { "–".to_owned() } else { convergence.views.join(", ") };
    vec![
        row("training views kept aside", views),
        row("converged after step", convergence.converged_at.map_or_else(|| "–".to_owned(), grouped)),
        row("PSNR of those views then, dB", figure(convergence.psnr, 2)),
        row("steps of the full schedule", grouped(convergence.full_steps)),
        row("steps saved", grouped(convergence.steps_saved)),
        row("time saved, estimated", duration(convergence.seconds_saved)),
        row("PSNR given up, estimated, dB", figure(convergence.psnr_given_up, 2)),
    ]
}

fn budget(metrics: &JobMetrics) -> Rows {
    let Some(budget) = &metrics.byte_budget else { return Rows::new() };
    let octaves = budget.qstep_log2;
    vec![
        row("target", bytes(budget.max_bytes)),
        row("without a target", bytes(budget.unconstrained_bytes)),
        row(
            "coarser steps, octaves",
            format!(
                "features {:.2}, scalings {:.2}, offsets {:.2}",
                octaves.features, octaves.scalings, octaves.offsets
            ),
        ),
        row("Gaussians left out", grouped(budget.gaussians_dropped)),
    ]
}

fn crop(metrics: &JobMetrics) -> Rows {
    let Some(crop) = &metrics.crop else { return Rows::new() };
    let whole = metrics.bytes.total.saturating_add_signed(crop.saved_bytes);
    vec![
        row("region", crop.region.to_string()),
        row("Gaussians removed", grouped(crop.gaussians_removed)),
        row("file of the whole scene", bytes(whole)),
        row("bytes saved", crop.saved_bytes.to_string()),
        row("PSNR lost, dB", figure(crop.lost_psnr, 2)),
    ]
}
