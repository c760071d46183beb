//! One file: trained from the dataset or a checkpoint, encoded, read back and measured.

use std::sync::Arc;

use super::{
    encode::write_file,
    error::JobError,
    inputs::RunInputs,
    job::{CheckpointPlan, Resume},
    measure::measure,
};
use crate::{
    domain::{
        FailurePoint, JobMetrics, Phase, Progress, SceneFormat, SystemClock, TrainOptions,
        failure_point::reach,
    },
    train::{self, Checkpoint, CheckpointError, CheckpointFolder, CheckpointSink, TrainError},
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
    let trained = with_checkpoints(inputs, checkpoints, start, &mut |checkpoints| {
        inputs.trainer(options).with_checkpoints(checkpoints).run(&mut report_training)
    })?;
    // Training's estimate of the time left does not cover what follows it.
    progress.eta_seconds = None;
    report(Phase::Encode, &progress);
    reach(FailurePoint::BeforeEncode);
    let written = write_file(inputs, options, &trained, &mut || report(Phase::Encode, &progress))?;
    reach(FailurePoint::AfterEncode);
    report(Phase::Evaluate, &progress);
    let metrics = measure(inputs, options.background, &trained, &written, &mut || {
        report(Phase::Evaluate, &progress);
    })?;
    let metrics = JobMetrics { conventions: metrics.conventions.of(options.holdout), ..metrics };
    Ok(TrainedFile { file: written.bytes, format: written.file.format, metrics })
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
