//! Stands where an engine is not joined yet, and says so to whoever asks for its work.

use std::path::Path;

use tcgs::{
    domain::{Camera, CancelFlag, Digest, Image, Phase, Problem, Progress, TrainOptions},
    render::{RenderViews, views::Viewable},
    worker::run::{JobFailure, JobOutput, RunJob},
};

/// Neither trains nor renders.
pub(super) struct Absent;

pub(super) fn problem(what: &str) -> Problem {
    Problem::new(501, "not-built", "Not built", format!("{what} is not part of this build"))
}

impl RunJob for Absent {
    fn run(
        &self,
        _dataset: &Path,
        _options: &TrainOptions,
        _report: &mut dyn FnMut(Phase, &Progress),
        _cancel: &CancelFlag,
    ) -> Result<JobOutput, JobFailure> {
        Err(JobFailure::Fail(problem("training")))
    }
}

impl RenderViews for Absent {
    fn render(
        &self,
        _artifact: Digest,
        _load: &dyn Fn() -> Result<Viewable, Problem>,
        _camera: &Camera,
    ) -> Result<Image, Problem> {
        Err(problem("rendering"))
    }
}
