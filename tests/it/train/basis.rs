//! What the features' own basis costs in quality, and what it saves.

use tcgs::{
    domain::{CancelFlag, Component, TrainOptions},
    pipeline::{CheckpointPlan, JobOutput, Pipeline, RunJob},
    sample::{self, Settings},
};

use crate::support::gpu::choice;

fn run(dataset: &std::path::Path, options: &TrainOptions) -> JobOutput {
    let options = options.clone().validated().expect("possible");
    Pipeline::new(choice())
        .run(dataset, &options, &CheckpointPlan::default(), &mut |_, _| (), &CancelFlag::default())
        .expect("a file")
}

/// In so short a run learning rates are at the edge of what networks bear, and whatever the change of basis does to the optimizer
/// shows within its last steps.
#[test]
fn a_short_run_keeps_its_picture_in_the_features_own_basis_and_its_file_is_smaller() {
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = folder.path().join("set");
    sample::write(&dataset, &Settings { points: 1000, ..Settings::square(48) }).expect("writes");
    let whole = TrainOptions { iterations: Some(60), seed: 5, ..TrainOptions::default() };
    let learnt = run(&dataset, &TrainOptions { without: [Component::Basis].into(), ..whole.clone() });
    let pruned = run(&dataset, &whole);
    let psnr = |output: &JobOutput| output.metrics.train.psnr.expect("training views");
    println!("{:.2} dB, {} bytes as learnt", psnr(&learnt), learnt.file.len());
    println!("{:.2} dB, {} bytes in its basis", psnr(&pruned), pruned.file.len());
    assert!(psnr(&pruned) > psnr(&learnt) - 0.3);
    assert!(10 * pruned.file.len() < 9 * learnt.file.len());
}
