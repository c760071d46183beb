//! One job from dataset to measured file: ingest, train, write, read back, evaluate.
//!
//! The kind of file follows the model: `tcgs` is quantised and coded, the baselines are written as floats. The figures
//! that are reported are those of the file as read from its own bytes.

use std::{
    cell::RefCell,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread,
    time::Instant,
};

use tracing::Span;

use super::{
    curve::run_curve,
    fit_bytes::{Budgeted, Draft, fit_bytes},
    held_out::{SheetError, held_out},
    run::{Checkpoints, JobFailure, JobOutput, Resume, RunJob},
    scene_file::{self, SceneFile},
    steps::choose_steps,
};
use crate::{
    codec::{
        self, ContextChoice, ContextSearch, ContextSettings, DecodeLimits, EncodeSettings, Encoded,
        Provenance,
    },
    domain::{
        AnchorScene, ByteBudget, CancelFlag, CodingEfficiency, Conventions, Dataset, Frame, GroupOctaves,
        HeldOut, JobMetrics, MemoryBudget, MemoryLimits, ModelKind, NamedCamera, Phase, PhaseSeconds,
        Problem, Progress, Scene, SceneFormat, Scores, Split, SystemClock, TrainOptions,
    },
    eval::{Lpips, mean_scores_with, measure_views_with},
    gpu::{AdapterChoice, Context, GpuError},
    ingest::{self, Fault, Room},
    render::{RenderError, SceneRenderer},
    store::is_disk_full,
    train::{
        self, BaseSteps, Checkpoint, CheckpointError, CheckpointFolder, KeepCheckpoints, Schedule,
        TrainError, Trained, TrainedContext, train_within,
    },
};

/// Training views that the reported training figures are measured on, evenly spread.
const TRAIN_VIEWS_MEASURED: usize = 16;

/// Training views that decide how finely to quantise.
const STEP_VIEWS: usize = 4;

/// Training views that files of a promised size are judged by.
const JUDGED_VIEWS: usize = 8;

/// Training views that tell what each Gaussian is worth where a size was promised.
const PROBED_VIEWS: usize = 64;

/// Carries jobs out on an adapter, which is opened for the first job and again after it was lost.
#[derive(Debug)]
pub struct Pipeline {
    choice: AdapterChoice,
    memory: MemoryLimits,
    spill: PathBuf,
    lpips: Option<Lpips>,
    pictures: bool,
    context: Mutex<Option<Arc<Context>>>,
}

impl Pipeline {
    /// A pipeline on the adapter of choice, without limits on memory but the machine's.
    #[must_use]
    pub fn new(choice: AdapterChoice) -> Self {
        let spill = std::env::temp_dir();
        let context = Mutex::new(None);
        Self { choice, memory: MemoryLimits::NONE, spill, lpips: None, pictures: false, context }
    }

    /// Within `memory`; photographs that do not fit go to a temporary file in the folder `spill`.
    #[must_use]
    pub fn within(self, memory: MemoryLimits, spill: PathBuf) -> Self {
        Self { memory, spill, ..self }
    }

    /// The same, which also measures LPIPS if there are weights for it.
    #[must_use]
    pub fn with_lpips(self, lpips: Option<Lpips>) -> Self {
        Self { lpips, ..self }
    }

    /// The same, which also makes pictures of held-out views ([`JobOutput::held_out`]).
    #[must_use]
    pub fn with_pictures(self) -> Self {
        Self { pictures: true, ..self }
    }

    fn context(&self) -> Result<Arc<Context>, GpuError> {
        let mut kept = self.context.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(context) = kept.as_ref().filter(|context| context.check().is_ok()) {
            return Ok(Arc::clone(context));
        }
        let context = Context::new(&self.choice)?;
        context.set_budget_bytes(self.budget(&context).gpu);
        *kept = Some(Arc::clone(&context));
        Ok(context)
    }
}

