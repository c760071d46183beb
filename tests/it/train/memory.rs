//! What runs take: the estimate against what is allocated, budgets that are held, photographs that stream from disk.

use std::{
    fs,
    path::Path,
    sync::atomic::{AtomicUsize, Ordering},
};

use glam::DVec3;
use image::{DynamicImage, ImageFormat, Rgb, RgbImage};
use serde_json::{Value, json};
use tcgs::{
    domain::{
        CancelFlag, Convention, Dataset, MemoryBudget, MemoryLimits, ModelKind, Phase, PointCloud, Pose,
        Problem, Progress, TrainOptions,
    },
    gpu::{Device, GpuError},
    ingest::{self, LoadBudget},
    pipeline::{CheckpointPlan, JobError, Pipeline, RunJob as _},
    train::{Needs, RunTooLarge, TrainError, Trainer},
};
use tempfile::TempDir;

use crate::support::{gpu, program, small_disk::SmallDisk};

/// A folder of photographs of a colorful ball of nothing, from a circle around it, with the sizes repeated in turn.
fn folder(frames: usize, sizes: &[(u32, u32)]) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let listed: Vec<Value> = (0..frames)
        .map(|index| {
            let (width, height) = sizes[index % sizes.len()];
            write_png(&folder.path().join(format!("{index:04}.png")), index as u32, (width, height));
            let mut frame = pose(index, frames);
            frame["file_path"] = json!(format!("{index:04}.png"));
            frame["w"] = json!(width);
            frame["h"] = json!(height);
            frame["fl_x"] = json!(1.2 * f64::from(width));
            frame["fl_y"] = json!(1.2 * f64::from(width));
            frame["cx"] = json!(f64::from(width) / 2.0);
            frame["cy"] = json!(f64::from(height) / 2.0);
            frame
        })
        .collect();
    write_table(folder.path(), listed);
    folder
}

fn pose(index: usize, frames: usize) -> Value {
    let angle = index as f64 / frames as f64 * std::f64::consts::TAU;
    let position = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.0);
    let pose = Pose::look_at(position, DVec3::ZERO, DVec3::Z).expect("a view");
    let rows: Vec<[f64; 4]> = {
        let matrix = pose.camera_to_world(Convention::Opengl);
        (0..4).map(|row| matrix.row(row).to_array()).collect()
    };
    json!({ "transform_matrix": rows })
}

fn write_table(folder: &Path, frames: Vec<Value>) {
    let table = json!({ "camera_model": "PINHOLE", "frames": frames });
    fs::write(folder.join("transforms.json"), table.to_string()).expect("written");
}

fn write_png(path: &Path, seed: u32, (width, height): (u32, u32)) {
    let image = RgbImage::from_fn(width, height, |x, y| {
        Rgb([(x * 7 + seed * 13) as u8, (y * 5 + x * seed) as u8, (x * y + seed) as u8])
    });
    DynamicImage::from(image).save_with_format(path, ImageFormat::Png).expect("written");
}

/// With points around the middle, so that a run begins with as many anchors as there is a use for.
fn with_points(mut dataset: Dataset, count: usize) -> Dataset {
    let at = |index: usize, by: f64| (index as f64 * by).fract() - 0.5;
    let positions: Vec<[f64; 3]> =
        (0..count).map(|i| [at(i, 0.618_034), at(i, 0.754_878), at(i, 0.569_84)]).collect();
    dataset.points = Some(PointCloud { colors: vec![[0; 3]; count], positions });
    dataset
}

fn options(iterations: u32) -> TrainOptions {
    TrainOptions { iterations: Some(iterations), ..TrainOptions::default() }
}

fn tight(spill: &Path, memory: u64) -> LoadBudget {
    LoadBudget { memory_bytes: memory, spill_dir: spill.to_owned() }
}

#[test]
fn the_estimate_covers_what_a_run_allocates_and_not_much_more() {
    for (what, model, sizes, points, steps) in [
        ("few anchors that grow", ModelKind::Tcgs, &[(32, 32)][..], 150, 60),
        ("many anchors", ModelKind::Tcgs, &[(48, 32)], 4000, 3),
        ("plain Gaussians", ModelKind::Gaussians3d, &[(64, 48)], 20_000, 30),
        ("large images of two sizes", ModelKind::Tcgs, &[(400, 300), (300, 400)], 3000, 9),
    ] {
        let folder = folder(9, sizes);
        let dataset = with_points(ingest::load(folder.path()).expect("a dataset"), points);
        let options = TrainOptions { model, ..options(steps) };
        let mut size = 0;
        let mut report = |progress: &Progress| {
            let now = if model == ModelKind::Gaussians3d { progress.gaussians } else { progress.anchors };
            size = size.max(now as usize);
        };
        // A peak of its own: what other runs and tests of this process allocate must not count.
        let device = Device::new(&gpu::choice()).expect("an adapter");
        Trainer::new(&device, &dataset, &options).run(&mut report).expect("a scene");
        let peak = device.peak_bytes();
        let estimate = Needs::of(&dataset, &options, device.adapter()).estimate(size);
        let estimated = estimate.gpu_bytes();
        println!(
            "{what}: size {size}, estimated {estimated}, peak {peak}, {:.2}",
            estimated as f64 / peak as f64
        );
        assert!(
            estimated >= peak,
            "{what}: {peak} bytes at most, and only {estimated} estimated: {estimate}"
        );
        assert!(estimated <= 2 * peak, "{what}: {peak} bytes at most, and {estimated} estimated: {estimate}");
    }
}

