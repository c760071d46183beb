//! One job from dataset to measured file: ingest, train, encode, read back, evaluate.
//!
//! The reported figures are those of the file as read back from its own bytes.

mod branches;
mod calibrate;
mod crop;
mod curve;
mod encode;
mod error;
mod estimate;
pub mod exported;
mod held_out;
mod inputs;
mod job;
mod measure;
mod plain_scene;
mod quant_steps;
pub mod scene_file;
pub mod scene_views;
mod size_fit;
mod stages;
mod train_file;

use std::{
    cell::RefCell,
    collections::BTreeMap,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread,
    time::Instant,
};

use jiff::SignedDuration;
use tracing::Span;

pub use calibrate::Calibration;
pub use encode::encode;
pub use error::JobError;
pub use estimate::{Machine, checked_options, job_needs};
pub use held_out::preview_file;
pub use inputs::ReferenceViews;
pub use job::{CheckpointPlan, CurveFile, JobOutput, Resume, RunJob};

use self::{
    curve::run_curve,
    held_out::{FilePictures, pictures_or_warn},
    inputs::RunInputs,
    train_file::{TrainedFile, train_file},
};
use crate::{
    domain::{
        CancelFlag, CropRegion, Dataset, FailurePoint, MemoryBudget, MemoryLimits, NamedCamera, Phase,
        Progress, ReadOptions, TrainOptions, failure_point::reach,
    },
    eval::PerceptualDistance,
    gpu::{AdapterChoice, Device, DeviceSettings, GpuError, Profile, RecordingProfile},
    ingest::{self, LoadBudget, large_file_dir},
    train::Schedule,
};

/// Runs jobs on an adapter, which is opened for the first job and again after it was lost.
#[derive(Debug)]
pub struct Pipeline {
    adapter: AdapterChoice,
    memory: MemoryLimits,
    spill_dir: PathBuf,
    lpips: Option<Box<dyn PerceptualDistance>>,
    has_pictures: bool,
    reference: Option<ReferenceViews>,
    checkpoint_every: Option<SignedDuration>,
    has_profile: bool,
    device: Mutex<Option<Arc<Device>>>,
}

impl Pipeline {
    /// A pipeline on the chosen adapter, limited only by the machine's memory.
    #[must_use]
    pub fn new(adapter: AdapterChoice) -> Self {
        Self {
            adapter,
            memory: MemoryLimits::NONE,
            spill_dir: large_file_dir(),
            lpips: None,
            has_pictures: false,
            reference: None,
            checkpoint_every: None,
            has_profile: false,
            device: Mutex::new(None),
        }
    }

    /// Within `memory`; photographs that do not fit go to a temporary file in `spill_dir`.
    #[must_use]
    pub fn within(self, memory: MemoryLimits, spill_dir: PathBuf) -> Self {
        Self { memory, spill_dir, ..self }
    }

    /// Also measures LPIPS, if there is a measure of it.
    #[must_use]
    pub fn with_lpips(self, lpips: Option<Box<dyn PerceptualDistance>>) -> Self {
        Self { lpips, ..self }
    }

    /// Also makes pictures: previews while it trains, whose reports then have figures of the model as it is, and of the result
    /// ([`JobOutput::held_out`], [`JobOutput::thumbnail`]).
    #[must_use]
    pub fn with_pictures(self) -> Self {
        Self { has_pictures: true, ..self }
    }

    /// Also holds the renderer to the f64 reference on these views ([`JobMetrics::rendering`](crate::domain::JobMetrics)).
    #[must_use]
    pub fn with_reference(self, reference: Option<ReferenceViews>) -> Self {
        Self { reference, ..self }
    }

    /// With another time between two checkpoints than the usual one.
    #[must_use]
    pub fn with_checkpoints_every(self, checkpoint_every: Option<SignedDuration>) -> Self {
        Self { checkpoint_every, ..self }
    }

    /// Keeps a profile of the device, which makes runs slower and changes no result.
    #[must_use]
    pub fn with_profile(self, has_profile: bool) -> Self {
        Self { has_profile, ..self }
    }

    /// Times of all recordings by label since the device was opened; none without [`Pipeline::with_profile`].
    #[must_use]
    pub fn profile(&self) -> BTreeMap<String, RecordingProfile> {
        let device = self.device.lock().unwrap_or_else(PoisonError::into_inner);
        device.as_ref().and_then(|device| device.profile()).map(Profile::recordings).unwrap_or_default()
    }

