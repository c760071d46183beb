//! `train --profile`: where time goes on the host and on the device, as a table of stages and kernels.

use std::{collections::BTreeMap, time::Duration};

use serde::Serialize;
use tcgs::{gpu::RecordingProfile, train::STEP_RECORDING};

/// A line of the table. Times are milliseconds: of a step for the recording of a training step, in all for the others.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Row {
    /// What was recorded: `step`, or another part of the run.
    recording: String,
    /// The stage; `submit` and `wait` are the host's ends of every recording.
    stage: &'static str,
    /// The kernel; none for a line on the host's time of a stage.
    kernel: Option<&'static str>,
    /// Dispatches, or recordings.
    count: f64,
    host_ms: Option<f64>,
    /// None on an adapter without timestamps.
    device_ms: Option<f64>,
}

/// The lines: training steps first, each stage followed by its kernels.
pub(super) fn table(recordings: &BTreeMap<String, RecordingProfile>) -> Vec<Row> {
    let mut labels: Vec<&String> = recordings.keys().collect();
    labels.sort_by_key(|label| (*label != STEP_RECORDING, *label));
    let mut rows = Vec::new();
    for label in labels {
        let times = &recordings[label];
        let per = if label == STEP_RECORDING { times.recordings.max(1) as f64 } else { 1.0 };
        let ms = |time: Duration| 1e3 * time.as_secs_f64() / per;
        let row = |stage, kernel, count: u64, host_ms, device_ms| Row {
            recording: label.clone(),
            stage,
            kernel,
            count: count as f64 / per,
            host_ms,
            device_ms,
        };
        for (stage, host) in &times.stages {
            let kernels: Vec<_> = times.kernels.iter().filter(|((of, _), _)| of == stage).collect();
            let device = kernels.iter().map(|(_, (_, time))| *time).sum();
            let device_ms = (!kernels.is_empty()).then(|| ms(device));
            rows.push(row(stage, None, times.recordings, Some(ms(*host)), device_ms));
            rows.extend(kernels.iter().map(|((_, kernel), (count, time))| {
                row(stage, Some(*kernel), *count, None, Some(ms(*time)))
            }));
        }
        for (stage, host) in [("submit", times.submit), ("wait", times.wait)] {
            rows.push(row(stage, None, times.recordings, Some(ms(host)), None));
        }
    }
    rows
}

/// The lines as text.
pub(super) fn text(rows: &[Row]) -> String {
    let figure = |ms: Option<f64>| ms.map_or_else(String::new, |ms| format!("{ms:.3}"));
    let mut lines = vec![format!(
        "{:<44} {:>9} {:>12} {:>12}",
        "profile (ms: of a step, or in all)", "count", "host ms", "device ms"
    )];
    for row in rows {
        let name = match row.kernel {
            Some(kernel) => format!("    {kernel}"),
            None => format!("{} / {}", row.recording, row.stage),
        };
        let [host, device] = [figure(row.host_ms), figure(row.device_ms)];
        lines.push(format!("{name:<44} {:>9.2} {host:>12} {device:>12}", row.count));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_come_first_and_are_means_and_kernels_follow_their_stage() {
        let ms = Duration::from_millis;
        let times = RecordingProfile {
            recordings: 4,
            submit: ms(8),
            wait: ms(80),
            stages: [("loss", ms(4)), ("optimizer", ms(12))].into(),
            kernels: [(("loss", "ssim_rows"), (8, ms(20))), (("loss", "ssim_columns"), (4, ms(20)))].into(),
        };
        let recordings = [("context fit".to_owned(), times.clone()), ("step".to_owned(), times)].into();
        let rows = table(&recordings);
        let lines: Vec<_> = rows.iter().map(|row| (row.recording.as_str(), row.stage, row.kernel)).collect();
        let of = |recording| {
            let stages = [("loss", None), ("loss", Some("ssim_columns")), ("loss", Some("ssim_rows"))];
            let ends = [("optimizer", None), ("submit", None), ("wait", None)];
            stages.into_iter().chain(ends).map(move |(stage, kernel)| (recording, stage, kernel))
        };
        assert_eq!(lines, of("step").chain(of("context fit")).collect::<Vec<_>>());
        let figures = |row: &Row| (row.count, row.host_ms, row.device_ms);
        assert_eq!(figures(&rows[0]), (1.0, Some(1.0), Some(10.0)));
        assert_eq!(figures(&rows[2]), (2.0, None, Some(5.0)));
        assert_eq!(figures(&rows[4]), (1.0, Some(2.0), None));
        assert_eq!(figures(&rows[6]), (4.0, Some(4.0), Some(40.0)));
        let text = text(&rows);
        assert!(text.contains("step / loss") && text.contains("\n    ssim_rows"), "{text}");
    }
}