#[test]
fn a_buffer_beyond_the_budget_is_an_error_and_the_device_goes_on() {
    let device = Device::new(&gpu::choice()).expect("an adapter");
    device.set_budget_bytes(1 << 20);
    let kept = device.buffer::<f32>("kept", 200_000).expect("within the budget");
    let error = device.buffer::<f32>("too much", 100_000).expect_err("beyond it");
    assert!(matches!(error, GpuError::OverBudget { .. }), "{error}");
    assert_eq!(Problem::from(error).status, 507);
    let error = device.read(&kept).expect_err("a transfer needs room too");
    assert!(matches!(error, GpuError::OverBudget { .. }), "{error}");
    let mut recorder = device.recorder("a large write");
    recorder.write(&kept, &vec![1.0; 200_000]);
    assert!(matches!(recorder.submit(), Err(GpuError::OverBudget { .. })));
    device.set_budget_bytes(u64::MAX);
    assert_eq!(device.read(&kept).expect("room now"), vec![0.0; 200_000], "nothing was written");
    drop(kept);
    assert_eq!(device.allocated_bytes(), 0);
}

#[test]
fn a_run_grows_no_further_than_its_budget() {
    let device = Device::new(&gpu::choice()).expect("an adapter");
    let folder = folder(9, &[(32, 32)]);
    let dataset = with_points(ingest::load(folder.path()).expect("a dataset"), 150);
    let options = options(60);
    let needs = Needs::of(&dataset, &options, device.adapter());
    device.set_budget_bytes(needs.estimate(170).gpu_bytes());
    let fitted = needs
        .within(&MemoryBudget { host: u64::MAX, gpu: device.budget_bytes() })
        .expect("the points fit")
        .size;
    assert!((170..40_000).contains(&fitted), "{fitted}");
    let mut anchors = 0;
    let mut report = |progress: &Progress| anchors = anchors.max(progress.anchors as usize);
    Trainer::new(&device, &dataset, &options).run(&mut report).expect("a scene");
    assert!(anchors <= fitted, "{anchors} of {fitted}");
    assert!(device.peak_bytes() <= device.budget_bytes());

    device.set_budget_bytes(1 << 20);
    let refused = Trainer::new(&device, &dataset, &options).run(|_| unreachable!("no step"));
    assert!(matches!(refused, Err(TrainError::TooLarge(RunTooLarge::OverBudget(_)))), "{refused:?}");
}

#[test]
fn photographs_twenty_times_larger_than_memory_leave_it_as_it_is() {
    let folder = folder(120, &[(96, 64)]);
    let spill = tempfile::tempdir().expect("a temporary folder");
    let in_memory = ingest::load(folder.path()).expect("a dataset");
    let all = in_memory.bytes_in_memory();
    assert_eq!(all, 120 * 96 * 64 * 3);
    // Decoding takes the most of such a budget: it must hold one image with its file.
    let budget = tight(spill.path(), all / 20);
    let streamed = ingest::load_with_budget(folder.path(), &budget).expect("a dataset");
    assert!(streamed.bytes_in_memory() <= budget.memory_bytes, "{}", streamed.bytes_in_memory());
    for (one, other) in in_memory.frames.iter().zip(&streamed.frames) {
        assert_eq!(one.image.load(), other.image.load(), "{}", one.name);
    }
    assert_eq!(in_memory.digest, streamed.digest);
    drop(streamed);
    assert_eq!(fs::read_dir(spill.path()).expect("a folder").count(), 0, "nothing is left behind");

    let problem =
        ingest::load_with_budget(folder.path(), &tight(spill.path(), 1 << 12)).expect_err("too little");
    assert_eq!((problem.status, problem.file.is_some()), (507, true), "{problem}");
    assert!(problem.detail.contains("--host-memory"), "{problem}");
}