impl Pipeline {
    fn budget(&self, context: &Context) -> MemoryBudget {
        self.memory.budget(context.adapter().shares_main_memory())
    }
}

impl RunJob for Pipeline {
    fn run(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        checkpoints: &Checkpoints,
        report: &mut dyn FnMut(Phase, &Progress),
        cancel: &CancelFlag,
    ) -> Result<JobOutput, JobFailure> {
        let began = Instant::now();
        let total = u64::from(Schedule::new(options).steps);
        let latest = RefCell::new(Progress::default());
        let mut tell = |phase: Phase, progress: &Progress| {
            latest.replace(progress.clone());
            let elapsed_seconds = began.elapsed().as_secs_f64();
            report(phase, &Progress { elapsed_seconds, ..progress.clone() });
        };
        let start = Progress { total, ..Progress::default() };
        tell(Phase::Ingest, &start);
        // How much memory photographs may take depends on whether the adapter has its own.
        let context = self.context().map_err(from_gpu)?;
        let budget = self.budget(&context);
        // Training needs the other half.
        let room = Room { memory: budget.host / 2, spill: self.spill.clone() };
        let dataset = load(dataset, &room, &mut || tell(Phase::Ingest, &start), cancel)?;
        for note in &dataset.notes {
            tracing::info!("dataset: {note}");
        }
        let ingest = began.elapsed().as_secs_f64();
        stop_if(cancel)?;
        // The first report of the training comes some steps after its begin, which may be minutes.
        tell(Phase::Train, &start);
        let lpips = self.lpips.as_ref();
        let site = Site { context, dataset: &dataset, budget, cancel, lpips, ingest };
        let (Product { file, format, metrics }, others) = if options.rd_curve.is_empty() {
            (site.product(options, checkpoints, None, &mut tell)?, Vec::new())
        } else {
            run_curve(&site, options, checkpoints, &mut tell)?
        };
        let held_out = if self.pictures {
            let end = latest.borrow().clone();
            site.pictures(&file, &metrics, &mut || tell(Phase::Evaluate, &end))?
        } else {
            None
        };
        let cameras = dataset
            .frames
            .iter()
            .map(|frame| NamedCamera { name: frame.name.clone(), split: frame.split, camera: frame.camera })
            .collect();
        Ok(JobOutput { file, format, others, metrics, cameras, held_out })
    }
}

/// Reads the dataset on a thread of its own, so that this one can tell of every image, and stops soon after `cancel`.
fn load(
    dataset: &Path,
    room: &Room,
    alive: &mut dyn FnMut(),
    cancel: &CancelFlag,
) -> Result<Dataset, JobFailure> {
    let (send, images) = mpsc::channel();
    let span = Span::current();
    let loaded = thread::scope(|scope| {
        let loading = scope.spawn(move || {
            let _of_the_job = span.entered();
            let go_on = || {
                // Whoever listens does so until this thread ends.
                let _ = send.send(());
                !cancel.is_cancelled()
            };
            ingest::load_watched(dataset, room, &go_on)
        });
        for () in images {
            alive();
        }
        loading.join()
    });
    match loaded {
        Ok(loaded) => loaded.map_err(from_ingest),
        Err(panic) => resume_unwind(panic),
    }
}

/// One finished file.
pub(super) struct Product {
    pub(super) file: Vec<u8>,
    pub(super) format: SceneFormat,
    pub(super) metrics: JobMetrics,
}

/// What all branches of a job share.
pub(super) struct Site<'a> {
    pub(super) context: Arc<Context>,
    pub(super) dataset: &'a Dataset,
    pub(super) budget: MemoryBudget,
    pub(super) cancel: &'a CancelFlag,
    lpips: Option<&'a Lpips>,
    /// Seconds that the dataset took to read.
    ingest: f64,
}

