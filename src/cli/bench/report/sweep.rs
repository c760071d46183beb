//! Makes the renders of a report that are missing, and keeps a record of each size at once.

use std::sync::Arc;

use tcgs::{
    domain::{Problem, ProblemType},
    gpu::{AdapterChoice, Device},
    render::RenderError,
};
use tcgs_lab::report::{
    matrix::RenderSweep,
    sweep::{SweepRecord, devices, measure},
};

use super::ADVICE;
use crate::cli::{CliError, json_lines::JsonLines, notice::notice, signals::Interruption};

/// The records of every size, those that there are and those that are missing.
pub(super) fn make(
    sweep: &RenderSweep,
    adapter: &AdapterChoice,
    records: &mut JsonLines<SweepRecord>,
    interruption: &Interruption,
) -> Result<Vec<SweepRecord>, CliError> {
    let mut done = Vec::new();
    let mut opened: Vec<Arc<Device>> = Vec::new();
    for gaussians in sweep.gaussians.iter().map(|count| count.0) {
        for side in sweep.sides.iter().map(|side| side.0) {
            let is_it = |record: &&SweepRecord| {
                record.adapter[0] == adapter.to_string()
                    && record.side == side
                    && record.gaussians == gaussians
                    && record.repeats == sweep.repeats
            };
            if let Some(record) = records.all().iter().find(is_it) {
                done.push(record.clone());
                continue;
            }
            if interruption.cancel.is_cancelled() {
                return Err(interruption.error(ADVICE));
            }
            if opened.is_empty() {
                opened = devices(adapter).map_err(problem)?;
            }
            notice(format_args!("tcgs: renders of {gaussians} Gaussians, {side} x {side} pixels"));
            let record = measure(adapter, &opened, gaussians, side, sweep.repeats).map_err(problem)?;
            done.push(records.add(&record)?);
        }
    }
    Ok(done)
}

/// The records that there are of a sweep.
pub(super) fn kept(sweep: &RenderSweep, records: &JsonLines<SweepRecord>) -> Vec<SweepRecord> {
    let is_of_it = |record: &&SweepRecord| {
        sweep.sides.iter().any(|side| side.0 == record.side)
            && sweep.gaussians.iter().any(|count| count.0 == record.gaussians)
    };
    records.all().iter().filter(is_of_it).cloned().collect()
}

fn problem(error: RenderError) -> CliError {
    Problem::new(ProblemType::Internal, error.to_string()).into()
}
