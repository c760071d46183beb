//! Estimates what a job needs before it starts: steps, memory and bytes of its file.
//!
//! A target size that no file can meet is refused before training. Memory is what training itself allows for ([`Needs`]). The file's
//! bytes are a range: of a `tcgs` file by the bytes an anchor of recorded runs (docs/RESULTS.md, docs/LONG_RUNS.md), of files of floats by
//! their layout.

use crate::{
    domain::{
        Bytes, DatasetSummary, JobNeeds, MaxWidth, MemoryLimits, MemoryNeeds, ModelKind, NamedCamera,
        OptionError, TrainOptions, ValueRange,
    },
    gpu::AdapterReport,
    model::{ModelShape, NetworkLayout},
    train::{Needs, Schedule, SetSizes},
};

/// Bytes an anchor of `tcgs` files, networks and container included: 12.1 to 46.6 in recorded runs.
const TCGS_ANCHOR_BYTES: ValueRange<u64> = ValueRange { low: 10, high: 50 };

/// How many times fewer anchors or Gaussians a run may end with than it began with: 13 in the recorded run that lost most, of a set without
/// points and a large weight of the rate.
const MAX_LOSS: u64 = 32;

/// Bytes of a Gaussian in a PLY file: 62 floats.
const GAUSSIAN_BYTES: u64 = 62 * size_of::<f32>() as u64;

/// Bytes that a file has at most besides anchors, Gaussians and networks, and the fewest of any file.
const HEADER_BYTES: ValueRange<u64> = ValueRange { low: 512, high: 8192 };

/// Fewest bits of a network's parameter in a `tcgs` file. The coarsest weights have 4 bits, of which entropy coding saves a part; in
/// finished files parameters take 8 to 9.
const MIN_PARAMETER_BITS: u64 = 3;

/// An adapter, and what a run may take there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Machine {
    /// The adapter.
    pub adapter: AdapterReport,
    /// What a run may take.
    pub memory: MemoryLimits,
}

/// What a job on the dataset needs on a machine, or why no machine is known; `cameras` are those of its frames, if they are known.
#[must_use]
pub fn job_needs(
    summary: &DatasetSummary,
    cameras: Option<&[NamedCamera]>,
    options: &TrainOptions,
    machine: Result<&Machine, String>,
) -> JobNeeds {
    let schedule = Schedule::new(options);
    let mut notes = Vec::new();
    if summary.layout.lacks_cameras() {
        notes.push(
            "cameras are found before training; the time and memory of that are not counted, and points are not known yet"
                .to_owned(),
        );
    }
    if cameras.is_none() && options.max_width != MaxWidth::DEFAULT {
        notes.push(format!(
            "memory and times are those of photographs at most {} pixels wide, as the dataset was checked; another max_width changes them",
            MaxWidth::DEFAULT
        ));
    }
    let sizes = |memory_bytes: u64| match cameras {
        Some(cameras) if !cameras.is_empty() => SetSizes::of_cameras(cameras, summary.points, memory_bytes),
        _ => SetSizes::of_summary(summary, memory_bytes),
    };
    let estimate = match machine {
        Ok(_) if summary.pixels == 0 => {
            notes.push("memory is unknown: the photographs have no size yet".to_owned());
            None
        }
        Ok(Machine { adapter, memory }) => {
            let budget = memory.budget(adapter.shares_main_memory());
            // As in a job, photographs may take half of main memory.
            let needs = Needs::of_sizes(sizes(budget.host / 2), options, adapter);
            needs.within(&budget).map_err(|error| notes.push(error.to_string())).ok()
        }
        Err(reason) => {
            notes.push(reason);
            None
        }
    };
    let max_size = estimate.as_ref().map_or_else(|| schedule.max_size(), |estimate| estimate.size);
    let points = summary.points.filter(|points| *points > 0).unwrap_or(schedule.random_points);
    JobNeeds {
        steps: steps(options, &schedule),
        memory: estimate.map(|estimate| MemoryNeeds {
            gpu_bytes: estimate.gpu_bytes(),
            host_bytes: estimate.host_bytes(),
            max_size: estimate.size as u64,
            unit: estimate.unit.to_owned(),
        }),
        file_bytes: file_bytes(options, &schedule, points.min(max_size) as u64, max_size as u64, &mut notes),
        notes,
    }
}