impl Site<'_> {
    /// Trains, writes and measures one file. A run for which there is no checkpoint begins at `start`.
    pub(super) fn product(
        &self,
        options: &TrainOptions,
        checkpoints: &Checkpoints,
        start: Option<Checkpoint>,
        tell: &mut dyn FnMut(Phase, &Progress),
    ) -> Result<Product, JobFailure> {
        let mut progress = Progress::default();
        let mut passed_on = |now: &Progress| {
            progress = now.clone();
            tell(Phase::Train, now);
        };
        let trained = self.resumed(checkpoints, start, &mut |checkpoints| {
            let Self { context, dataset, budget, cancel, .. } = self;
            train_within(context, dataset, options, budget, checkpoints, &mut passed_on, cancel)
        })?;
        let seconds = PhaseSeconds { ingest: self.ingest, train: trained.seconds, ..PhaseSeconds::default() };
        // What training told of the time left says nothing about what follows it.
        progress.eta_seconds = None;
        let (context, dataset, cancel) = (Arc::clone(&self.context), self.dataset, self.cancel);
        let mut job = Job { context, dataset, options, cancel, lpips: self.lpips, seconds };
        tell(Phase::Encode, &progress);
        let Written { bytes, file, budget: byte_budget, coding } =
            job.write(&trained, &mut || tell(Phase::Encode, &progress))?;
        tell(Phase::Evaluate, &progress);
        let metrics =
            job.measure(trained.steps, &trained.scene, &file, &mut || tell(Phase::Evaluate, &progress))?;
        Ok(Product {
            file: bytes,
            format: file.format,
            metrics: JobMetrics { byte_budget, coding, ..metrics },
        })
    }

    /// Pictures of held-out views of a finished file, or none where something stands against them: a job must not fail for
    /// want of what only its report shows.
    fn pictures(
        &self,
        file: &[u8],
        metrics: &JobMetrics,
        alive: &mut dyn FnMut(),
    ) -> Result<Option<HeldOut>, JobFailure> {
        let mut make = || -> Result<Option<HeldOut>, String> {
            let file = scene_file::read(file).map_err(|fault| fault.detail)?;
            let frames: Vec<&Frame> = self.dataset.split(Split::Test).collect();
            let mut renderer = SceneRenderer::of_scene(&self.context, &file.scene, file.background)
                .map_err(|fault| fault.to_string())?;
            let mut go_on = || {
                alive();
                !self.cancel.is_cancelled()
            };
            let pictures = held_out(&mut renderer, &frames, &metrics.test, file.background, &mut go_on);
            pictures.map_err(|fault: SheetError| fault.to_string())
        };
        let pictures = make().unwrap_or_else(|fault| {
            tracing::warn!("the report will have no held-out views: {fault}");
            None
        });
        stop_if(self.cancel)?;
        Ok(pictures)
    }

    /// Trains by `attempt`, from a checkpoint where there is one to go on from, else from `start`.
    pub(super) fn resumed<T>(
        &self,
        checkpoints: &Checkpoints,
        start: Option<Checkpoint>,
        attempt: &mut dyn FnMut(train::Checkpoints<'_>) -> Result<T, TrainError>,
    ) -> Result<T, JobFailure> {
        let mut folder = match &checkpoints.keep {
            Some(path) => match CheckpointFolder::open(path, Arc::new(SystemClock)) {
                Ok(folder) => Some(folder),
                // A job must not fail for want of what only an interruption would need.
                Err(fault) => {
                    tracing::warn!("no checkpoints are kept: {fault}");
                    None
                }
            },
            None => None,
        };
        let mut attempt = |resume: Option<Checkpoint>| {
            let keep = folder.as_mut().map(|folder| folder as &mut dyn KeepCheckpoints);
            attempt(train::Checkpoints { resume, keep })
        };
        let load = |path| CheckpointFolder::load(path).map_err(TrainError::from);
        let trained = match &checkpoints.resume {
            Resume::Fresh => attempt(start),
            Resume::From(path) => load(path).and_then(|checkpoint| attempt(Some(checkpoint))),
            Resume::IfPossible(path) => match load(path).and_then(|checkpoint| attempt(Some(checkpoint))) {
                Err(TrainError::Checkpoint(CheckpointError::Missing(_))) => attempt(start),
                Err(TrainError::Checkpoint(fault)) => {
                    tracing::warn!("the run starts over: {fault}");
                    attempt(start)
                }
                other => other,
            },
        };
        trained.map_err(from_training)
    }
}

