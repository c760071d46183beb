//! A rate-distortion curve: one run up to where the weight of the rate matters, then a branch for each weight.
//!
//! What always holds: a branch's file has the bytes that a single run with its weight would write. A run that was interrupted
//! goes on with the trunk or the branch that it fell into, and branches that were finished are not made again.

use super::{
    branches::{self, Finished},
    pipeline::{Product, Site},
    run::{Checkpoints, CurveFile, JobFailure, Resume},
};
use crate::{
    domain::{CurvePoint, Digest, JobMetrics, Phase, Progress, TrainOptions},
    train::{CheckpointFolder, Schedule, TrainError, train_trunk},
};

/// Makes the branches of `options` in order: the first product, whose figures list all points, and the files of the others.
pub(super) fn run_curve(
    site: &Site<'_>,
    options: &TrainOptions,
    checkpoints: &Checkpoints,
    tell: &mut dyn FnMut(Phase, &Progress),
) -> Result<(Product, Vec<CurveFile>), JobFailure> {
    let schedule = Schedule::new(options);
    let wanted = options.branches();
    let course = Course::new(schedule.fork_step(), schedule.steps, wanted.len());
    let digest = site.dataset.digest;
    let source = match &checkpoints.resume {
        Resume::Fresh => None,
        Resume::From(root) | Resume::IfPossible(root) => Some(root),
    };
    let mut done: Vec<Option<Finished>> = wanted
        .iter()
        .enumerate()
        .map(|(number, branch)| branches::load(&branches::folder(source?, number), digest, branch))
        .collect();
    if done.iter().any(Option::is_none) {
        let mut report = |progress: &Progress| tell(Phase::Train, &course.place(None, progress));
        let trunk = site.resumed(checkpoints, None, &mut |checkpoints| {
            let Site { context, dataset, budget, cancel, .. } = site;
            train_trunk(context, dataset, options, budget, checkpoints, &mut report, cancel)
        })?;
        for (number, branch) in wanted.iter().enumerate() {
            if done[number].is_some() {
                continue;
            }
            let fork = trunk.clone().fork(options, branch).map_err(TrainError::from);
            let fork = fork.map_err(super::pipeline::from_training)?;
            let own = Checkpoints {
                keep: checkpoints.keep.as_ref().map(|root| branches::folder(root, number)),
                resume: source
                    .map_or(Resume::Fresh, |root| Resume::IfPossible(branches::folder(root, number))),
            };
            let mut placed =
                |phase: Phase, progress: &Progress| tell(phase, &course.place(Some(number), progress));
            let Product { file, metrics, .. } = site.product(branch, &own, Some(fork), &mut placed)?;
            let finished = Finished { file, metrics };
            if let Some(folder) = &own.keep {
                match branches::keep(folder, digest, branch, &finished) {
                    Ok(()) => CheckpointFolder::clear(folder),
                    // A curve without what only an interruption would need is better than none.
                    Err(fault) => tracing::warn!("branch {number} is not kept: {fault}"),
                }
            }
            done[number] = Some(finished);
        }
    }
    collect(wanted, done.into_iter().flatten().collect())
}

fn collect(wanted: Vec<TrainOptions>, done: Vec<Finished>) -> Result<(Product, Vec<CurveFile>), JobFailure> {
    let lambdas = wanted.iter().filter_map(|branch| branch.lambda);
    let rd_curve = lambdas.zip(&done).map(|(lambda, branch)| point(lambda, branch)).collect::<Vec<_>>();
    let mut files = done.into_iter();
    let Some(first) = files.next() else {
        return Err(JobFailure::Fail(super::pipeline::internal("the curve has no point")));
    };
    let others = rd_curve
        .iter()
        .skip(1)
        .zip(files)
        .map(|(point, branch)| CurveFile { lambda: point.lambda, file: branch.file })
        .collect();
    let format = crate::domain::SceneFormat::Tcgs;
    Ok((Product { file: first.file, format, metrics: JobMetrics { rd_curve, ..first.metrics } }, others))
}

fn point(lambda: f64, branch: &Finished) -> CurvePoint {
    let Finished { file, metrics } = branch;
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

/// How far the whole is when one of its parts is somewhere.
struct Course {
    fork: u64,
    each: u64,
    steps: u64,
    branches: u64,
}

impl Course {
    fn new(fork: u32, steps: u32, branches: usize) -> Self {
        let (fork, steps) = (u64::from(fork), u64::from(steps));
        Self { fork, each: steps.saturating_sub(fork), steps, branches: branches as u64 }
    }

    /// A report of the trunk, or of a branch by its number, as one of the whole.
    fn place(&self, branch: Option<usize>, progress: &Progress) -> Progress {
        let before = branch.map_or(0, |number| number as u64 * self.each);
        let step = progress.step + before;
        let checkpoint_step =
            if progress.checkpoint_step > 0 { progress.checkpoint_step + before } else { 0 };
        let total = self.fork + self.branches * self.each;
        // A part tells of the steps to its own end.
        let told = self.steps.saturating_sub(progress.step);
        let left = total.saturating_sub(step);
        let eta_seconds =
            progress.eta_seconds.filter(|_| told > 0).map(|eta| eta * left as f64 / told.max(1) as f64);
        Progress { step, total, eta_seconds, checkpoint_step, ..progress.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_of_the_parts_runs_through_the_whole_once() {
        let course = Course::new(40, 100, 3);
        let at = |branch, step, eta| {
            let part = Progress { step, total: 100, eta_seconds: eta, ..Progress::default() };
            let whole = course.place(branch, &part);
            (whole.step, whole.total, whole.eta_seconds)
        };
        assert_eq!(at(None, 20, Some(8.0)), (20, 220, Some(20.0)));
        assert_eq!(at(Some(0), 40, Some(6.0)), (40, 220, Some(18.0)));
        assert_eq!(at(Some(2), 70, Some(3.0)), (190, 220, Some(3.0)));
        assert_eq!(at(Some(2), 100, None), (220, 220, None));
        let kept = |branch, checkpoint_step| {
            course
                .place(branch, &Progress { step: 70, checkpoint_step, ..Progress::default() })
                .checkpoint_step
        };
        assert_eq!([kept(None, 0), kept(None, 30), kept(Some(0), 40)], [0, 30, 40]);
        assert_eq!([kept(Some(1), 0), kept(Some(1), 40), kept(Some(2), 70)], [0, 100, 190]);
    }
}