/// Options that a run can have: they suit each other, and a file of their model can be as small as they ask for.
///
/// # Errors
/// The option that is wrong, and why.
pub fn checked_options(options: TrainOptions) -> Result<TrainOptions, OptionError> {
    let options = options.validated()?;
    let least = least_file_bytes(Schedule::new(&options).shape);
    match options.max_bytes {
        Some(bytes) if bytes < least => Err(OptionError {
            option: "max_bytes",
            error: format!(
                "no file has {bytes} bytes or fewer: its container and its networks alone take {least}"
            ),
        }),
        _ => Ok(options),
    }
}

/// Bytes that every `tcgs` file of a model takes. Training may narrow the model to one feature channel and one offset an anchor; the
/// networks stay as wide inside.
fn least_file_bytes(shape: ModelShape) -> u64 {
    let narrowest = ModelShape { features: 1, offsets: 1, ..shape };
    HEADER_BYTES.low + NetworkLayout::new(narrowest).parameters as u64 * MIN_PARAMETER_BITS / 8
}

/// The steps of a job: branches of a rate-distortion curve share those up to the fork.
fn steps(options: &TrainOptions, schedule: &Schedule) -> u64 {
    let branches = options.rd_curve.len().max(1) as u64;
    let shared = if branches > 1 { u64::from(schedule.fork_step()) } else { 0 };
    shared + branches * (u64::from(schedule.steps) - shared)
}