/// A file as it was written, and as it reads.
struct Written {
    bytes: Vec<u8>,
    file: SceneFile,
    budget: Option<ByteBudget>,
    coding: Option<CodingEfficiency>,
}

/// What the stages after training share.
struct Job<'a> {
    context: Arc<Context>,
    dataset: &'a Dataset,
    options: &'a TrainOptions,
    cancel: &'a CancelFlag,
    lpips: Option<&'a Lpips>,
    seconds: PhaseSeconds,
}

impl Job<'_> {
    /// Writes the file and reads it back.
    fn write(&mut self, trained: &Trained, alive: &mut dyn FnMut()) -> Result<Written, JobFailure> {
        let began = Instant::now();
        let (background, dataset) = (self.options.background, Some(self.dataset.digest));
        let (bytes, budget, context) = match (&trained.scene, self.options.model) {
            (Scene::Anchors(scene), ModelKind::Scaffold) => {
                let bytes =
                    scene_file::write_anchors(scene, background, dataset).map_err(JobFailure::Fail)?;
                (bytes, None, None)
            }
            (Scene::Anchors(scene), _) => {
                let (encoded, budget) = self.encode(scene, trained.context.as_ref(), alive)?;
                (encoded.bytes, budget, Some(encoded.context))
            }
            (Scene::Gaussians(scene), _) => {
                (scene_file::write_gaussians(scene, background, dataset), None, None)
            }
        };
        self.seconds.encode = began.elapsed().as_secs_f64();
        let began = Instant::now();
        let file = scene_file::read(&bytes).map_err(|fault| JobFailure::Fail(internal(&fault.detail)))?;
        self.seconds.decode = began.elapsed().as_secs_f64();
        let coding = match context {
            // The float networks speak of the steps of training.
            Some(choice) => {
                let as_trained =
                    budget.is_none_or(|budget| budget.coarser_octaves == GroupOctaves::default());
                coding(&bytes, trained.context.as_ref().filter(|_| as_trained), &choice)?
            }
            None => None,
        };
        Ok(Written { bytes, file, budget, coding })
    }

    /// Codes, with the steps that the scene was trained with, within the bytes that were promised. Where it was not trained
    /// with any, chooses how finely to quantise.
    fn encode(
        &self,
        scene: &AnchorScene,
        context: Option<&TrainedContext>,
        alive: &mut dyn FnMut(),
    ) -> Result<(Encoded, Option<ByteBudget>), JobFailure> {
        let background = self.options.background;
        let seen = |wanted| spread(self.dataset.split(Split::Train).collect(), wanted);
        let steps = match context {
            Some(context) => context.steps,
            None => choose_steps(&self.context, scene, &seen(STEP_VIEWS), background, &mut || {
                alive();
                !self.cancel.is_cancelled()
            })
            .map_err(from_render)?,
        };
        stop_if(self.cancel)?;
        let mut write = |draft: Draft<'_>| self.write_draft(draft, steps, context);
        let Some(limit) = self.options.max_bytes else {
            let draft = Draft { scene, coarser: [0; 3], search: ContextSearch::Cheapest, stated: None };
            return Ok((write(draft)?, None));
        };
        let budgeted = Budgeted {
            context: &self.context,
            scene,
            steps: [steps.feature, steps.scaling * scene.lattice.voxel, steps.offset],
            judged: &seen(JUDGED_VIEWS),
            probed: &seen(PROBED_VIEWS),
            background,
            limit,
        };
        let mut go_on = || {
            alive();
            stop_if(self.cancel)
        };
        let (encoded, budget) = fit_bytes(&budgeted, &mut write, &mut go_on, from_render)?;
        Ok((encoded, Some(budget)))
    }

    fn write_draft(
        &self,
        draft: Draft<'_>,
        steps: BaseSteps,
        context: Option<&TrainedContext>,
    ) -> Result<Encoded, JobFailure> {
        let Draft { scene, coarser, search, stated } = draft;
        let options = TrainOptions { max_bytes: stated, ..self.options.clone() };
        let settings = EncodeSettings {
            background: self.options.background,
            feature_step: steps.feature,
            scaling_step: steps.scaling,
            offset_step: steps.offset,
            context: ContextSettings { search, coarser },
            provenance: Provenance {
                generator: concat!("tcgs ", env!("CARGO_PKG_VERSION")).to_owned(),
                dataset: Some(self.dataset.digest),
                adapter: Some(self.context.adapter_line()),
                settings: serde_json::to_value(options)
                    .map_err(|fault| JobFailure::Fail(internal(&fault.to_string())))?,
            },
        };
        codec::encode(scene, context.map(|context| &context.candidates), &settings).map_err(|fault| {
            JobFailure::Fail(Problem::new(422, "not-encodable", "Encoding failed", fault.to_string()))
        })
    }

    /// Measures the scene of the file, and the held-out views of the scene before it was quantised, if it was.
    fn measure(
        &self,
        steps: u32,
        trained: &Scene,
        file: &SceneFile,
        alive: &mut dyn FnMut(),
    ) -> Result<JobMetrics, JobFailure> {
        let held_out: Vec<&Frame> = self.dataset.split(Split::Test).collect();
        let seen = spread(self.dataset.split(Split::Train).collect(), TRAIN_VIEWS_MEASURED);
        let test = self.score(&file.scene, &held_out, self.lpips, alive)?;
        let before = if *trained == file.scene {
            test.psnr
        } else {
            self.score(trained, &held_out, None, alive)?.psnr
        };
        Ok(JobMetrics {
            test,
            train: self.score(&file.scene, &seen, self.lpips, alive)?,
            bytes: file.byte_counts.clone(),
            seconds: self.seconds.clone(),
            steps: u64::from(steps),
            steps_per_second: f64::from(steps) / self.seconds.train.max(1e-9),
            anchors: file.scene.anchors() as u64,
            gaussians: file.scene.gaussians() as u64,
            psnr_before_quantisation: before,
            decode_sha256: file.decode_sha256,
            adapter: self.context.adapter_line(),
            background: self.options.background,
            conventions: Conventions::new(self.lpips.map(Lpips::network)),
            byte_budget: None,
            coding: None,
            rd_curve: Vec::new(),
        })
    }

    fn score(
        &self,
        scene: &Scene,
        frames: &[&Frame],
        lpips: Option<&Lpips>,
        alive: &mut dyn FnMut(),
    ) -> Result<Scores, JobFailure> {
        let mut renderer =
            SceneRenderer::of_scene(&self.context, scene, self.options.background).map_err(from_render)?;
        let mut views = Vec::with_capacity(frames.len());
        for frame in frames {
            stop_if(self.cancel)?;
            alive();
            views.extend(
                measure_views_with(&mut renderer, &[*frame], self.options.background, lpips)
                    .map_err(from_render)?,
            );
        }
        Ok(mean_scores_with(&views, lpips.map(Lpips::network)))
    }
}

