//! Files of a promised size, and several files of one run.

use std::sync::LazyLock;

use tcgs::{
    codec::{DecodeLimits, decode},
    domain::{CancelFlag, JobMetrics, Problem, TrainOptions},
    sample::{self, Settings},
    worker::{
        pipeline::Pipeline,
        run::{Checkpoints, JobFailure, JobOutput, RunJob},
    },
};
use tempfile::TempDir;

use crate::support::gpu::choice;

const STEPS: u32 = 90;

static DATASET: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("a folder");
    sample::write(&folder.path().join("set"), &Settings { side: 40, points: 300, seed: 1 }).expect("writes");
    folder
});

fn dataset() -> std::path::PathBuf {
    DATASET.path().join("set")
}

fn options(max_bytes: Option<u64>) -> TrainOptions {
    TrainOptions { iterations: Some(STEPS), max_bytes, ..TrainOptions::default() }
}

fn pipeline() -> Pipeline {
    Pipeline::new(choice())
}

fn run(options: &TrainOptions) -> Result<JobOutput, JobFailure> {
    let options = options.clone().validated().expect("possible");
    let checkpoints = Checkpoints::default();
    pipeline().run(&dataset(), &options, &checkpoints, &mut |_, _| (), &CancelFlag::default())
}

fn train_psnr(metrics: &JobMetrics) -> f64 {
    metrics.train.psnr.expect("training views")
}

#[test]
fn the_file_is_as_small_as_promised_and_hardly_smaller() {
    let free = run(&options(None)).expect("a file");
    assert_eq!(free.metrics.byte_budget, None);
    let free_bytes = free.file.len() as u64;
    let mut last = f64::INFINITY;
    for percent in [90, 60, 30] {
        let limit = free_bytes * percent / 100;
        let output = run(&options(Some(limit))).expect("fits");
        let bytes = output.file.len() as u64;
        assert!(bytes <= limit, "{bytes} bytes where {limit} were promised");
        assert!(bytes * 100 >= limit * 98, "{bytes} bytes leave too much of {limit} unused");
        assert_eq!(output.metrics.bytes.total, bytes);
        let budget = output.metrics.byte_budget.expect("told");
        assert_eq!(budget.max_bytes, limit);
        assert!(budget.free_bytes > limit);
        let decoded = decode(&output.file, &DecodeLimits::default()).expect("a whole file");
        assert_eq!(decoded.manifest.provenance.settings["max_bytes"], limit);
        let psnr = train_psnr(&output.metrics);
        assert!(psnr <= last + 0.05, "fewer bytes look better: {psnr} dB at {percent} %");
        last = psnr;
    }
    assert!(last > train_psnr(&free.metrics) - 12.0, "{last} dB of {}", train_psnr(&free.metrics));
}

#[test]
fn the_same_promise_gives_the_same_bytes() {
    let options = options(Some(9_000));
    assert!(run(&options).expect("fits").file == run(&options).expect("fits").file);
}

#[test]
fn a_promise_that_is_kept_anyway_changes_nothing_but_what_the_file_says_of_it() {
    let free = run(&options(None)).expect("a file");
    let held = run(&options(Some(50_000_000))).expect("fits");
    assert_eq!(held.metrics.decode_sha256, free.metrics.decode_sha256);
    let budget = held.metrics.byte_budget.expect("told");
    assert_eq!((budget.gaussians_dropped, budget.free_bytes), (0, held.file.len() as u64));
}

fn refused(limit: u64) -> Problem {
    match run(&options(Some(limit))) {
        Err(JobFailure::Fail(problem)) => problem,
        other => panic!("not refused: {other:?}"),
    }
}

#[test]
fn a_promise_that_cannot_be_kept_is_refused_with_the_smallest_that_can() {
    let problem = refused(100);
    assert_eq!((problem.status, &*problem.kind), (507, "urn:tcgs:problem:max-bytes-unreachable"));
    let smallest = problem.smallest_bytes.expect("told");
    assert!(problem.detail.contains(&smallest.to_string()), "{problem}");
    let output = run(&options(Some(smallest))).expect("what was said to be possible");
    assert!(output.file.len() as u64 <= smallest);
    assert_eq!(refused(smallest - 1).smallest_bytes, Some(smallest));
}
