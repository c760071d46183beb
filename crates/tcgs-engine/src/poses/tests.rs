//! The child process by interpreters that are shell scripts: what each of its lines, and its absence, comes to.

use std::{fs, os::unix::fs::PermissionsExt as _, path::Path, time::Duration};

use super::*;
use crate::domain::{CancelFlag, MaskSource, Problem, ProblemType};

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
        colmap: folder.join("colmap"),
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
        ("unavailable", "poses-unavailable", "TCGS_POSES_PYTHON=ENV/bin/python3"),
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
    let estimator = PoseEstimator {
        python: folder.path().join("missing"),
        colmap: folder.path().join("colmap"),
        ffmpeg: "ffmpeg".into(),
        limits,
    };
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

#[test]
fn an_ffmpeg_that_is_killed_is_not_taken_for_a_fault_of_the_video() {
    let folder = tempfile::tempdir().expect("a folder");
    let (video, work) = (folder.path().join("v.mp4"), folder.path().join("work"));
    fs::write(&video, b"\0\0\0\x14ftypisom").expect("a file");
    let mut estimator = interpreter(folder.path(), "exit 1");
    estimator.ffmpeg = folder.path().join("ffmpeg");
    let died = |script: &str| {
        fs::write(&estimator.ffmpeg, format!("#!/bin/sh\n{script}\n")).expect("a script");
        fs::set_permissions(&estimator.ffmpeg, fs::Permissions::from_mode(0o755)).expect("executable");
        let given = Given { path: &video, masks: &MaskSource::None };
        let found = estimator.dataset(given, &work, OPTIONS, &mut |_| (), &CancelFlag::default());
        Problem::from(found.expect_err("no cameras"))
    };
    // A frame of the first reading, in which sharpness is measured.
    let frame = "head -c 518400 /dev/zero";
    for (script, kind) in [
        (format!("{frame}; kill -9 $$"), ProblemType::PosesFailed),
        (format!("case \"$*\" in *pipe:1) {frame}; exit 0;; esac; kill -9 $$"), ProblemType::PosesFailed),
        ("echo damaged >&2; exit 1".to_owned(), ProblemType::VideoRejected),
        (format!("{frame}; exit 1"), ProblemType::VideoRejected),
    ] {
        let problem = died(&script);
        assert!(problem.is(kind), "{script}: {problem}");
    }
}

/// A program that speaks colmap's command line, and writes a model of three of four photographs.
const COLMAP: &str = r#"#!/usr/bin/env python3
import pathlib, sqlite3, struct, sys

command, rest = sys.argv[1], sys.argv[2:]
if command == "help":
    print("COLMAP VERSION -- Structure-from-Motion and Multi-View Stereo")
    sys.exit()
if rest == ["-h"]:
    print("  --default_random_seed arg (=0)\n  --FeatureExtraction.use_gpu arg\n  --SiftExtraction.max_image_size arg")
    sys.exit()
given = dict(zip(rest[::2], rest[1::2]))
with open(pathlib.Path(sys.argv[0]).with_suffix(".log"), "a") as log:
    print(command, *(name for name in given if "." in name or "seed" in name), file=log)
if command == "feature_extractor":
    database = sqlite3.connect(given["--database_path"])
    database.executescript("""CREATE TABLE IF NOT EXISTS images (image_id INTEGER PRIMARY KEY, name TEXT);
        CREATE TABLE IF NOT EXISTS keypoints (image_id INTEGER, rows INTEGER);
        CREATE TABLE IF NOT EXISTS two_view_geometries (rows INTEGER);""")
    for name in open(given["--image_list_path"]).read().splitlines():
        row = database.execute("INSERT INTO images (name) VALUES (?)", [name]).lastrowid
        database.execute("INSERT INTO keypoints VALUES (?, 500)", [row])
    database.commit()
    print("Processed file [2/4]", file=sys.stderr)
elif command == "exhaustive_matcher":
    database = sqlite3.connect(given["--database_path"])
    database.execute("INSERT INTO two_view_geometries VALUES (30)")
    database.commit()
elif command == "mapper":
    print("Registering image #3 (num_reg_frames=3)", file=sys.stderr)
    for number, names in enumerate([["a.jpg", "b.jpg"], ["d.jpg", "a.jpg", "b.jpg"]]):
        model = pathlib.Path(given["--output_path"], str(number))
        model.mkdir()
        images = b"".join(struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + name.encode() + b"\0" + struct.pack("<Q2dq", 1, 1, 1, 1) for name in names)
        (model / "images.bin").write_bytes(struct.pack("<Q", len(names)) + images)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 1))
        points = b"".join(struct.pack("<Q3d3BdQII", 1, 0, 0, 0, 9, 9, 9, error, 1, 1, 0) for error in (0.25, 0.75))
        (model / "points3D.bin").write_bytes(struct.pack("<Q", 2) + points)
elif command == "point_triangulator":
    given_model, model = pathlib.Path(given["--input_path"]), pathlib.Path(given["--output_path"])
    for name in ("images.bin", "cameras.bin"):
        (model / name).write_bytes((given_model / name).read_bytes())
    (model / "points3D.bin").write_bytes(struct.pack("<Q", 3))
elif command == "model_orientation_aligner":
    sys.exit(1)
"#;

