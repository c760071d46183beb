//! The job's figures as comma-separated values: a head and one line.

use super::history::History;
use crate::{
    domain::{csv_cell, metrics_columns},
    store::JobRecord,
};

/// Levels of PSNR of the held-out views of progress, in dB, whose seconds are told.
const LEVELS: [(&str, f64); 4] = [
    ("seconds_to_held_out_25_db", 25.0),
    ("seconds_to_held_out_28_db", 28.0),
    ("seconds_to_held_out_30_db", 30.0),
    ("seconds_to_held_out_32_db", 32.0),
];

/// The table. A job without metrics has its first columns alone.
pub(super) fn table(record: &JobRecord, history: &History) -> String {
    let job = &record.job;
    let options = &job.options;
    let mut columns = vec![
        ("job", job.id.to_string()),
        ("state", job.state.name().to_owned()),
        ("dataset_sha256", record.dataset.digest.to_string()),
        ("model", options.model.to_string()),
        ("lambda", options.lambda.map_or_else(String::new, |lambda| lambda.to_string())),
        ("preset", options.preset.to_string()),
        ("seed", options.seed.to_string()),
    ];
    if let Some(metrics) = &job.metrics {
        columns.extend(metrics_columns(metrics));
        let training = history.points(|point| Some(point.seconds), |point| point.psnr);
        columns.extend(LEVELS.map(|(name, level)| {
            let reached = training.iter().find(|(_, psnr)| *psnr >= level);
            (name, reached.map_or_else(String::new, |(seconds, _)| seconds.to_string()))
        }));
    }
    let line = |cells: Vec<String>| cells.join(",") + "\r\n";
    let head = line(columns.iter().map(|(name, _)| (*name).to_owned()).collect());
    head + &line(columns.iter().map(|(_, value)| csv_cell(value)).collect())
}
