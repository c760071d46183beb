//! The child process by interpreters that are shell scripts: what each of its lines, and its absence, comes to.

use std::{fs, os::unix::fs::PermissionsExt as _, path::Path, time::Duration};

use super::*;
use crate::domain::{CancelFlag, Problem, ProblemType};

const OPTIONS: PoseOptions = PoseOptions {
    camera_model: CameraModel::SimpleRadial,
    matching: Matching::Auto,
    seed: 7,
    threads: 2,
    frames: 200,
};

/// An interpreter that runs `script` with the program and the request as its arguments.
fn interpreter(folder: &Path, script: &str) -> PoseEstimator {
    let python = folder.join("python");
    fs::write(&python, format!("#!/bin/sh\n{script}\n")).expect("a script");
    fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).expect("executable");
    PoseEstimator {
        python,
        ffmpeg: "ffmpeg".into(),
        limits: PoseLimits { memory_bytes: 1 << 30, time: Duration::from_secs(60) },
    }
}

/// What an interpreter finds of four photographs, and the progress that it reports.
fn estimate(script: &str) -> (Result<PoseReport, PosesError>, Vec<PoseProgress>) {
    let folder = tempfile::tempdir().expect("a folder");
    let work = folder.path().join("work");
    fs::create_dir(&work).expect("a folder");
    let estimator = interpreter(folder.path(), script);
    let mut progress = Vec::new();
    let names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"].map(str::to_owned);
    let report = &mut |step| progress.push(step);
    let found = estimator.estimate(folder.path(), &names, &work, OPTIONS, report, &CancelFlag::default());
    (found, progress)
}

fn problem(script: &str) -> (String, String) {
    let problem = Problem::from(estimate(script).0.expect_err("no cameras"));
    (problem.kind.rsplit(':').next().expect("a type").to_owned(), problem.detail)
}

#[test]
fn progress_and_a_result_are_read_whatever_else_is_written() {
    let (found, progress) = estimate(
        r#"echo 'I2026 a library speaks'
        echo '{"version": "4.2.1", "network": "namespace"}'
        echo '{"stage": "features", "done": 2, "total": 4}'
        echo '{"stage": "mapping", "done": 3, "total": 4}'
        echo '{"result": {"registered": ["a.jpg", "b.jpg", "d.jpg"], "models": 2, "points": 40, "cameras": 1, "reprojection_error": 0.5, "verified_pairs": 5}}'"#,
    );
    let found = found.expect("cameras");
    assert_eq!((found.photographs, found.unregistered, found.models), (4, vec!["c.jpg".to_owned()], 2));
    assert_eq!((found.generator.as_str(), found.is_network_isolated), ("pycolmap 4.2.1", true));
    let step = |stage, done| PoseProgress { stage, done, total: 4, reprojection_error: None };
    assert_eq!(progress, [step(PoseStage::Features, 2), step(PoseStage::Mapping, 3)]);
}

#[test]
fn the_child_gets_the_program_and_the_options() {
    let (kind, detail) = problem(
        r#"grep -q incremental_mapping "$2" || exit 9
        grep -q '"camera_model":"SIMPLE_RADIAL","matching":"auto","seed":7,"threads":2,"memory_bytes":1073741824' "$3" || exit 8
        [ "$1" = -I ] && [ "$OMP_NUM_THREADS" = 2 ] || exit 7
        echo '{"failure": "no-overlap", "detail": "asked as expected"}'"#,
    );
    assert!(kind == "no-overlap" && detail.contains("asked as expected"), "{kind}: {detail}");
}

#[test]
fn every_failure_is_a_problem_with_its_remedy() {
    for (failure, kind, remedy) in [
        ("unavailable", "poses-unavailable", "make poses"),
        ("unreadable", "image-rejected", "x"),
        ("featureless", "featureless-photographs", "sharper"),
        ("no-overlap", "no-overlap", "three photographs"),
    ] {
        let (found, detail) = problem(&format!(r#"echo '{{"failure": "{failure}", "detail": "x"}}'"#));
        assert_eq!(found, kind);
        assert!(detail.contains(remedy), "{kind}: {detail}");
    }
    let (kind, detail) = problem(
        r#"echo '{"result": {"registered": ["b.jpg"], "models": 1, "points": 4, "cameras": 1, "reprojection_error": 0.5, "verified_pairs": 5}}'"#,
    );
    assert!(kind == "too-few-registered" && detail.contains("a.jpg, c.jpg, d.jpg"), "{kind}: {detail}");
    let (kind, detail) = problem("echo 'out of memory' >&2; exit 3");
    assert!(kind == "poses-failed" && detail.contains("out of memory"), "{kind}: {detail}");
}

#[test]
fn an_interpreter_that_is_not_there_and_too_few_photographs_are_told_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let limits = PoseLimits { memory_bytes: 0, time: Duration::from_secs(60) };
    let estimator = PoseEstimator { python: folder.path().join("missing"), ffmpeg: "ffmpeg".into(), limits };
    let estimate = |count: usize| {
        let names: Vec<String> = (0..count).map(|number| format!("{number}.jpg")).collect();
        let path = folder.path();
        estimator
            .estimate(path, &names, path, OPTIONS, &mut |_| (), &CancelFlag::default())
            .expect_err("no cameras")
    };
    assert!(Problem::from(estimate(2)).is(ProblemType::TooFewPhotographs));
    assert!(matches!(estimate(3), PosesError::Unavailable { .. }));
}

#[test]
fn a_child_that_takes_too_long_or_is_no_longer_wanted_is_ended() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut estimator = interpreter(folder.path(), "exec sleep 600");
    let names: Vec<String> = (0..3).map(|number| format!("{number}.jpg")).collect();
    let cancel = CancelFlag::default();
    estimator.limits.time = Duration::ZERO;
    let path = folder.path();
    let ended = estimator.estimate(path, &names, path, OPTIONS, &mut |_| (), &cancel);
    assert!(matches!(ended, Err(PosesError::TimedOut(_))));
    cancel.cancel();
    let ended = estimator.estimate(path, &names, path, OPTIONS, &mut |_| (), &cancel);
    assert!(matches!(ended, Err(PosesError::Cancelled)));
}
