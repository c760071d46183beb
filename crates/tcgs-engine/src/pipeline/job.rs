//! What a job is given and what it returns.

use std::path::{Path, PathBuf};

use super::JobError;
use crate::domain::{
    CancelFlag, HeldOut, JobMetrics, NamedCamera, Phase, Progress, SceneFormat, TrainOptions,
};

/// A further file of a rate-distortion curve.
#[derive(Debug, Clone, PartialEq)]
pub struct CurveFile {
    /// Its weight of the rate term.
    pub lambda: f64,
    /// The file.
    pub file: Vec<u8>,
}

/// What a finished job returns.
#[derive(Debug, Clone)]
pub struct JobOutput {
    /// The finished file; of a rate-distortion curve, that of its first point.
    pub file: Vec<u8>,
    /// Format of all files.
    pub format: SceneFormat,
    /// The files of the curve's other points, in the order of `metrics.rd_curve`.
    pub others: Vec<CurveFile>,
    /// The metrics of `file`, with the curve.
    pub metrics: JobMetrics,
    /// The dataset's cameras.
    pub cameras: Vec<NamedCamera>,
    /// Pictures of held-out views, if the runner makes them and there are held-out views.
    pub held_out: Option<HeldOut>,
    /// A small JPEG of one view, if the runner makes pictures.
    pub thumbnail: Option<Vec<u8>>,
}

impl JobOutput {
    /// Every file with its weight of the rate term; `None` if it belongs to no curve.
    pub fn files(&self) -> impl Iterator<Item = (Option<f64>, &[u8])> {
        let first = (self.metrics.rd_curve.first().map(|point| point.lambda), &self.file[..]);
        let others = self.others.iter().map(|other| (Some(other.lambda), &other.file[..]));
        std::iter::once(first).chain(others)
    }
}

/// What a run starts from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Resume {
    /// The dataset alone.
    #[default]
    Fresh,
    /// The checkpoint in this folder; fails if there is no usable one.
    From(PathBuf),
    /// The checkpoint in this folder, or the dataset alone if there is no usable one.
    IfPossible(PathBuf),
}

/// Where a run keeps its checkpoints and what it starts from. The result does not depend on either.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CheckpointPlan {
    /// The folder for checkpoints, if any are to be kept.
    pub keep: Option<PathBuf>,
    /// What the run starts from.
    pub resume: Resume,
}

/// Runs jobs. Calls block for as long as the job takes.
pub trait RunJob: Send + Sync + 'static {
    /// Runs the job on the dataset archive at `dataset`. Calls `report` with progress throughout, and stops soon after `cancel` is
    /// set; writes a checkpoint then, and at intervals before, where `checkpoints` says.
    ///
    /// # Errors
    /// [`JobError`] says whether another attempt may help.
    fn run(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        checkpoints: &CheckpointPlan,
        report: &mut dyn FnMut(Phase, &Progress),
        cancel: &CancelFlag,
    ) -> Result<JobOutput, JobError>;
}
