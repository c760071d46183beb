//! The metrics of a job as named columns, for tables of comma-separated values.

use super::JobMetrics;

/// Every figure by its column, in the order of the table; empty where a job lacks it.
#[must_use]
pub fn metrics_columns(metrics: &JobMetrics) -> Vec<(&'static str, String)> {
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    let JobMetrics { test, train, seconds, coding, stages, rendering, color_fit, exposure, crop, .. } =
        metrics;
    let mut columns = vec![
        ("adapter", metrics.adapter.clone()),
        ("background", metrics.background.to_string()),
        ("steps", metrics.steps.to_string()),
        ("psnr", number(test.psnr)),
        ("ssim", number(test.ssim)),
        ("lpips", number(test.lpips)),
        ("lpips_network", test.lpips_network.map_or_else(String::new, |network| network.to_string())),
        ("test_views", test.views.to_string()),
        ("train_psnr", number(train.psnr)),
        ("gaussians", metrics.gaussians.to_string()),
        ("anchors", metrics.anchors.to_string()),
        ("bytes", metrics.bytes.total.to_string()),
    ];
    columns.extend(metrics.bytes.parts().map(|(part, bytes)| (bytes_column(part), bytes.to_string())));
    columns.extend([
        ("ingest_seconds", seconds.ingest.to_string()),
        ("train_seconds", seconds.train.to_string()),
        ("steps_per_second", metrics.steps_per_second.to_string()),
        ("encode_seconds", seconds.encode.to_string()),
        ("decode_seconds", seconds.decode.to_string()),
        ("psnr_before_quantisation", number(metrics.psnr_before_quantisation)),
        ("entropy_overhead", number(coding.map(|coding| coding.entropy_overhead))),
        ("integer_over_float_bits", number(coding.and_then(|coding| coding.over_floats))),
        ("stage_views", stages.map_or_else(String::new, |stages| stages.views.to_string())),
        ("stage_floats", number(stages.map(|stages| stages.floats))),
        ("stage_noise", number(stages.map(|stages| stages.noise))),
        ("stage_rounded", number(stages.map(|stages| stages.rounded))),
        ("stage_decoded", number(stages.map(|stages| stages.decoded))),
        ("render_rmse", number(rendering.map(|error| error.rmse))),
        ("render_max_error", number(rendering.map(|error| error.max))),
        ("cutoff_rmse", number(rendering.map(|error| error.cutoff_rmse))),
        ("right_half_psnr", number(color_fit.map(|fit| fit.psnr))),
        ("right_half_corrected_psnr", number(color_fit.map(|fit| fit.corrected_psnr))),
        ("exposure_corrected", exposure.map_or_else(String::new, |choice| choice.corrected.to_string())),
        ("exposure_gain", number(exposure.and_then(|choice| Some(choice.trial?.gain)))),
        ("crop_saved_bytes", crop.map_or_else(String::new, |crop| crop.saved_bytes.to_string())),
        ("crop_lost_psnr", number(crop.and_then(|crop| crop.lost_psnr))),
    ]);
    columns
}

/// The column of a part of [`ByteCounts::parts`](super::ByteCounts::parts).
fn bytes_column(part: &str) -> &'static str {
    match part {
        "container" => "container_bytes",
        "networks" => "network_bytes",
        "planes" => "plane_bytes",
        "positions" => "position_bytes",
        "masks" => "mask_bytes",
        "features" => "feature_bytes",
        "scalings" => "scaling_bytes",
        "offsets" => "offset_bytes",
        _ => "other_bytes",
    }
}

/// A text as one cell of comma-separated values (RFC 4180).
#[must_use]
pub fn csv_cell(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_quoted_where_they_must_be() {
        assert_eq!(csv_cell("llvmpipe"), "llvmpipe");
        assert_eq!(csv_cell("a, \"b\"\n"), "\"a, \"\"b\"\"\n\"");
    }

    #[test]
    fn every_part_of_a_file_has_its_column() {
        for (part, _) in super::super::ByteCounts::default().parts() {
            assert_ne!(bytes_column(part), "other_bytes", "{part}");
        }
    }
}
