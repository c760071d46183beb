//! What the claim loop asks of whoever carries a job out.

use std::path::{Path, PathBuf};

pub use crate::domain::NamedCamera;
use crate::domain::{CancelFlag, HeldOut, JobMetrics, Phase, Problem, Progress, SceneFormat, TrainOptions};

/// A further file of a rate-distortion curve.
#[derive(Debug, Clone, PartialEq)]
pub struct CurveFile {
    /// Its weight of the rate.
    pub lambda: f64,
    /// The file.
    pub file: Vec<u8>,
}

/// What a finished job leaves behind.
#[derive(Debug, Clone)]
pub struct JobOutput {
    /// The finished file; of a rate-distortion curve, that of its first point.
    pub file: Vec<u8>,
    /// Its kind, and that of the others.
    pub format: SceneFormat,
    /// The files of the curve's other points, in the order of `metrics.rd_curve`.
    pub others: Vec<CurveFile>,
    /// The figures of `file`, with the curve.
    pub metrics: JobMetrics,
    /// The dataset's cameras.
    pub cameras: Vec<NamedCamera>,
    /// Held-out views as pictures, if the runner makes them and there are such views.
    pub held_out: Option<HeldOut>,
}

impl JobOutput {
    /// Every file with its weight of the rate, which only those of a curve have.
    pub fn files(&self) -> impl Iterator<Item = (Option<f64>, &[u8])> {
        let first = (self.metrics.rd_curve.first().map(|point| point.lambda), &self.file[..]);
        let others = self.others.iter().map(|other| (Some(other.lambda), &other.file[..]));
        std::iter::once(first).chain(others)
    }
}

/// What a run begins with.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Resume {
    /// Nothing.
    #[default]
    Fresh,
    /// The checkpoint in this folder, and nothing else.
    From(PathBuf),
    /// The checkpoint in this folder, or nothing where there is none that can be used.
    IfPossible(PathBuf),
}

/// Where a run keeps its checkpoints and what it begins with. The result is the same in any case.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Checkpoints {
    /// The folder for checkpoints, if any are to be kept.
    pub keep: Option<PathBuf>,
    /// What the run begins with.
    pub resume: Resume,
}

/// Why a run ended without output.
#[derive(Debug, Clone, PartialEq)]
pub enum JobFailure {
    /// The input or the options are at fault: trying again cannot help.
    Fail(Problem),
    /// The machine is at fault (device lost): another attempt may succeed.
    Retry(Problem),
    /// Something is lacking that time or an operator brings, such as room on the disk: another attempt will succeed then.
    Hold(Problem),
    /// The cancel flag was seen.
    Cancelled,
}

/// Carries out jobs. Calls block for as long as the job takes.
pub trait RunJob: Send + Sync + 'static {
    /// Runs the job on the dataset archive at `dataset`, reporting as it goes and stopping soon after `cancel`; then and
    /// now and then before it leaves a checkpoint where `checkpoints` says.
    ///
    /// # Errors
    /// [`JobFailure`] says whether another attempt may help.
    fn run(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        checkpoints: &Checkpoints,
        report: &mut dyn FnMut(Phase, &Progress),
        cancel: &CancelFlag,
    ) -> Result<JobOutput, JobFailure>;
}
