//! Makes the runs of a matrix, one after another, and keeps a record of each at once.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Instant,
};

use tcgs::{
    domain::{
        Camera, Dataset, Digest, ModelKind, Phase, Problem, Progress, SceneFormat, Split, TrainOptions,
    },
    eval::Target,
    gpu::AdapterChoice,
    ingest,
    pipeline::{CheckpointPlan, JobError, JobOutput, Pipeline, ReferenceViews, RunJob as _},
    train::Schedule,
};

use tcgs_lab::report::{
    machine::Machine,
    matrix::PlannedRun,
    record::{Course, ExportRecord, ExternalFile, RunKey, RunRecord},
};

use super::{ADVICE, external_formats};
use crate::cli::{
    CliError, json_lines::JsonLines, memory::MemoryFlags, notice::notice, progress::Display,
    signals::Interruption, wiring,
};

/// Times that a file is decoded again, to know its seconds better.
const DECODES: usize = 3;

/// A set of the suite.
#[derive(Debug)]
pub(super) struct SuiteSet {
    pub(super) path: PathBuf,
    pub(super) digest: Digest,
}

/// What all runs share.
pub(super) struct Runner {
    /// The command's adapter, for runs that name none.
    pub(super) adapter: AdapterChoice,
    /// Weights of LPIPS, read anew for every adapter.
    pub(super) lpips: Option<PathBuf>,
    pub(super) sets: BTreeMap<String, SuiteSet>,
    /// Records that this report writes.
    pub(super) records: JsonLines<RunRecord>,
    /// Records of other reports.
    pub(super) imported: Vec<RunRecord>,
    pub(super) external_formats: Option<PathBuf>,
    pub(super) export_formats: Vec<SceneFormat>,
    /// Views that the renderer is held to the f64 reference on.
    pub(super) reference: ReferenceViews,
    pub(super) session: String,
    pub(super) interruption: Interruption,
}

/// A run that failed, and why.
#[derive(Debug)]
pub(super) struct FailedRun {
    pub(super) run: PlannedRun,
    pub(super) problem: Problem,
}

impl Runner {
    /// The records of all runs of the plan that succeeded, in its order, and those that failed; makes what is missing. Calls `after`
    /// whenever a run is finished.
    pub(super) fn make(
        &mut self,
        plan: &[PlannedRun],
        after: &mut dyn FnMut(&[RunRecord]) -> Result<(), CliError>,
    ) -> Result<(Vec<RunRecord>, Vec<FailedRun>), CliError> {
        let mut position = Position::of(plan, |run| self.kept(run).is_some());
        let (mut done, mut failed) = (Vec::new(), Vec::new());
        let mut pipelines: BTreeMap<String, Pipeline> = BTreeMap::new();
        for run in plan {
            if let Some(record) = self.kept(run) {
                done.push(record.clone());
                continue;
            }
            let adapter = self.adapter_of(run);
            let name = adapter.to_string();
            if !pipelines.contains_key(&name) {
                pipelines.insert(name.clone(), self.pipeline(&adapter)?);
            }
            let Some(pipeline) = pipelines.get(&name) else { continue };
            notice(format_args!("tcgs: run {} of {}: {run}", position.number(), position.runs));
            match self.run(pipeline, &adapter, run, &mut position)? {
                Ok(record) => {
                    done.push(self.records.add(&record)?);
                    after(&done)?;
                }
                Err(problem) => {
                    notice(format_args!("tcgs: {run} failed: {problem}"));
                    failed.push(FailedRun { run: run.clone(), problem });
                }
            }
            position.next(run);
        }
        Ok((done, failed))
    }

    /// The records that there are of the plan's runs.
    pub(super) fn all_kept(&self, plan: &[PlannedRun]) -> Vec<RunRecord> {
        plan.iter().filter_map(|run| self.kept(run).cloned()).collect()
    }

    fn pipeline(&self, adapter: &AdapterChoice) -> Result<Pipeline, CliError> {
        let memory = MemoryFlags::default().limits(1);
        let lpips = wiring::lpips(self.lpips.as_deref())?;
        let pipeline = wiring::runner(adapter, memory, ingest::large_file_dir(), lpips);
        Ok(pipeline.with_reference(Some(self.reference)))
    }

