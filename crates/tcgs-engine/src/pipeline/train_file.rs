//! One file: trained from the dataset or a checkpoint, encoded, read back and measured.

use std::sync::Arc;

use super::{
    crop::Kept,
    encode::write_file,
    error::JobError,
    inputs::RunInputs,
    job::{CheckpointPlan, Resume},
    measure::{held_out_psnr, measure},
};
use crate::{
    domain::{
        Crop, CropCost, CropRegion, FailurePoint, JobMetrics, Phase, Progress, SceneFormat, SystemClock,
        TrainOptions, failure_point::reach,
    },
    train::{
        self, BaseQuantSteps, Checkpoint, CheckpointError, CheckpointFolder, CheckpointSink, TrainError,
        Trained,
    },
};

/// One finished file with its figures.
pub(super) struct TrainedFile {
    pub(super) file: Vec<u8>,
    pub(super) format: SceneFormat,
    pub(super) metrics: JobMetrics,
}

/// Trains, writes and measures one file. A run for which there is no checkpoint begins at `start`.
pub(super) fn train_file(
    inputs: &RunInputs<'_>,
    options: &TrainOptions,
    checkpoints: &CheckpointPlan,
    start: Option<Checkpoint>,
    report: &mut dyn FnMut(Phase, &Progress),
) -> Result<TrainedFile, JobError> {
    let mut progress = Progress::default();
    let mut report_training = |now: &Progress| {
        progress = now.clone();
        report(Phase::Train, now);
    };
    let mut trained = with_checkpoints(inputs, checkpoints, start, &mut |checkpoints| {
        inputs.trainer(options).with_checkpoints(checkpoints).run(&mut report_training)
    })?;
    // Training's estimate of the time left does not cover what follows it.
    progress.eta_seconds = None;
    report(Phase::Encode, &progress);
    reach(FailurePoint::BeforeEncode);
    let heartbeat = &mut || report(Phase::Encode, &progress);
    let whole = WholeFile::before_crop(inputs, options, &mut trained, heartbeat)?;
    let steps = whole.as_ref().and_then(|whole| whole.quant_steps);
    let written = write_file(inputs, options, &trained, steps, heartbeat)?;
    reach(FailurePoint::AfterEncode);
    report(Phase::Evaluate, &progress);
    let metrics = measure(inputs, options.background, &trained, &written, &mut || {
        report(Phase::Evaluate, &progress);
    })?;
    let crop = whole.map(|whole| whole.cost_of_crop(options.crop, &metrics));
    let metrics = JobMetrics { conventions: metrics.conventions.of(options.holdout), crop, ..metrics };
    Ok(TrainedFile { file: written.bytes, format: written.file.format, metrics })
}

/// The figures of the file that a scene has before it is cropped.
struct WholeFile {
    bytes: u64,
    gaussians: u64,
    psnr: Option<f64>,
    quant_steps: Option<BaseQuantSteps>,
}

impl WholeFile {
    /// Crops a trained scene as the options say, after the file of the whole was written and measured; `None` without a crop. Both are
    /// encoded with the same quantization steps, if training left none. A target size bounds the cropped file alone.
    fn before_crop(
        inputs: &RunInputs<'_>,
        options: &TrainOptions,
        trained: &mut Trained,
        heartbeat: &mut dyn FnMut(),
    ) -> Result<Option<Self>, JobError> {
        let Some(region) = CropRegion::of_dataset(&options.crop, inputs.dataset) else { return Ok(None) };
        let kept = Kept::of(&trained.scene, &region, &options.crop).map_err(JobError::Fail)?;
        let uncropped = TrainOptions { crop: Crop::None, max_bytes: None, ..options.clone() };
        let whole = write_file(inputs, &uncropped, trained, None, heartbeat)?;
        let psnr = held_out_psnr(inputs, options.background, &whole.file, heartbeat)?;
        kept.apply(trained);
        Ok(Some(Self {
            bytes: whole.bytes.len() as u64,
            gaussians: whole.file.scene.gaussians() as u64,
            psnr,
            quant_steps: whole.quant_steps,
        }))
    }

    /// What the crop saved and cost, by the figures of the cropped file.
    fn cost_of_crop(&self, region: Crop, cropped: &JobMetrics) -> CropCost {
        CropCost {
            region,
            gaussians_removed: self.gaussians.saturating_sub(cropped.gaussians),
            saved_bytes: self.bytes as i64 - cropped.bytes.total as i64,
            lost_psnr: self.psnr.zip(cropped.test.psnr).map(|(whole, cropped)| whole - cropped),
        }
    }
}

/// Runs `train` from a checkpoint if there is one to resume from, else from `start`.
pub(super) fn with_checkpoints<T>(
    inputs: &RunInputs<'_>,
    checkpoints: &CheckpointPlan,
    start: Option<Checkpoint>,
    train: &mut dyn FnMut(train::Checkpoints<'_>) -> Result<T, TrainError>,
) -> Result<T, JobError> {
    let mut folder = match &checkpoints.keep {
        Some(path) => match CheckpointFolder::open(path, Arc::new(SystemClock)) {
            Ok(folder) => Some(match inputs.checkpoint_every {
                Some(every) => folder.every(every),
                None => folder,
            }),
            // Only an interruption would need checkpoints, so their absence must not fail the job.
            Err(error) => {
                tracing::warn!("no checkpoints are kept: {error}");
                None
            }
        },
        None => None,
    };
    let mut train = |resume: Option<Checkpoint>| {
        let sink = folder.as_mut().map(|folder| folder as &mut dyn CheckpointSink);
        train(train::Checkpoints { resume, sink })
    };
    let load = |path| CheckpointFolder::load(path).map_err(TrainError::from);
    let trained = match &checkpoints.resume {
        Resume::Fresh => train(start),
        Resume::From(path) => load(path).and_then(|checkpoint| train(Some(checkpoint))),
        Resume::IfPossible(path) => match load(path).and_then(|checkpoint| train(Some(checkpoint))) {
            Err(TrainError::Checkpoint(CheckpointError::Missing(_))) => train(start),
            Err(TrainError::Checkpoint(error)) => {
                tracing::warn!("the run starts over: {error}");
                train(start)
            }
            other => other,
        },
    };
    Ok(trained?)
}