/// An estimator whose Python has no pycolmap, with a colmap of a version.
fn with_colmap(folder: &Path, version: &str) -> PoseEstimator {
    let estimator = interpreter(folder, "exec python3 -S \"$@\"");
    fs::write(&estimator.colmap, COLMAP.replace("VERSION", version)).expect("a script");
    fs::set_permissions(&estimator.colmap, fs::Permissions::from_mode(0o755)).expect("executable");
    estimator
}

#[test]
fn a_colmap_stands_in_for_pycolmap_if_it_is_new_enough() {
    let folder = tempfile::tempdir().expect("a folder");
    let work = folder.path().join("work");
    fs::create_dir(&work).expect("a folder");
    let old = with_colmap(folder.path(), "3.12.6").probe().expect_err("too old");
    assert!(Problem::from(old).is(ProblemType::PosesUnavailable));
    let estimator = with_colmap(folder.path(), "3.13.0-dev");
    let program = estimator.probe().expect("a program");
    assert_eq!((program.engine, program.to_string()), (PoseEngine::Colmap, "colmap 3.13.0".to_owned()));

    for (name, width) in [("a.jpg", 8), ("b.jpg", 8), ("c.jpg", 4), ("d.jpg", 8)] {
        image::GrayImage::new(width, 4).save(folder.path().join(name)).expect("written");
    }
    let names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"].map(str::to_owned);
    let mut progress = Vec::new();
    let report = &mut |step| progress.push(step);
    let cancel = CancelFlag::default();
    let found = estimator.estimate(folder.path(), &names, &work, OPTIONS, report, &cancel).expect("cameras");
    assert_eq!(found.registered, ["a.jpg", "b.jpg", "d.jpg"]);
    assert_eq!((found.unregistered, found.models), (vec!["c.jpg".to_owned()], 2));
    // The points are those found anew, the error is that of the ones before.
    assert_eq!((found.points, found.cameras, found.reprojection_error), (3, 1, 0.5));
    assert_eq!((found.generator.as_str(), found.verified_pairs), ("colmap 3.13.0", 1));
    assert!(found.model.join("points3D.bin").exists());
    let stages: Vec<PoseStage> = progress.iter().map(|step| step.stage).collect();
    for stage in [PoseStage::Features, PoseStage::Matches, PoseStage::Mapping] {
        assert!(stages.contains(&stage), "{stages:?}");
    }
    // Each command once, features once a size, with the options that this version has.
    let log = fs::read_to_string(folder.path().join("colmap.log")).expect("a log");
    let extraction =
        "feature_extractor --FeatureExtraction.use_gpu --SiftExtraction.max_image_size --default_random_seed";
    let commands: Vec<&str> = log.lines().collect();
    assert_eq!(commands[..2], [extraction, extraction]);
    assert_eq!(
        commands[2..],
        [
            "exhaustive_matcher --default_random_seed",
            "mapper --default_random_seed",
            "point_triangulator --default_random_seed",
            "model_orientation_aligner"
        ]
    );
}

#[test]
fn a_colmap_that_is_killed_is_not_taken_for_photographs_that_do_not_overlap() {
    let folder = tempfile::tempdir().expect("a folder");
    let work = folder.path().join("work");
    fs::create_dir(&work).expect("a folder");
    let estimator = with_colmap(folder.path(), "3.13.0");
    let killed = "import os\n    os.kill(os.getpid(), 9)\n    print(\"Registering";
    let script = fs::read_to_string(&estimator.colmap).expect("a script");
    fs::write(&estimator.colmap, script.replace("print(\"Registering", killed)).expect("a script");
    let names = ["a.jpg", "b.jpg", "c.jpg"].map(str::to_owned);
    for name in &names {
        image::GrayImage::new(8, 4).save(folder.path().join(name)).expect("written");
    }
    let cancel = CancelFlag::default();
    let found = estimator.estimate(folder.path(), &names, &work, OPTIONS, &mut |_| (), &cancel);
    let PosesError::Died { detail, .. } = found.expect_err("no cameras") else { panic!("another failure") };
    assert!(detail.contains("signal 9"), "{detail}");
}

#[test]
fn features_are_kept_for_the_same_search_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let estimator = interpreter(
        folder.path(),
        r#"work=$(sed -n 's/.*"work":"\([^"]*\)".*/\1/p' "$3")
        mkdir "$work/models" || exit 1
        [ -e "$work/features.db" ] && known=known || known=new
        touch "$work/features.db"
        echo "{\"failure\": \"no-overlap\", \"detail\": \"$known\"}""#,
    );
    let work = folder.path().join("work");
    fs::create_dir(&work).expect("a folder");
    let names = ["a.jpg", "b.jpg", "c.jpg"].map(str::to_owned);
    let search = |options: PoseOptions| {
        let cancel = CancelFlag::default();
        let found = estimator.estimate(folder.path(), &names, &work, options, &mut |_| (), &cancel);
        let PosesError::NoOverlap(detail) = found.expect_err("no cameras") else { panic!("another failure") };
        detail
    };
    let opencv = PoseOptions { camera_model: CameraModel::Opencv, ..OPTIONS };
    let threads = PoseOptions { threads: 1, ..opencv };
    let known: Vec<String> = [OPTIONS, OPTIONS, opencv, threads, OPTIONS].map(search).to_vec();
    assert_eq!(known, ["new", "known", "new", "known", "new"]);
}