    fn adapter_of(&self, run: &PlannedRun) -> AdapterChoice {
        match &run.adapter {
            // Names of adapters are never refused here, only when one is opened.
            Some(name) => name.parse().unwrap_or_default(),
            None => self.adapter.clone(),
        }
    }

    /// The record of a run that was made before.
    fn kept(&self, run: &PlannedRun) -> Option<&RunRecord> {
        let adapter = self.adapter_of(run).to_string();
        let options = as_kept(&run.options)?;
        let set_name = run.set_name();
        let key = RunKey {
            set: &set_name,
            dataset: self.sets.get(&run.set)?.digest,
            model: &run.model,
            options: &options,
            adapter: &adapter,
        };
        let wants_formats = self.external_formats.is_some() && run.options.model == ModelKind::Gaussians3d;
        self.records
            .all()
            .iter()
            .chain(&self.imported)
            .find(|record| record.is(&key) && !(wants_formats && record.external_formats.is_empty()))
    }

    /// Trains and measures one run; the inner error is the run's own.
    fn run(
        &self,
        pipeline: &Pipeline,
        adapter: &AdapterChoice,
        run: &PlannedRun,
        position: &mut Position,
    ) -> Result<Result<RunRecord, Problem>, CliError> {
        let Some(set) = self.sets.get(&run.set) else {
            return Err(CliError::Usage(format!("there is no set '{}'", run.set)));
        };
        let before = Machine::now();
        let (mut course, mut display) = (Course::default(), Display::new());
        let mut show = |phase: Phase, progress: &Progress| {
            course.add(phase, progress);
            display.show(phase, &position.at(progress));
        };
        let outcome = pipeline.run(
            &set.path,
            &run.options,
            &CheckpointPlan::default(),
            &mut show,
            &self.interruption.cancel,
        );
        display.finish();
        let output = match outcome {
            Ok(output) => output,
            Err(JobError::Cancelled) => return Err(self.interruption.error(ADVICE)),
            Err(JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem)) => {
                return Ok(Err(problem));
            }
        };
        let machine = [before, Machine::now()];
        let measured = match Measured::of(self, adapter, run, &set.path, &output) {
            Ok(measured) => measured,
            Err(failure) => return Ok(Err(failure.problem())),
        };
        let size = |camera: &tcgs::domain::NamedCamera| {
            let intrinsics = camera.camera.intrinsics;
            [intrinsics.width, intrinsics.height]
        };
        Ok(Ok(RunRecord {
            set: run.set_name(),
            dataset: set.digest,
            model: run.model.clone(),
            options: run.options.clone(),
            adapter: adapter.to_string(),
            session: self.session.clone(),
            machine,
            view_size: output.cameras.iter().find(|camera| camera.split == Split::Test).map(size),
            series: course.samples(),
            decode_seconds: measured.decode_seconds,
            render_seconds: measured.render_seconds,
            high_band: measured.high_band,
            exports: measured.exports,
            external_formats: measured.external_formats,
            metrics: output.metrics,
        }))
    }
}

/// What is measured of a finished run besides its metrics.
struct Measured {
    decode_seconds: Vec<f64>,
    render_seconds: Option<f64>,
    high_band: Option<f64>,
    exports: Vec<ExportRecord>,
    external_formats: Vec<ExternalFile>,
}

impl Measured {
    fn of(
        runner: &Runner,
        adapter: &AdapterChoice,
        run: &PlannedRun,
        dataset: &Path,
        output: &JobOutput,
    ) -> Result<Self, CliError> {
        let mut decode_seconds = Vec::new();
        for _ in 0..DECODES {
            let started = Instant::now();
            wiring::read(&output.file)?;
            decode_seconds.push(started.elapsed().as_secs_f64());
        }
        let file = wiring::read(&output.file)?;
        let dataset = wiring::load_as(dataset, &run.options.reading())?;
        let renderer = wiring::SceneViews::open(file.clone(), adapter)?;
        let background = output.metrics.background;
        // The first pass makes kernels and buffers.
        let mut render_seconds = None;
        for _ in 0..2 {
            render_seconds = wiring::render_seconds(&renderer, &dataset)?;
        }
        let high_band = wiring::high_band_error(&renderer, &dataset, background)?;
        let exports = exports(&renderer, &file, &dataset, &runner.export_formats, adapter)?;
        let is_plain = matches!(file.scene, tcgs::domain::Scene::Gaussians(_));
        let script = runner.external_formats.as_deref().filter(|_| is_plain);
        let open = |file| wiring::SceneViews::open(file, adapter);
        let external_formats = external_formats::measure(script, output, &dataset, &open);
        // Hours of training are not lost because another program is missing.
        let external_formats = external_formats.unwrap_or_else(|failure| {
            notice(format_args!("tcgs: note: {run} is kept without other programs' formats: {failure}"));
            Vec::new()
        });
        Ok(Self { decode_seconds, render_seconds, high_band, exports, external_formats })
    }
}