fn file_bytes(
    options: &TrainOptions,
    schedule: &Schedule,
    points: u64,
    max_size: u64,
    notes: &mut Vec<String>,
) -> ValueRange<u64> {
    let networks = 4 * NetworkLayout::new(schedule.shape).parameters as u64;
    let (unit, fixed) = match options.model {
        ModelKind::Tcgs => (TCGS_ANCHOR_BYTES, 0),
        ModelKind::Scaffold => {
            // An anchor's row and its position.
            let bytes = 4 * (schedule.shape.row() as u64 + 3);
            (ValueRange { low: bytes, high: bytes }, networks)
        }
        ModelKind::Gaussians3d => (ValueRange { low: GAUSSIAN_BYTES, high: GAUSSIAN_BYTES }, 0),
    };
    // A crop may leave next to nothing.
    let fewest = if options.crop.is_none() { points / MAX_LOSS } else { 0 };
    let low = HEADER_BYTES.low + fixed + unit.low * fewest;
    // Networks of a small `tcgs` file are most of it.
    let high = HEADER_BYTES.high + networks + unit.high * max_size.max(points);
    match options.max_bytes {
        Some(max_bytes) if max_bytes < high => {
            if max_bytes < low {
                notes.push(format!("a file within {} may be impossible", Bytes(max_bytes)));
            }
            ValueRange { low: low.min(max_bytes), high: max_bytes }
        }
        _ => ValueRange { low, high },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::{Crop, Layout},
        gpu::testing::software_report,
    };

    fn summary(pixels: u64, points: Option<usize>) -> DatasetSummary {
        DatasetSummary { layout: Layout::Colmap, train: 7, test: 1, pixels, points, notes: Vec::new() }
    }

    fn none() -> Result<&'static Machine, String> {
        Err("no machine".to_owned())
    }

    fn machine(host: u64) -> Machine {
        Machine { adapter: software_report(), memory: MemoryLimits { host, gpu: None } }
    }

    #[test]
    fn a_job_needs_the_memory_that_its_run_allows_for() {
        let options = TrainOptions::default();
        let dataset = summary(8 * 64 * 64, Some(500));
        let machine = machine(8 << 30);
        let needs = job_needs(&dataset, None, &options, Ok(&machine));
        let sizes = SetSizes::of_summary(&dataset, 2 << 30);
        let budget = machine.memory.budget(true);
        let run = Needs::of_sizes(sizes, &options, &machine.adapter).within(&budget).expect("it fits");
        let memory = needs.memory.expect("known");
        assert_eq!((memory.gpu_bytes, memory.host_bytes), (run.gpu_bytes(), run.host_bytes()));
        assert_eq!((memory.max_size, &*memory.unit), (40_000, "anchors"));
        assert_eq!((needs.steps, needs.notes), (2000, Vec::<String>::new()));
        let unknown = job_needs(&dataset, None, &options, none());
        assert_eq!((unknown.memory, unknown.file_bytes), (None, needs.file_bytes));
        assert_eq!(unknown.notes, ["no machine"]);
    }

    #[test]
    fn what_does_not_fit_or_is_not_known_is_noted() {
        let options = TrainOptions::default();
        let small = job_needs(&summary(8 * 64 * 64, Some(500)), None, &options, Ok(&machine(1 << 20)));
        assert!(small.memory.is_none() && small.notes[0].contains("--host-memory"), "{:?}", small.notes);
        let width = TrainOptions { max_width: MaxWidth::new(400).expect("a width"), ..options.clone() };
        let needs = job_needs(&summary(8 * 64 * 64, Some(500)), None, &width, Ok(&machine(8 << 30)));
        assert!(needs.notes.len() == 1 && needs.notes[0].contains("at most 1600"), "{:?}", needs.notes);
        let video = DatasetSummary { layout: Layout::Video, train: 0, test: 0, ..summary(0, None) };
        let needs = job_needs(&video, None, &options, Ok(&machine(8 << 30)));
        assert!(needs.memory.is_none() && needs.notes.len() == 2, "{:?}", needs.notes);
    }

    #[test]
    fn recorded_files_are_within_the_range() {
        let range = |model, preset: &str, points| {
            let preset = preset.parse().expect("a preset");
            let options = TrainOptions { model, preset, ..TrainOptions::default() };
            job_needs(&summary(8 * 64 * 64, points), None, &options, none()).file_bytes
        };
        // docs/RESULTS.md and docs/LONG_RUNS.md; chair has no points.
        for (model, preset, bytes) in [
            (ModelKind::Tcgs, "preview", [7_471, 186_332]),
            (ModelKind::Tcgs, "standard", [144_283, 370_982]),
            (ModelKind::Scaffold, "preview", [822_059, 3_500_229]),
            (ModelKind::Gaussians3d, "preview", [1_364_007, 7_829_598]),
        ] {
            let ValueRange { low, high } = range(model, preset, None);
            assert!(
                bytes.iter().all(|bytes| (low..=high).contains(bytes)),
                "{model} {preset}: {low}..={high}"
            );
        }
    }

    #[test]
    fn a_target_size_below_what_networks_take_is_refused() {
        let of = |preset: &str, iterations: Option<u32>| TrainOptions {
            preset: preset.parse().expect("a preset"),
            iterations,
            ..TrainOptions::default()
        };
        let mut bounds = Vec::new();
        for options in [of("preview", None), of("standard", None)] {
            let sized = |bytes| TrainOptions { max_bytes: Some(bytes), ..options.clone() };
            let least = least_file_bytes(Schedule::new(&options).shape);
            checked_options(sized(least)).expect("possible by its shape");
            for bytes in [0, 10, least - 1] {
                let error = checked_options(sized(bytes)).expect_err("too small");
                assert_eq!(error.option, "max_bytes");
                assert!(error.error.contains(&least.to_string()), "{}", error.error);
            }
            bounds.push(least);
        }
        // Wider networks take more; the smallest recorded file of `preview` has 5 083 bytes.
        assert!(bounds[0] > 800 && bounds[0] < bounds[1] && bounds[1] < 2000, "{bounds:?}");
        let wrong = TrainOptions { lambda: Some(-1.0), ..TrainOptions::default() };
        assert_eq!(checked_options(wrong).expect_err("no weight").option, "lambda");
    }

    #[test]
    fn a_target_size_bounds_the_file_and_branches_share_their_first_steps() {
        let dataset = summary(8 * 64 * 64, Some(500));
        let sized = TrainOptions { max_bytes: Some(20_000), ..TrainOptions::default() };
        assert_eq!(job_needs(&dataset, None, &sized, none()).file_bytes.high, 20_000);
        let cropped = TrainOptions { crop: Crop::Cameras, ..TrainOptions::default() };
        let [whole, cropped] = [TrainOptions::default(), cropped]
            .map(|options| job_needs(&dataset, None, &options, none()).file_bytes);
        assert!(cropped.low < whole.low && cropped.high == whole.high, "{cropped:?} {whole:?}");
        let curve = TrainOptions { rd_curve: vec![0.001, 0.002, 0.004], ..TrainOptions::default() };
        let needs = job_needs(&dataset, None, &curve, none());
        let fork = u64::from(Schedule::new(&curve).fork_step());
        assert_eq!(needs.steps, fork + 3 * (2000 - fork));
    }
}