    fn device(&self) -> Result<Arc<Device>, GpuError> {
        let mut kept = self.device.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(device) = kept.as_ref().filter(|device| device.check().is_ok()) {
            return Ok(Arc::clone(device));
        }
        let settings = DeviceSettings { profile: self.has_profile, ..DeviceSettings::default() };
        let device = Device::with_settings(&self.adapter, &settings)?;
        device.set_budget_bytes(self.budget(&device).gpu);
        *kept = Some(Arc::clone(&device));
        Ok(device)
    }

    fn budget(&self, device: &Device) -> MemoryBudget {
        self.memory.budget(device.adapter().shares_main_memory())
    }
}

impl RunJob for Pipeline {
    fn run(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        checkpoints: &CheckpointPlan,
        report: &mut dyn FnMut(Phase, &Progress),
        cancel: &CancelFlag,
    ) -> Result<JobOutput, JobError> {
        let started = Instant::now();
        let total = u64::from(Schedule::new(options).steps);
        let latest = RefCell::new(Progress::default());
        let mut report = |phase: Phase, progress: &Progress| {
            latest.replace(progress.clone());
            let elapsed_seconds = started.elapsed().as_secs_f64();
            report(phase, &Progress { elapsed_seconds, ..progress.clone() });
        };
        let start = Progress { total, ..Progress::default() };
        report(Phase::Ingest, &start);
        // How much memory photographs may take depends on whether the adapter has its own.
        let device = self.device()?;
        let budget = self.budget(&device);
        // Training needs the other half.
        let load_budget = LoadBudget { memory_bytes: budget.host / 2, spill_dir: self.spill_dir.clone() };
        let reading = options.reading();
        let dataset = load(dataset, &reading, &load_budget, &mut || report(Phase::Ingest, &start), cancel)?;
        for note in &dataset.notes {
            tracing::info!("dataset: {note}");
        }
        let ingest_seconds = started.elapsed().as_secs_f64();
        let lpips = self.lpips.as_deref();
        let Self { reference, checkpoint_every, .. } = *self;
        let inputs = RunInputs {
            device,
            dataset: &dataset,
            budget,
            cancel,
            lpips,
            reference,
            checkpoint_every,
            is_watched: self.has_pictures,
            ingest_seconds,
        };
        inputs.check_cancelled()?;
        if let Some(region) = CropRegion::of_dataset(&options.crop, &dataset) {
            crop::check_points(&region, &options.crop, dataset.points.as_ref()).map_err(JobError::Fail)?;
        }
        // Training's first own report follows after some steps, which may take minutes.
        report(Phase::Train, &start);
        let (TrainedFile { file, format, metrics }, others) = if options.rd_curve.is_empty() {
            (train_file(&inputs, options, checkpoints, None, &mut report)?, Vec::new())
        } else {
            run_curve(&inputs, options, checkpoints, &mut report)?
        };
        let FilePictures { held_out, thumbnail } = if self.has_pictures {
            let end = latest.borrow().clone();
            pictures_or_warn(&inputs, &file, &metrics.test, &mut || report(Phase::Evaluate, &end))?
        } else {
            FilePictures::default()
        };
        let cameras = dataset
            .frames
            .iter()
            .map(|frame| NamedCamera { name: frame.name.clone(), split: frame.split, camera: frame.camera })
            .collect();
        Ok(JobOutput { file, format, others, metrics, cameras, held_out, thumbnail })
    }
}

/// Reads the dataset on a thread of its own, so that this one can report each image; stops soon after `cancel`.
fn load(
    dataset: &Path,
    reading: &ReadOptions,
    load_budget: &LoadBudget,
    heartbeat: &mut dyn FnMut(),
    cancel: &CancelFlag,
) -> Result<Dataset, JobError> {
    let (send, images) = mpsc::channel();
    let span = Span::current();
    let loaded = thread::scope(|scope| {
        let loading = scope.spawn(move || {
            let _entered = span.entered();
            let go_on = || {
                // The receiver lives until this thread ends.
                let _ = send.send(());
                !cancel.is_cancelled()
            };
            ingest::load_as(dataset, reading, load_budget, &go_on)
        });
        for () in images {
            reach(FailurePoint::Ingest);
            heartbeat();
        }
        loading.join()
    });
    match loaded {
        Ok(loaded) => Ok(loaded?),
        Err(panic) => resume_unwind(panic),
    }
}