/// Exports a scene to all formats, and measures the results on the held-out views.
fn exports(
    renderer: &wiring::SceneViews,
    file: &wiring::SceneFile,
    dataset: &Dataset,
    formats: &[SceneFormat],
    adapter: &AdapterChoice,
) -> Result<Vec<ExportRecord>, CliError> {
    let Some(first) = formats.first() else { return Ok(Vec::new()) };
    let cameras: Vec<_> = dataset.split(Split::Train).map(|frame| frame.camera).collect();
    let refiner = wiring::Refiner::new(adapter.clone(), u64::MAX);
    let degree = wiring::ExportSettings::whole(*first).degree;
    let plain = wiring::plain(file, degree, Some(&cameras), Some(&refiner))?;
    formats.iter().map(|format| export(renderer, file, dataset, (*format, &plain, &cameras))).collect()
}

/// Exports a scene and measures the result on the held-out views.
fn export(
    renderer: &wiring::SceneViews,
    file: &wiring::SceneFile,
    dataset: &Dataset,
    (format, plain, cameras): (SceneFormat, &wiring::PlainScene, &[Camera]),
) -> Result<ExportRecord, CliError> {
    let settings = wiring::ExportSettings::whole(format);
    let exported = wiring::write_plain(file, plain.clone(), &settings, Some(cameras))?;
    let background = file.background;
    let mut photographs = Vec::new();
    for frame in dataset.split(Split::Test) {
        let photograph = Target::of(frame, background).map_err(Problem::from)?;
        photographs.push((frame.name.clone(), frame.camera, photograph));
    }
    let quality = wiring::compare(renderer, &exported, background, Some(&photographs))?;
    Ok(ExportRecord {
        format,
        bytes: exported.bytes.len() as u64,
        gaussians: exported.gaussians as u64,
        psnr: quality.psnr,
        psnr_to_source: quality.psnr_to_source,
    })
}

/// Options as they read back from a record: parsing does not preserve the last digit of every number.
fn as_kept(options: &TrainOptions) -> Option<TrainOptions> {
    serde_json::from_slice(&serde_json::to_vec(options).ok()?).ok()
}

/// Where the report stands: steps of all runs that are still to be made.
#[derive(Debug)]
struct Position {
    /// Runs in all, and how many of them are settled.
    runs: usize,
    settled: usize,
    steps: u64,
    steps_done: u64,
    started: Instant,
}

impl Position {
    fn of(plan: &[PlannedRun], is_kept: impl Fn(&PlannedRun) -> bool) -> Self {
        let settled = plan.iter().filter(|run| is_kept(run)).count();
        let steps = plan.iter().filter(|run| !is_kept(run)).map(steps).sum();
        Self { runs: plan.len(), settled, steps, steps_done: 0, started: Instant::now() }
    }

    fn number(&self) -> usize {
        self.settled + 1
    }

    fn next(&mut self, run: &PlannedRun) {
        self.settled += 1;
        self.steps_done += steps(run);
    }

    /// The progress of the whole from that of the run in progress.
    fn at(&self, progress: &Progress) -> Progress {
        let step = self.steps_done + progress.step;
        let left = self.steps.saturating_sub(step);
        let elapsed = self.started.elapsed().as_secs_f64();
        let eta_seconds = (step > 0).then(|| elapsed * left as f64 / step as f64);
        Progress { step, total: self.steps, eta_seconds, ..progress.clone() }
    }
}

fn steps(run: &PlannedRun) -> u64 {
    u64::from(Schedule::new(&run.options).steps)
}