/// At most `wanted` of the frames, evenly spread.
fn spread(frames: Vec<&Frame>, wanted: usize) -> Vec<&Frame> {
    let count = frames.len().min(wanted);
    (0..count).map(|index| frames[index * frames.len() / count]).collect()
}

/// How near the file comes to what its model allows; none where it codes nothing.
fn coding(
    bytes: &[u8],
    context: Option<&TrainedContext>,
    choice: &ContextChoice,
) -> Result<Option<CodingEfficiency>, JobFailure> {
    let trained = context.map(|context| (&context.candidates, choice));
    let efficiency = codec::efficiency(bytes, &DecodeLimits::NONE, trained)
        .map_err(|fault| JobFailure::Fail(internal(&fault.to_string())))?;
    let over_ideal = efficiency.over_ideal();
    Ok(over_ideal.is_finite().then(|| CodingEfficiency { over_ideal, over_floats: efficiency.over_floats() }))
}

fn stop_if(cancel: &CancelFlag) -> Result<(), JobFailure> {
    if cancel.is_cancelled() { Err(JobFailure::Cancelled) } else { Ok(()) }
}

pub(super) fn internal(detail: &str) -> Problem {
    Problem::new(500, "internal", "Internal error", detail)
}

/// A disk that is full has room some day, and one that failed may work again; a dataset does not change.
fn from_ingest(error: ingest::Error) -> JobFailure {
    match error.fault {
        Fault::Stopped => JobFailure::Cancelled,
        Fault::SpillFull { .. } => JobFailure::Hold(error.into()),
        Fault::Io(ref fault) if is_disk_full(fault) => JobFailure::Hold(error.into()),
        Fault::Spill(_) => JobFailure::Retry(error.into()),
        _ => JobFailure::Fail(error.into()),
    }
}

