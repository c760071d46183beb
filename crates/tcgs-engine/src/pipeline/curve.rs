//! A rate-distortion curve: one run (the trunk) up to the step from which the weight of the rate term matters, then a branch for
//! each weight.
//!
//! Invariants: a branch's file has the bytes that a single run with its weight would write. An interrupted run resumes in the
//! trunk or the branch where it stopped; finished branches are not repeated.

use super::{
    branches::{self, FinishedBranch},
    error::JobError,
    inputs::RunInputs,
    job::{CheckpointPlan, CurveFile, Resume},
    train_file::{TrainedFile, train_file, with_checkpoints},
};
use crate::{
    domain::{CurvePoint, Digest, JobMetrics, Phase, Progress, SceneFormat, TrainOptions},
    train::{CheckpointFolder, Schedule, TrainError},
};

/// Makes the branches of `options` in order. Returns the first file, whose metrics list all points, and the files of the others.
pub(super) fn run_curve(
    inputs: &RunInputs<'_>,
    options: &TrainOptions,
    checkpoints: &CheckpointPlan,
    report: &mut dyn FnMut(Phase, &Progress),
) -> Result<(TrainedFile, Vec<CurveFile>), JobError> {
    let schedule = Schedule::new(options);
    let wanted = options.branches();
    let whole = CurveProgress::new(schedule.fork_step(), schedule.steps, wanted.len());
    let digest = inputs.dataset.digest;
    let source = match &checkpoints.resume {
        Resume::Fresh => None,
        Resume::From(root) | Resume::IfPossible(root) => Some(root),
    };
    let mut done: Vec<Option<FinishedBranch>> = wanted
        .iter()
        .enumerate()
        .map(|(number, branch)| branches::load(&branches::folder(source?, number), digest, branch))
        .collect();
    let keep = |number: usize, finished: &FinishedBranch| {
        if let Some(root) = &checkpoints.keep {
            let folder = branches::folder(root, number);
            match branches::keep(&folder, digest, &wanted[number], finished) {
                Ok(()) => CheckpointFolder::clear(&folder),
                // Only an interruption would need it.
                Err(error) => tracing::warn!("branch {number} is not kept: {error}"),
            }
        }
    };
    if checkpoints.keep.as_ref() != source {
        for (number, finished) in done.iter().enumerate() {
            finished.iter().for_each(|finished| keep(number, finished));
        }
    }
    if done.iter().any(Option::is_none) {
        let mut report_trunk = |progress: &Progress| report(Phase::Train, &whole.at(None, progress));
        let trunk = with_checkpoints(inputs, checkpoints, None, &mut |checkpoints| {
            inputs.trainer(options).with_checkpoints(checkpoints).run_trunk(&mut report_trunk)
        })?;
        for (number, branch) in wanted.iter().enumerate() {
            if done[number].is_some() {
                continue;
            }
            let fork = trunk.clone().fork(options, branch).map_err(TrainError::from)?;
            let own = CheckpointPlan {
                keep: checkpoints.keep.as_ref().map(|root| branches::folder(root, number)),
                resume: source
                    .map_or(Resume::Fresh, |root| Resume::IfPossible(branches::folder(root, number))),
            };
            let mut report_branch =
                |phase: Phase, progress: &Progress| report(phase, &whole.at(Some(number), progress));
            let TrainedFile { file, metrics, .. } =
                train_file(inputs, branch, &own, Some(fork), &mut report_branch)?;
            let finished = FinishedBranch { file, metrics };
            keep(number, &finished);
            done[number] = Some(finished);
        }
    }
    collect(wanted, done.into_iter().flatten().collect())
}

fn collect(
    wanted: Vec<TrainOptions>,
    done: Vec<FinishedBranch>,
) -> Result<(TrainedFile, Vec<CurveFile>), JobError> {
    let lambdas = wanted.iter().filter_map(|branch| branch.lambda);
    let rd_curve = lambdas.zip(&done).map(|(lambda, branch)| point(lambda, branch)).collect::<Vec<_>>();
    let mut files = done.into_iter();
    let Some(first) = files.next() else {
        return Err(JobError::internal("the curve has no point"));
    };
    let others = rd_curve
        .iter()
        .skip(1)
        .zip(files)
        .map(|(point, branch)| CurveFile { lambda: point.lambda, file: branch.file })
        .collect();
    let metrics = JobMetrics { rd_curve, ..first.metrics };
    Ok((TrainedFile { file: first.file, format: SceneFormat::Tcgs, metrics }, others))
}

fn point(lambda: f64, branch: &FinishedBranch) -> CurvePoint {
    let FinishedBranch { file, metrics } = branch;
    CurvePoint {
        lambda,
        bytes: file.len() as u64,
        psnr: metrics.test.psnr,
        ssim: metrics.test.ssim,
        lpips: metrics.test.lpips,
        gaussians: metrics.gaussians,
        sha256: Digest::of(file),
    }
}

/// Turns the progress of trunk and branches into progress of the whole curve.
struct CurveProgress {
    fork: u64,
    branch_steps: u64,
    steps: u64,
    branches: u64,
}

impl CurveProgress {
    fn new(fork: u32, steps: u32, branches: usize) -> Self {
        let (fork, steps) = (u64::from(fork), u64::from(steps));
        Self { fork, branch_steps: steps.saturating_sub(fork), steps, branches: branches as u64 }
    }

    /// The progress of the whole when the trunk, or the branch with this number, reports `progress`.
    fn at(&self, branch: Option<usize>, progress: &Progress) -> Progress {
        let before = branch.map_or(0, |number| number as u64 * self.branch_steps);
        let step = progress.step + before;
        let checkpoint_step =
            if progress.checkpoint_step > 0 { progress.checkpoint_step + before } else { 0 };
        let total = self.fork + self.branches * self.branch_steps;
        // A part estimates the time to its own end.
        let part_left = self.steps.saturating_sub(progress.step);
        let left = total.saturating_sub(step);
        let eta_seconds = progress
            .eta_seconds
            .filter(|_| part_left > 0)
            .map(|eta| eta * left as f64 / part_left.max(1) as f64);
        Progress { step, total, eta_seconds, checkpoint_step, ..progress.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_of_the_parts_runs_through_the_whole_once() {
        let whole = CurveProgress::new(40, 100, 3);
        let at = |branch, step, eta| {
            let part = Progress { step, total: 100, eta_seconds: eta, ..Progress::default() };
            let Progress { step, total, eta_seconds, .. } = whole.at(branch, &part);
            (step, total, eta_seconds)
        };
        assert_eq!(at(None, 20, Some(8.0)), (20, 220, Some(20.0)));
        assert_eq!(at(Some(0), 40, Some(6.0)), (40, 220, Some(18.0)));
        assert_eq!(at(Some(2), 70, Some(3.0)), (190, 220, Some(3.0)));
        assert_eq!(at(Some(2), 100, None), (220, 220, None));
        let kept = |branch, checkpoint_step| {
            whole.at(branch, &Progress { step: 70, checkpoint_step, ..Progress::default() }).checkpoint_step
        };
        assert_eq!([kept(None, 0), kept(None, 30), kept(Some(0), 40)], [0, 30, 40]);
        assert_eq!([kept(Some(1), 0), kept(Some(1), 40), kept(Some(2), 70)], [0, 100, 190]);
    }
}
