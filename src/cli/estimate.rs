//! What a job on a dataset will take on this machine, as `tcgs check` prints it.

use std::{path::Path, time::Duration};

use serde::Serialize;
use tcgs::{
    domain::{
        Bytes, DatasetSummary, JobNeeds, MemoryNeeds, ModelKind, NamedCamera, Preset, TrainOptions,
        ValueRange,
    },
    gpu::AdapterReport,
    ingest,
    pipeline::{JobError, Machine, job_needs},
    train::Schedule,
};

use super::{CliError, adapter::AdapterFlag, memory::MemoryFlags, signals::Interruption, wiring};

/// Time of the steps that are timed.
const CALIBRATION: Duration = Duration::from_secs(3);

/// The flags of an estimate.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct EstimateFlags {
    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    /// Time no steps on the adapter, which takes 3 s and the compilation of kernels; training time is unknown then
    #[arg(long)]
    no_calibration: bool,
}

/// The steps that were timed.
#[derive(Debug, Serialize)]
struct Calibrated {
    adapter: String,
    steps: u32,
    seconds: f64,
    steps_per_second: f64,
}

/// What the preset and the options choose for the dataset.
#[derive(Debug, Serialize)]
struct Chosen {
    preset: Preset,
    model: ModelKind,
    /// Features and offsets of an anchor, before training narrows them; none for plain Gaussians.
    features: Option<usize>,
    offsets: Option<usize>,
    /// Weight of the rate; none without compression.
    lambda: Option<f64>,
    /// How often the run trains on each photograph, as a mean; none while they are not known.
    steps_per_photograph: Option<f64>,
}

impl Chosen {
    fn new(summary: &DatasetSummary, options: &TrainOptions) -> Self {
        let schedule = Schedule::new(options);
        let anchors = options.model != ModelKind::Gaussians3d;
        Self {
            preset: options.preset,
            model: options.model,
            features: anchors.then_some(schedule.shape.features),
            offsets: anchors.then_some(schedule.shape.offsets),
            lambda: schedule.compression.as_ref().map(|compression| compression.lambda),
            steps_per_photograph: (summary.train > 0 && !summary.layout.lacks_cameras())
                .then(|| f64::from(schedule.steps) / summary.train as f64),
        }
    }

    /// The line of text.
    fn line(&self) -> String {
        let mut line = format!("schedule     {} of {}", self.preset, self.model);
        if let (Some(features), Some(offsets)) = (self.features, self.offsets) {
            line += &format!(", {features} features and {offsets} offsets an anchor");
        }
        if let Some(lambda) = self.lambda {
            line += &format!(", weight of the rate {lambda}");
        }
        if let Some(steps) = self.steps_per_photograph {
            line += &format!(", {} steps a photograph", (10.0 * steps).round() / 10.0);
        }
        line + "\n"
    }
}

/// What a job will take.
#[derive(Debug, Serialize)]
pub(super) struct Estimate {
    schedule: Chosen,
    steps: u64,
    /// Seconds of training; none without a calibration.
    train_seconds: Option<ValueRange<f64>>,
    memory: Option<MemoryNeeds>,
    file_bytes: ValueRange<u64>,
    calibration: Option<Calibrated>,
    notes: Vec<String>,
}

/// Estimates a job on the dataset, which has passed its checks. Faults of the adapter and of pixels become notes.
pub(super) fn estimate(
    dataset: &Path,
    summary: &DatasetSummary,
    cameras: &[NamedCamera],
    options: &TrainOptions,
    flags: &EstimateFlags,
) -> Result<Estimate, CliError> {
    let memory = flags.memory.limits(1);
    let adapter = AdapterReport::of(&flags.adapter.adapter);
    let machine = adapter.map(|adapter| Machine { adapter, memory });
    let machine = machine.map_err(|error| format!("time and memory are unknown: {error}"));
    let cameras = (!cameras.is_empty()).then_some(cameras);
    let JobNeeds { steps, memory: needed, file_bytes, mut notes } =
        job_needs(summary, cameras, options, machine.as_ref().map_err(Clone::clone));
    let (mut calibration, mut reasons) = (None, Vec::new());
    if machine.is_err() {
        // Its reason is among the notes.
    } else if flags.no_calibration {
        reasons.push("training time is unknown without a calibration".to_owned());
    } else if summary.layout.lacks_cameras() {
        reasons.push("training time is unknown until cameras are found; `tcgs poses` finds them".to_owned());
    } else if needed.is_some() {
        let interruption = Interruption::listen();
        let runner = wiring::runner(&flags.adapter.adapter, memory, ingest::large_file_dir(), None);
        match runner.calibrate(dataset, options, CALIBRATION, &interruption.cancel) {
            Ok(found) => calibration = Some(found),
            Err(JobError::Cancelled) if interruption.cancel.is_cancelled() => {
                return Err(interruption.error("--no-calibration checks without training"));
            }
            Err(JobError::Cancelled) => {
                reasons.push("training time is unknown: the run has too few steps to time one".to_owned());
            }
            Err(JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem)) => {
                reasons.push(format!("training time is unknown: {problem}"));
            }
        }
    }
    notes.append(&mut reasons);
    Ok(Estimate {
        schedule: Chosen::new(summary, options),
        steps,
        train_seconds: calibration.as_ref().map(|calibration| calibration.train_seconds(steps)),
        memory: needed,
        file_bytes,
        calibration: calibration.map(|found| Calibrated {
            steps_per_second: found.steps_per_second(),
            adapter: found.adapter,
            steps: found.steps,
            seconds: found.seconds,
        }),
        notes,
    })
}