#[test]
fn a_run_on_streamed_photographs_gives_the_same_bits() {
    let folder = folder(9, &[(32, 32)]);
    let spill = tempfile::tempdir().expect("a temporary folder");
    let in_memory = ingest::load(folder.path()).expect("a dataset");
    let streamed =
        ingest::load_with_budget(folder.path(), &tight(spill.path(), 32 << 10)).expect("a dataset");
    assert!(streamed.bytes_in_memory() < in_memory.bytes_in_memory());
    let [one, other] = [in_memory, streamed].map(|dataset| {
        let dataset = with_points(dataset, 150);
        Trainer::new(&gpu::gpu(), &dataset, &options(12)).run(|_| {}).expect("a scene").scene
    });
    assert!(one == other);
}

#[test]
fn a_job_over_its_budget_fails_for_good_before_it_trains() {
    let folder = folder(9, &[(32, 32)]);
    let spill = tempfile::tempdir().expect("a temporary folder");
    let run = |limits| {
        let pipeline = Pipeline::new(gpu::choice()).within(limits, spill.path().to_owned());
        pipeline.run(
            folder.path(),
            &options(3),
            &CheckpointPlan::default(),
            &mut |_, _| {},
            &CancelFlag::default(),
        )
    };
    let ample = 8 << 30;
    for limits in
        [MemoryLimits { host: ample, gpu: Some(1 << 20) }, MemoryLimits { host: 1 << 20, gpu: Some(ample) }]
    {
        match run(limits) {
            Err(JobError::Fail(problem)) => {
                assert_eq!(problem.status, 507, "{problem}");
                assert!(problem.kind.ends_with("memory-budget"), "{problem}");
            }
            other => panic!("{:?}", other.map(|_| ())),
        }
    }
}

#[test]
fn a_full_disk_of_temporary_files_holds_a_job() {
    let Some(disk) = SmallDisk::mount(1) else { return };
    let folder = folder(9, &[(32, 32)]);
    let run = || {
        // Room for a few of the photographs.
        let limits = MemoryLimits { host: 64 << 10, gpu: Some(8 << 30) };
        let pipeline = Pipeline::new(gpu::choice()).within(limits, disk.path().to_owned());
        let nothing = CheckpointPlan::default();
        pipeline.run(folder.path(), &options(3), &nothing, &mut |_, _| {}, &CancelFlag::default())
    };
    disk.fill();
    match run() {
        Err(JobError::Hold(problem)) => assert!(problem.kind.ends_with("storage-full"), "{problem}"),
        other => panic!("{:?}", other.map(|_| ())),
    }
    disk.make_room();
    match run() {
        // They are read now, and training says that it needs more memory than that.
        Err(JobError::Fail(problem)) => assert!(problem.kind.ends_with("memory-budget"), "{problem}"),
        other => panic!("{:?}", other.map(|_| ())),
    }
}

#[test]
fn each_image_that_is_read_is_a_sign_of_life_and_a_chance_to_stop() {
    let folder = folder(9, &[(32, 32)]);
    let asked = AtomicUsize::new(0);
    let up_to = |most: usize| {
        asked.store(0, Ordering::SeqCst);
        ingest::load_cancellable(folder.path(), &LoadBudget::default(), &|| {
            asked.fetch_add(1, Ordering::SeqCst) < most
        })
    };
    assert_eq!(up_to(usize::MAX).expect("a dataset").frames.len(), 9);
    assert_eq!(asked.load(Ordering::SeqCst), 18, "each header, then each image");
    for most in [0, 3, 9, 17] {
        let error = up_to(most).expect_err("it was to stop");
        assert!(matches!(error.kind, ingest::IngestErrorKind::Stopped), "{error}");
    }

    let pipeline = Pipeline::new(gpu::choice());
    let run = |stop_at: usize| {
        let (cancel, mut reports) = (CancelFlag::default(), Vec::new());
        let mut report = |phase: Phase, _: &Progress| {
            reports.push(phase);
            if reports.len() == stop_at {
                cancel.cancel();
            }
        };
        let ended =
            pipeline.run(folder.path(), &options(3), &CheckpointPlan::default(), &mut report, &cancel);
        assert!(matches!(ended, Err(JobError::Cancelled)), "{:?}", ended.map(|_| ()));
        reports
    };
    let reports = run(5);
    assert!(reports.iter().all(|phase| *phase == Phase::Ingest), "{reports:?}");
    let reports = run(20);
    let reading = reports.iter().filter(|phase| **phase == Phase::Ingest).count();
    assert_eq!(reading, 1 + 18, "as it begins, and for each header and image");
}