/// A device that failed may work again; a scene that is too large for it will not shrink.
fn from_gpu(fault: GpuError) -> JobFailure {
    match fault {
        GpuError::DeviceLost(_) | GpuError::Timeout { .. } | GpuError::Rejected(_) => {
            JobFailure::Retry(fault.into())
        }
        GpuError::NoAdapter { .. }
        | GpuError::Open { .. }
        | GpuError::Kernel { .. }
        | GpuError::BufferTooLarge { .. }
        | GpuError::OverBudget { .. } => JobFailure::Fail(fault.into()),
    }
}

fn from_render(fault: RenderError) -> JobFailure {
    match fault {
        RenderError::Gpu(fault) => from_gpu(fault),
        RenderError::Photograph(fault) => JobFailure::Retry(fault.into()),
        other => JobFailure::Fail(other.into()),
    }
}

pub(super) fn from_training(fault: TrainError) -> JobFailure {
    match fault {
        TrainError::Cancelled => JobFailure::Cancelled,
        TrainError::Gpu(fault) => from_gpu(fault),
        TrainError::Render(fault) => from_render(fault),
        TrainError::Photograph(fault) => JobFailure::Retry(fault.into()),
        other => JobFailure::Fail(other.into()),
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn a_disk_without_room_holds_a_job_and_a_broken_one_costs_it_an_attempt() {
        let spill = |kind: io::ErrorKind| Fault::Spill(kind.into());
        for (fault, expected) in [
            (Fault::SpillFull { bytes: 3 }, "hold"),
            (Fault::Io(io::ErrorKind::StorageFull.into()), "hold"),
            (Fault::Io(io::ErrorKind::QuotaExceeded.into()), "hold"),
            (spill(io::ErrorKind::PermissionDenied), "retry"),
            (Fault::NoImages, "fail"),
            (Fault::Io(io::ErrorKind::InvalidData.into()), "fail"),
            (Fault::Stopped, "cancelled"),
        ] {
            let said = fault.to_string();
            let came = match from_ingest(fault.into()) {
                JobFailure::Hold(_) => "hold",
                JobFailure::Retry(_) => "retry",
                JobFailure::Fail(_) => "fail",
                JobFailure::Cancelled => "cancelled",
            };
            assert_eq!(came, expected, "{said}");
        }
    }
}