/// The lines of an estimate.
pub(super) fn text(estimate: &Estimate) -> String {
    let Estimate { schedule, steps, train_seconds, memory, file_bytes, calibration, notes } = estimate;
    let mut text = schedule.line();
    text += &match (train_seconds, calibration) {
        (Some(seconds), Some(Calibrated { adapter, steps: timed, seconds: took, steps_per_second })) => {
            format!(
                "training     {} for {steps} steps\n\
             calibration  {steps_per_second:.1} steps/s at first, {timed} steps in {took:.1} s on {adapter}\n",
                range(seconds.low, seconds.high, duration),
            )
        }
        _ => format!("training     {steps} steps\n"),
    };
    if let Some(MemoryNeeds { gpu_bytes, host_bytes, max_size, unit }) = memory {
        text += &format!(
            "memory       up to {} on the adapter and {} of main memory, for at most {max_size} {unit}\n",
            Bytes(*gpu_bytes),
            Bytes(*host_bytes)
        );
    }
    text += &format!(
        "file         {}\n",
        range(file_bytes.low, file_bytes.high, |bytes| Bytes(bytes).to_string())
    );
    for note in notes {
        text += &format!("note         {note}\n");
    }
    text
}

fn range<T>(low: T, high: T, shown: impl Fn(T) -> String) -> String {
    let (low, high) = (shown(low), shown(high));
    if low == high { low } else { format!("{low} to {high}") }
}

/// Seconds as people say them.
fn duration(seconds: f64) -> String {
    match seconds {
        seconds if seconds < 100.0 => format!("{seconds:.0} s"),
        seconds if seconds < 6000.0 => format!("{:.0} min", seconds / 60.0),
        seconds => format!("{:.1} h", seconds / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_has_ranges_and_says_what_is_unknown() {
        let chosen = Chosen {
            preset: Preset::Preview,
            model: ModelKind::Tcgs,
            features: Some(32),
            offsets: Some(4),
            lambda: Some(0.0005),
            steps_per_photograph: Some(6.66),
        };
        let mut estimate = Estimate {
            schedule: chosen,
            steps: 2000,
            train_seconds: Some(ValueRange { low: 80.4, high: 300.0 }),
            memory: Some(MemoryNeeds {
                gpu_bytes: 3 << 20,
                host_bytes: 5 << 20,
                max_size: 40_000,
                unit: "anchors".to_owned(),
            }),
            file_bytes: ValueRange { low: 2048, high: 2 << 20 },
            calibration: Some(Calibrated {
                adapter: "a card".to_owned(),
                steps: 60,
                seconds: 3.0,
                steps_per_second: 20.0,
            }),
            notes: Vec::new(),
        };
        assert_eq!(
            text(&estimate),
            "schedule     preview of tcgs, 32 features and 4 offsets an anchor, weight of the rate 0.0005, 6.7 steps a photograph\n\
             training     80 s to 5 min for 2000 steps\n\
             calibration  20.0 steps/s at first, 60 steps in 3.0 s on a card\n\
             memory       up to 3.0 MiB on the adapter and 5.0 MiB of main memory, for at most 40000 anchors\n\
             file         2.0 KiB to 2.0 MiB\n"
        );
        (estimate.calibration, estimate.train_seconds, estimate.memory) = (None, None, None);
        estimate.notes.push("time is unknown".to_owned());
        estimate.schedule = Chosen {
            model: ModelKind::Gaussians3d,
            features: None,
            offsets: None,
            lambda: None,
            steps_per_photograph: None,
            ..estimate.schedule
        };
        assert_eq!(
            text(&estimate),
            "schedule     preview of 3dgs\ntraining     2000 steps\nfile         2.0 KiB to 2.0 MiB\nnote         time is unknown\n"
        );
        assert_eq!([99.4, 101.0, 7200.0].map(duration), ["99 s", "2 min", "2.0 h"]);
    }
}