#[test]
fn the_command_line_refuses_with_status_4_and_says_what_is_needed() {
    let folder = folder(9, &[(32, 32)]);
    let out = folder.path().join("scene.tcgs");
    let arguments = |flags: &[&str]| -> Vec<std::ffi::OsString> {
        let mut all = vec!["train".into(), folder.path().into(), "-o".into(), out.clone().into()];
        all.extend(["--iterations", "3", "--json"].map(Into::into));
        all.extend(flags.iter().map(Into::into));
        all
    };
    let refused = program::tcgs(arguments(&["--gpu-memory", "2MiB"]));
    assert_eq!(refused.status.code(), Some(4), "{}", String::from_utf8_lossy(&refused.stderr));
    let problem: Value = serde_json::from_slice(&refused.stdout).expect("one JSON document");
    assert_eq!(problem["type"], "urn:tcgs:problem:memory-budget");
    assert!(problem["detail"].as_str().is_some_and(|detail| detail.contains("of 2.0 MiB")), "{problem}");
    assert!(!out.exists());
    assert_eq!(program::tcgs(arguments(&["--host-memory", "plenty"])).status.code(), Some(2));

    let trained = program::tcgs(arguments(&["--gpu-memory", "1GiB", "--host-memory", "1GiB"]));
    let log = String::from_utf8_lossy(&trained.stderr);
    assert_eq!(trained.status.code(), Some(0), "{log}");
    assert!(!log.contains("memory: "), "that it fits is of no interest to a person: {log}");
    assert!(out.exists());
    let mut told = program::command();
    told.args(arguments(&[])).env("RUST_LOG", "tcgs_engine::train::memory_estimate=info");
    let log = told.output().expect("runs").stderr;
    let log = String::from_utf8_lossy(&log);
    assert_eq!(log.lines().filter(|line| line.contains("memory: ")).count(), 1, "{log}");
}

/// Most memory that this process ever held, in bytes.
#[cfg(target_os = "linux")]
fn peak_resident_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").expect("the process's figures");
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a peak");
    line.trim().trim_end_matches("kB").trim().parse::<u64>().expect("a number") * 1024
}

/// The real thing: `cargo test --test it -- --ignored --nocapture a_thousand`. It reads for minutes and needs 5 GB of disk for
/// the folder of temporary files (`TMPDIR`), which are gone when it ends. It does not begin where they would fill the disk.
#[cfg(target_os = "linux")]
#[test]
#[ignore = "takes minutes and 5 GB of disk"]
fn a_thousand_photographs_of_4k_fit_into_a_gigabyte() {
    const FRAMES: usize = 1000;
    const DISK: u64 = 5 << 30;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let free = fs4::available_space(folder.path()).expect("a disk");
    assert!(free > 2 * DISK, "{free} bytes are free in {}; others need room too", folder.path().display());
    let mut jpeg = std::io::Cursor::new(Vec::new());
    let image = RgbImage::from_fn(3840, 2160, |x, y| {
        let wave = |v: u32, by: f64| (127.0 + 120.0 * (f64::from(v) / by).sin()) as u8;
        Rgb([wave(x, 211.0), wave(y, 97.0), wave(x + 3 * y, 509.0)])
    });
    DynamicImage::from(image).write_to(&mut jpeg, ImageFormat::Jpeg).expect("encodes");
    let photograph = folder.path().join("photograph");
    fs::write(&photograph, jpeg.get_ref()).expect("written");
    let listed = (0..FRAMES)
        .map(|index| {
            let name = format!("{index:04}.jpg");
            // One file under a thousand names.
            fs::hard_link(&photograph, folder.path().join(&name)).expect("linked");
            let mut frame = pose(index, FRAMES);
            frame["file_path"] = json!(name);
            frame["fl_x"] = json!(4000.0);
            frame
        })
        .collect();
    write_table(folder.path(), listed);
    let before = peak_resident_bytes();
    let budget = tight(folder.path(), 1 << 30);
    let dataset = ingest::load_with_budget(folder.path(), &budget).expect("a dataset");
    let peak = peak_resident_bytes();
    let all: u64 = dataset.frames.iter().map(|frame| frame.image.bytes()).sum();
    println!(
        "{} MB of photographs, {} MB of them in memory; resident at most {} MB, {} MB before",
        all / 1_000_000,
        dataset.bytes_in_memory() / 1_000_000,
        peak / 1_000_000,
        before / 1_000_000
    );
    assert_eq!(dataset.frames.len(), FRAMES);
    assert!(
        peak - before < budget.memory_bytes + (256 << 20),
        "the budget is the bound, allocator and stacks aside"
    );
    assert!(dataset.frames[FRAMES - 1].image.load().is_ok());
    drop(dataset);
    let left = fs::read_dir(folder.path()).expect("a folder").count();
    assert_eq!(left, FRAMES + 2, "the photographs and their table are as they were");
}
