//! The whole road with nothing faked: the real program trains, compresses, serves and measures a small scene, over HTTP
//! and on the command line, and both give the same bits.

use std::{
    collections::BTreeSet,
    ffi::OsStr,
    path::{Path, PathBuf},
    sync::OnceLock,
};

use glam::DVec3;
use image::{ExtendedColorType, ImageEncoder as _, codecs::png::PngEncoder};
use serde_json::{Value, json};
use tcgs::{
    codec::{self, DecodeLimits},
    domain::{
        Camera, CancelFlag, Convention, Digest, Image, Intrinsics, Phase, Pose, Progress, TrainOptions,
    },
    pipeline::{CheckpointPlan, JobError, Pipeline, Resume, RunJob as _},
    render::{RenderViews as _, SceneViewer, views::Viewable},
    sample::{self, Settings},
};
use tempfile::TempDir;

use crate::support::{
    gpu, lpips,
    program::{answers, succeeds, tcgs},
    recorded::{assert_bytes, assert_psnr, assert_ssim},
    server::{Answer, picture},
    service::Service,
};

const STEPS: u32 = 60;
/// Of a job with several attempts, so that each trains for seconds. Progress is reported once a second: an attempt that resumed
/// shortly before the last of [`STEPS`] would end without having been seen in training.
const STEPS_OF_ATTEMPTS: u32 = 3 * STEPS;
const SEED: u64 = 5;
const SIDE: u32 = 48;
const HELD_OUT: &str = "images/view_06.png";

/// The bundled scene, small, as a folder and as a zip, each written when it is first asked for.
struct Scene {
    folder: TempDir,
}

impl Scene {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().expect("a folder") }
    }

    fn directory(&self) -> PathBuf {
        self.written("scene")
    }

    fn zip(&self) -> PathBuf {
        self.written("scene.zip")
    }

    fn zip_bytes(&self) -> Vec<u8> {
        std::fs::read(self.zip()).expect("readable")
    }

    /// Weights of LPIPS.
    fn weights(&self) -> PathBuf {
        let path = self.at("weights.safetensors");
        if !path.exists() {
            std::fs::write(&path, lpips::file(&lpips::weights("alex"))).expect("writes");
        }
        path
    }

    fn written(&self, name: &str) -> PathBuf {
        let path = self.at(name);
        if !path.exists() {
            sample::write(&path, &Settings { points: 400, ..Settings::square(SIDE) }).expect("writes");
        }
        path
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

/// What `tcgs train` makes of the folder of the scene.
struct Reference {
    file: Vec<u8>,
    metrics: Value,
}

impl Reference {
    fn trained(steps: u32) -> Self {
        let scene = Scene::new();
        let out = scene.at("out.tcgs");
        let metrics = train(&scene.directory(), &out, steps, &["--json"]);
        let metrics = serde_json::from_str(&metrics).expect("one JSON document");
        Self { file: std::fs::read(out).expect("a file"), metrics }
    }
}

/// The run of [`STEPS`].
fn reference() -> &'static Reference {
    static REFERENCE: OnceLock<Reference> = OnceLock::new();
    REFERENCE.get_or_init(|| Reference::trained(STEPS))
}

/// Standard output of `tcgs train` with the settings of every run here.
fn train(dataset: &Path, out: &Path, steps: u32, more: &[&str]) -> String {
    let (steps, seed) = (steps.to_string(), SEED.to_string());
    let mut arguments = vec![OsStr::new("train"), dataset.as_os_str(), "-o".as_ref(), out.as_os_str()];
    arguments.extend(["--iterations", &steps, "--seed", &seed].map(OsStr::new));
    arguments.extend(more.iter().map(OsStr::new));
    succeeds(arguments)
}

fn query(steps: u32) -> String {
    format!("?iterations={steps}&seed={SEED}")
}

/// Arguments of several types as one line.
macro_rules! line {
    ($($argument:expr),+ $(,)?) => { vec![$(AsRef::<OsStr>::as_ref(&$argument)),+] };
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is not a number"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_goes_in_over_http_and_a_file_and_views_come_out() {
    let scene = Scene::new();
    let service = Service::start_with(&scene.at("data"), line!["--lpips", scene.weights()]).await;
    refusals(&service, &scene).await;

    let created = service.upload(&query(STEPS), scene.zip_bytes()).await.expect(201);
    let path = created.header("location").to_owned();
    assert_eq!(created.json()["state"], "queued");
    service.get(&format!("{path}/artifact")).await.expect_problem(409, "no-artifact");
    let mut steps = BTreeSet::new();
    let job = service
        .job_until(&path, |now| {
            steps.insert(now["progress"]["step"].as_u64().expect("a step"));
            now["state"] == "succeeded"
        })
        .await;
    assert!(steps.len() > 2, "progress is seen while the job runs: {steps:?}");
    check_metrics(&job);

    let artifact = service.get(&format!("{path}/artifact")).await.expect(200);
    let file = scene.at("job.tcgs");
    std::fs::write(&file, &artifact.body).expect("writes");
    assert_eq!(job["artifacts"][0]["sha256"], json!(Digest::of(&artifact.body)));
    assert_eq!(job["artifacts"][0]["bytes"], artifact.body.len());
    check_inspection(&file, &job, artifact.body.len() as u64);
    check_decoding(&scene, &file, &job);
    check_evaluation(&scene, &file, &job);
    check_events(&service, &path).await;
    check_views(&service, &path, &scene, &file).await;
    check_export(&service, &path).await;

    assert!(artifact.body == reference().file, "the service and the command line give different files");
    let again = scene.at("again.tcgs");
    let said = train(&scene.zip(), &again, STEPS, &[]);
    assert!(said.contains("dB") && said.contains("over 8 views on black"), "{said}");
    assert!(
        std::fs::read(&again).expect("a file") == reference().file,
        "a zip and a folder give different files"
    );
    assert!(service.stop().await.success(), "a service that is asked to stop ends well");
}

/// What is no dataset is refused by name before a job is made of it.
async fn refusals(service: &Service, scene: &Scene) {
    let whole = scene.zip_bytes();
    let half = whole[..whole.len() / 2].to_vec();
    service.upload("", half.clone()).await.expect_problem(422, "archive-rejected");
    service.upload("", b"no zip".to_vec()).await.expect_problem(400, "not-a-zip");
    service.upload("?iterations=0", whole).await.expect_problem(422, "invalid-option");
    assert_eq!(service.get("/v1/jobs").await.expect(200).json()["jobs"], json!([]));

    let (cut, out) = (scene.at("half.zip"), scene.at("never.tcgs"));
    std::fs::write(&cut, half).expect("writes");
    assert_eq!(tcgs(line!["train", cut, "-o", out]).status.code(), Some(3));
    let incomplete = scene.at("incomplete");
    sample::write(&incomplete, &Settings { points: 10, ..Settings::square(16) }).expect("writes");
    std::fs::remove_file(incomplete.join("images/view_07.png")).expect("removed");
    let refused = tcgs(line!["train", incomplete, "-o", out]);
    assert_eq!(refused.status.code(), Some(3));
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(said.contains("images/view_07.png"), "{said}");
    assert!(!out.exists());
}

fn check_metrics(job: &Value) {
    let metrics = &job["metrics"];
    for (split, views, psnr, ssim) in [("test", 8_usize, 16.44, 0.539), ("train", 16, 16.84, 0.559)] {
        let scores = &metrics[split];
        assert_eq!(scores["views"], views);
        assert_psnr(&format!("{split} views"), number(&scores["psnr"]), psnr);
        assert_ssim(&format!("{split} views"), number(&scores["ssim"]), ssim);
        assert_eq!(scores["lpips_network"], "lpips-alex");
        let per_view = scores["per_view"].as_array().expect("a list");
        assert_eq!(per_view.len(), views);
        for figure in ["psnr", "ssim", "lpips"] {
            let mean = per_view.iter().map(|view| number(&view[figure])).sum::<f64>() / views as f64;
            assert!((mean - number(&scores[figure])).abs() < 1e-9, "{figure}: {mean} {scores}");
        }
        assert!(number(&scores["lpips"]) > 0.0, "{scores}");
    }
    assert_eq!(metrics["test"]["per_view"][1]["name"], HELD_OUT);
    let stated = metrics["conventions"]["lpips"].as_str().expect("a phrase");
    assert!(stated.starts_with("lpips-alex-v0.1"), "{stated}");
    let lost = number(&metrics["psnr_before_quantisation"]) - number(&metrics["test"]["psnr"]);
    assert_psnr("what quantization costs", lost, 0.0);
    assert_bytes("the file", number(&metrics["bytes"]["total"]) as u64, 17_258);
    let bytes = metrics["bytes"].as_object().expect("byte counts");
    let parts: u64 =
        bytes.iter().filter(|(name, _)| *name != "total").map(|(_, n)| n.as_u64().expect("n")).sum();
    assert_eq!(bytes["total"], parts);
    assert_eq!(bytes["total"], job["artifacts"][0]["bytes"]);
    for part in ["positions", "networks", "features", "scalings", "offsets", "container"] {
        assert!(bytes[part].as_u64() > Some(0), "{part} takes no bytes");
    }
    assert_eq!(metrics["steps"], STEPS);
    assert!(number(&metrics["steps_per_second"]) > 0.0);
    let (anchors, gaussians) = (number(&metrics["anchors"]), number(&metrics["gaussians"]));
    assert!(anchors > 100.0 && gaussians >= anchors, "{anchors} anchors, {gaussians} Gaussians");
    assert_eq!(metrics["background"], "black");
    assert_eq!((&job["phase"], &job["attempt"], &job["error"]), (&json!("done"), &json!(1), &Value::Null));
    // The clock of the progress runs on after training.
    let spent = ["ingest", "train", "encode", "decode"].map(|phase| number(&metrics["seconds"][phase]));
    assert!(spent.iter().all(|seconds| *seconds > 0.0), "a phase took no time: {spent:?}");
    assert!(number(&job["progress"]["elapsed_seconds"]) >= spent.iter().sum::<f64>(), "{job:#}");
}

fn check_inspection(file: &Path, job: &Value, length: u64) {
    let inspection = answers(line!["inspect", file, "--json"]);
    let mut at = 0;
    for range in inspection["ranges"].as_array().expect("ranges") {
        assert_eq!(range["offset"], at, "{range}");
        at += range["length"].as_u64().expect("a length");
    }
    assert_eq!(at, length, "every byte is accounted for");
    assert_eq!(inspection["byte_counts"], job["metrics"]["bytes"]);
    let provenance = inspection["manifest"]["provenance"].to_string();
    assert!(provenance.contains(&format!("\"iterations\":{STEPS}")), "{provenance}");
    let table = succeeds(line!["inspect", file]);
    assert!(table.contains(&format!("{length} bytes")), "{table}");
    for choice in
        ["voxel", "anchors at most", "feature width", "offsets per anchor", "context of the features"]
    {
        let because = inspection["choices"].as_array().expect("choices").iter();
        let because = because.filter(|said| said["what"] == choice).map(|said| &said["because"]);
        let because = because.map(|because| because.as_str().expect("words")).collect::<Vec<_>>();
        assert!(because.len() == 1 && table.contains(because[0]), "{choice}: {because:?}");
    }
}

fn check_decoding(scene: &Scene, file: &Path, job: &Value) {
    let decoded = answers(line!["decode", file, "-o", scene.at("job.safetensors"), "--json"]);
    for figure in ["decode_sha256", "anchors", "gaussians"] {
        assert_eq!(decoded[figure], job["metrics"][figure], "{figure}");
    }
}

/// On one adapter, `tcgs eval` gives the figures of the job to the last bit.
fn check_evaluation(scene: &Scene, file: &Path, job: &Value) {
    let saved = scene.at("saved");
    let weights = scene.weights();
    let measured =
        answers(line!["eval", file, scene.directory(), "--json", "--save", saved, "--lpips", weights]);
    for figure in
        ["test", "bytes", "anchors", "gaussians", "decode_sha256", "adapter", "background", "conventions"]
    {
        assert_eq!(measured[figure], job["metrics"][figure], "{figure}");
    }
    assert_eq!(measured["same_dataset"], true);
    let pair = picture(&std::fs::read(saved.join("images_view_06.png")).expect("saved"));
    assert_eq!((pair.width(), pair.height()), (2 * SIDE, SIDE), "photograph and render, side by side");

    let other = scene.at("other");
    sample::write(&other, &Settings { points: 10, ..Settings::square(16) }).expect("writes");
    let foreign = tcgs(line!["eval", file, other, "--per-view"]);
    let text = String::from_utf8_lossy(&foreign.stdout).into_owned();
    assert!(text.contains("\nmeasured  on 8-bit RGB") && text.contains("\nimages/view_06.png  "), "{text}");
    assert!(text.contains("over 8 views on black") && text.contains(" bytes; "), "{text}");
    assert!(String::from_utf8_lossy(&foreign.stderr).contains("another dataset"));
    let small = tcgs(line!["eval", file, other, "--lpips", weights]);
    assert_eq!(small.status.code(), Some(3));
    let said = String::from_utf8_lossy(&small.stderr).into_owned();
    assert!(said.contains("images/view_00.png") && said.contains("16x16"), "{said}");
}

async fn check_events(service: &Service, path: &str) {
    let page = service.get(&format!("{path}/events")).await.expect(200).json();
    let events = page["events"].as_array().expect("events");
    let of = |kind: &str| {
        events.iter().filter(|event| event["kind"] == kind).map(|event| &event["data"]).collect()
    };
    let states: Vec<&Value> = of("state");
    let states: Vec<&Value> = states.iter().map(|data| &data["state"]).collect();
    assert_eq!(states, ["queued", "running", "succeeded"]);
    let phases: Vec<&Value> = of("phase");
    let phases: Vec<&Value> = phases.iter().map(|data| &data["phase"]).collect();
    assert!(phases.contains(&&json!("train")) && phases.contains(&&json!("publish")), "{phases:?}");
    let reports: Vec<&Value> = of("progress");
    assert!(!reports.is_empty(), "{page:#}");
    for pair in reports.windows(2) {
        for figure in ["step", "elapsed_seconds"] {
            assert!(number(&pair[0][figure]) <= number(&pair[1][figure]), "{figure}: {page:#}");
        }
    }
    for report in reports.iter().filter(|report| report["step"] != 0) {
        for figure in ["total", "anchors", "gaussians", "loss", "psnr", "steps_per_second"] {
            assert!(number(&report[figure]) > 0.0, "{figure}: {report}");
        }
    }
}

/// One camera gives one picture, however it is asked for.
/// An export says how alike it looks, and where the job's files are listed.
async fn check_export(service: &Service, job: &str) {
    let export = service.get(&format!("{job}/export?format=ply")).await.expect(200);
    let psnr: f64 = export.header("x-export-psnr").parse().expect("a number");
    assert_psnr("the export against its source", psnr, 37.49);
    let listed = service.get(&format!("{job}/artifacts")).await.expect(200).json();
    let listed =
        listed["artifacts"].as_array().expect("files").iter().find(|file| file["origin"] == "export");
    let fidelity = &listed.expect("the export")["fidelity"];
    assert!((number(&fidelity["psnr"]) - psnr).abs() < 0.006, "{fidelity}");
    assert_eq!(fidelity["views"], 8, "all that were held out");
}

async fn check_views(service: &Service, path: &str, scene: &Scene, file: &Path) {
    let by_frame = service.get(&format!("{path}/view?frame={HELD_OUT}")).await.expect(200);
    assert_eq!(by_frame.header("content-type"), "image/png");
    let seen = picture(&by_frame.body);
    assert_eq!((seen.width(), seen.height()), (SIDE, SIDE));
    let colors: BTreeSet<&[u8]> = seen.as_bytes().chunks(3).collect();
    assert!(colors.len() > 100, "a picture of something has more than {} colors", colors.len());

    let [opengl, opencv] = poses(&scene.directory().join("transforms.json"));
    for view in [&opengl, &opencv, &json!({ "frame": "view_06" })] {
        let by_pose =
            service.post_json(&format!("{path}/views"), &json!({ "views": [view] })).await.expect(200);
        assert!(by_pose.body == by_frame.body, "{view} gives another picture");
    }
    let several = json!({ "views": [opengl, { "frame": HELD_OUT }], "format": "png" });
    let several = service.post_json(&format!("{path}/views"), &several).await.expect(200);
    assert!(several.header("content-type").starts_with("multipart/mixed"));
    assert_eq!(occurrences(&several.body, &by_frame.body), 2);

    let (pose, out) = (scene.at("pose.json"), scene.at("view.png"));
    std::fs::write(&pose, opencv.to_string()).expect("writes");
    let directory = scene.directory();
    for camera in [line!["--dataset", directory, "--frame", "view_06"], line!["--pose", pose]] {
        let said = succeeds([line!["render", file, "-o", out], camera.clone()].concat());
        assert!(said.contains("view.png"), "{said}");
        let rendered = picture(&std::fs::read(&out).expect("a picture"));
        assert!(rendered.as_bytes() == seen.as_bytes(), "{camera:?} gives other pixels");
    }

    let looked = "position=2.6,-2.2,2.4&look_at=0.12,0.1,0.32&up=0,0,1&fov=49&width=60&height=40";
    let looked = service.get(&format!("{path}/view?{looked}")).await.expect(200);
    check_look_at(service, path, &looked).await;
    service.get(&format!("{path}/view?frame=view_99")).await.expect_problem(404, "frame-not-found");
    let nowhere = "position=1,2,3&look_at=1,2,3";
    service.get(&format!("{path}/view?{nowhere}")).await.expect_problem(422, "impossible-view");
    let mut scaled = opencv;
    scaled["camera_to_world"][0][0] = json!(7.0);
    let scaled = json!({ "views": [scaled] });
    service.post_json(&format!("{path}/views"), &scaled).await.expect_problem(422, "impossible-view");
    let unknown = tcgs(line!["render", file, "--dataset", directory, "--frame", "view_99", "-o", out]);
    assert_eq!(unknown.status.code(), Some(3));
}

/// A look-at view has the size that was asked for and shows what the camera at its matrix shows.
async fn check_look_at(service: &Service, path: &str, answer: &Answer) {
    let (eye, target) = (DVec3::new(2.6, -2.2, 2.4), DVec3::new(0.12, 0.1, 0.32));
    let pose = Pose::look_at(eye, target, DVec3::Z).expect("a view");
    let k = Intrinsics::from_horizontal_fov(49_f64.to_radians(), 60, 40).expect("a camera");
    let matrix = pose.camera_to_world(Convention::Opengl).transpose().to_cols_array_2d();
    let view =
        json!({ "camera_to_world": matrix, "convention": "opengl", "fx": k.fx, "width": 60, "height": 40 });
    let same = service.post_json(&format!("{path}/views"), &json!({ "views": [view] })).await.expect(200);
    let (a, b) = (picture(&answer.body), picture(&same.body));
    assert_eq!((a.width(), a.height()), (60, 40));
    // The matrix is the pose rounded to f64 and inverted, so single pixels may round otherwise.
    let worst = a.as_bytes().iter().zip(b.as_bytes()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(1), "{worst:?}");
}

/// The held-out camera as the dataset states it, and with the camera's y and z axes turned to OpenCV's.
fn poses(transforms: &Path) -> [Value; 2] {
    let text = std::fs::read_to_string(transforms).expect("readable");
    let document: Value = serde_json::from_str(&text).expect("JSON");
    let frames = document["frames"].as_array().expect("frames");
    let frame = frames.iter().find(|frame| frame["file_path"] == HELD_OUT).expect("the frame");
    let opengl: [[f64; 4]; 4] = serde_json::from_value(frame["transform_matrix"].clone()).expect("a matrix");
    let opencv = opengl.map(|[x, y, z, w]| [x, -y, -z, w]);
    [("opengl", opengl), ("opencv", opencv)].map(|(convention, rows)| {
        json!({
            "camera_to_world": rows, "convention": convention,
            "fx": document["fl_x"], "fy": document["fl_y"], "cx": document["cx"], "cy": document["cy"],
            "width": document["w"], "height": document["h"],
        })
    })
}

fn occurrences(haystack: &[u8], needle: &[u8]) -> usize {
    haystack.windows(needle.len()).filter(|window| *window == needle).count()
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_survives_a_restart_of_the_service_and_a_killed_worker() {
    use crate::support::service::kill;

    let scene = Scene::new();
    let service = Service::start(&scene.at("data")).await;
    let created = service.upload(&query(STEPS_OF_ATTEMPTS), scene.zip_bytes()).await.expect(201);
    let path = created.header("location").to_owned();
    let is_under_way = |now: &Value, attempt: u32| {
        now["attempt"] == attempt && now["phase"] == "train" && now["progress"]["step"] != 0
    };
    service.job_until(&path, |now| is_under_way(now, 1)).await;
    assert!(service.stop().await.success(), "a service that is asked to stop ends well");

    let service = Service::start(&scene.at("data")).await;
    service.job_until(&path, |now| is_under_way(now, 2)).await;
    let workers = service.workers();
    assert_eq!(workers.len(), 1, "{}", service.log());
    kill("-KILL", workers[0]);
    service.get("/healthz").await.expect(200);
    service.get(&path).await.expect(200);

    let job = service.succeeded(&path).await;
    assert_eq!(job["attempt"], 3);
    assert_ne!(service.workers(), workers, "another worker has taken its place");
    let events = service.get(&format!("{path}/events?limit=1000")).await.expect(200).json();
    let events = events["events"].as_array().expect("events");
    let ends: Vec<&Value> = events
        .iter()
        .filter(|event| event["kind"] == "attempt")
        .map(|event| &event["data"]["outcome"])
        .collect();
    assert_eq!(ends, ["released", "lost"]);
    assert_eq!(job["artifacts"].as_array().map(Vec::len), Some(1));
    let artifact = service.get(&format!("{path}/artifact")).await.expect(200);
    let reference = Reference::trained(STEPS_OF_ATTEMPTS);
    assert!(artifact.body == reference.file, "the third attempt gives another file");
    assert_eq!(job["metrics"]["test"], reference.metrics["test"]);
    let log = service.log();
    let resumed = log.lines().filter(|line| line.contains("resuming from step"));
    assert_eq!(resumed.count(), 2, "no attempt after the first begins with step 1: {log}");
    assert!(service.stop().await.success());
    let left: Vec<_> = std::fs::read_dir(scene.at("data").join("checkpoints")).expect("a folder").collect();
    assert!(left.is_empty(), "nobody needs the checkpoints of a job that has ended: {left:?}");
}

#[cfg(unix)]
#[test]
fn an_interrupted_command_goes_on_where_it_stopped() {
    use std::io::{BufRead as _, BufReader};

    use crate::support::{program, service::kill};

    let scene = Scene::new();
    let (out, kept) = (scene.at("out.tcgs"), scene.at("kept"));
    let (steps, seed) = (STEPS.to_string(), SEED.to_string());
    let dataset = scene.directory();
    let run = line!["train", dataset, "-o", out, "--iterations", steps, "--seed", seed];
    let mut child = program::command()
        .args(&run)
        .args(line!["--checkpoint", kept])
        .env("RUST_LOG", "debug")
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the binary runs");
    let mut said = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
    // Reported with the first round of growth, which is in the middle of the run.
    assert!(said.any(|line| line.contains("grown")), "nothing grew");
    // As `timeout`, containers and batch systems stop a command; an interrupt does the same.
    kill("-TERM", child.id());
    let rest: Vec<String> = said.collect();
    assert_eq!(child.wait().expect("ended").code(), Some(143), "{rest:#?}");
    let advice = format!("go on with --resume {}", kept.display());
    assert!(rest.iter().any(|line| line.contains(&advice)), "{rest:#?}");
    assert!(!out.exists());

    let other = [run.clone(), line!["--background", "white", "--resume", kept]].concat();
    let refused = tcgs(other);
    assert_eq!(refused.status.code(), Some(3));
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(said.contains(r#"background is "black" in the checkpoint and "white" here"#), "{said}");

    // The second time from the checkpoint of the last step.
    for _ in 0..2 {
        succeeds([run.clone(), line!["--resume", kept]].concat());
        assert!(std::fs::read(&out).expect("a file") == reference().file, "the run goes on to another file");
        std::fs::remove_file(&out).expect("removed");
    }
}

#[test]
fn a_checkpoint_that_cannot_be_used_makes_a_job_start_over_and_a_resumed_run_fail() {
    let scene = Scene::new();
    let kept = scene.at("kept");
    std::fs::create_dir(&kept).expect("made");
    std::fs::write(kept.join("checkpoint.safetensors"), b"torn").expect("writes");
    let pipeline = Pipeline::new(gpu::choice());
    let options = TrainOptions { iterations: Some(2), ..TrainOptions::default() };
    let run = |resume: Resume| {
        let checkpoints = CheckpointPlan { keep: Some(kept.clone()), resume };
        let mut steps = Vec::new();
        let mut report = |_: Phase, progress: &Progress| steps.push(progress.step);
        let output =
            pipeline.run(&scene.directory(), &options, &checkpoints, &mut report, &CancelFlag::default());
        output.map(|output| (output.file, steps))
    };
    match run(Resume::From(kept.clone())) {
        Err(JobError::Fail(problem)) => assert!(problem.detail.contains("not a complete"), "{problem}"),
        other => panic!("not refused: {other:?}"),
    }
    let (afresh, steps) = run(Resume::IfPossible(kept.clone())).expect("a file");
    assert!(steps.contains(&0));
    let (again, steps) = run(Resume::From(kept.clone())).expect("the checkpoint of the last step");
    assert!(again == afresh && !steps.contains(&1));
    std::fs::remove_dir_all(&kept).expect("removed");
    assert!(run(Resume::IfPossible(kept.clone())).expect("a file").0 == afresh, "no checkpoint is no fault");
}

#[test]
fn a_run_reports_every_phase_and_figure_and_stops_when_asked() {
    let scene = Scene::new();
    let pipeline = Pipeline::new(gpu::choice());
    let options = TrainOptions { iterations: Some(STEPS), seed: SEED, ..TrainOptions::default() };
    let mut reports: Vec<(Phase, Progress)> = Vec::new();
    let mut report = |phase: Phase, progress: &Progress| reports.push((phase, progress.clone()));
    let fresh = CheckpointPlan::default();
    let output = pipeline
        .run(&scene.directory(), &options, &fresh, &mut report, &CancelFlag::default())
        .expect("a file");
    assert!(output.file == reference().file, "another process gives another file");

    let mut phases: Vec<Phase> = reports.iter().map(|(phase, _)| *phase).collect();
    phases.dedup();
    assert_eq!(phases, [Phase::Ingest, Phase::Train, Phase::Encode, Phase::Evaluate]);
    assert!(reports.iter().all(|(_, progress)| progress.total == u64::from(STEPS)));
    assert!(reports.windows(2).all(|pair| pair[0].1.elapsed_seconds <= pair[1].1.elapsed_seconds));
    let of = |wanted: Phase| reports.iter().filter(move |(phase, _)| *phase == wanted).map(|(_, p)| p);
    let training: Vec<&Progress> = of(Phase::Train).collect();
    assert!(training.windows(2).all(|pair| pair[0].step < pair[1].step), "{training:#?}");
    assert_eq!(training.first().map(|first| first.step), Some(0), "training is told of as it begins");
    assert_eq!(training.last().map(|last| last.step), Some(u64::from(STEPS)));
    for progress in &training[1..] {
        assert!(progress.anchors > 0 && progress.gaussians > 0, "{progress:?}");
        for figure in [progress.loss, progress.psnr, progress.steps_per_second] {
            assert!(figure.is_some_and(|v| v.is_finite() && v > 0.0), "{progress:?}");
        }
        assert!(progress.eta_seconds.is_some_and(|v| v >= 0.0), "{progress:?}");
    }
    assert!(of(Phase::Encode).chain(of(Phase::Evaluate)).all(|progress| progress.eta_seconds.is_none()));

    let cancel = CancelFlag::default();
    let mut steps = 0;
    let mut stop = |_: Phase, progress: &Progress| {
        steps = progress.step;
        if progress.step > 0 {
            cancel.cancel();
        }
    };
    let stopped = pipeline.run(&scene.directory(), &options, &fresh, &mut stop, &cancel);
    assert!(matches!(stopped, Err(JobError::Cancelled)), "{stopped:?}");
    assert!(steps < u64::from(STEPS));
}

#[test]
fn a_viewer_opens_the_device_again_after_it_was_lost() {
    let file = &reference().file;
    let decoded = codec::decode(file, &DecodeLimits::default()).expect("decodes");
    let viewable = Viewable {
        scene: tcgs::domain::Scene::Anchors(decoded.scene),
        background: decoded.manifest.background,
    };
    let pose = Pose::look_at(DVec3::new(3.0, -2.0, 2.0), DVec3::ZERO, DVec3::Z).expect("a view");
    let intrinsics = Intrinsics::from_horizontal_fov(0.9, 40, 30).expect("a camera");
    let camera = Camera::new(intrinsics, pose).expect("a camera");
    let viewer = SceneViewer::open(gpu::choice()).expect("an adapter");
    let render = || viewer.render(Digest::of(file), &|| Ok(viewable.clone()), &camera);
    let before = render().expect("a picture");
    for _ in 0..2 {
        viewer.destroy_device();
        assert!(render().expect("a picture again") == before, "the new device gives another picture");
    }
}

#[test]
fn the_background_of_a_set_with_alpha_is_the_one_that_was_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let set = folder.path().join("ball");
    write_ball(&set);
    // Turned away from the ball, a view shows the background alone.
    let away = json!({
        "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 50], [0, 0, 0, 1]],
        "fx": 30, "width": 8, "height": 8,
    })
    .to_string();
    let (file, view) = (folder.path().join("ball.tcgs"), folder.path().join("away.png"));
    let flags = ["--iterations", "4", "--background", "white", "--json"];
    let metrics = answers([line!["train", set, "-o", file], flags.map(OsStr::new).to_vec()].concat());
    assert_eq!(metrics["background"], "white");
    assert_eq!(metrics["test"]["views"], 2);
    let inspection = answers(line!["inspect", file, "--json"]);
    assert_eq!(inspection["manifest"]["background"], "white");
    succeeds(line!["render", file, "--pose", away, "-o", view]);
    let seen = picture(&std::fs::read(&view).expect("a picture"));
    assert!(seen.as_bytes().iter().all(|sample| *sample == 255), "{:?}", seen.as_bytes());
    let measured = answers(line!["eval", file, set, "--json"]);
    assert_eq!(measured["test"], metrics["test"]);
}

/// A gray ball before nothing, in the Blender layout: RGBA images, transparent outside the ball.
fn write_ball(folder: &Path) {
    const SIDE: u32 = 16;
    let fov = 0.7_f64;
    let intrinsics = Intrinsics::from_horizontal_fov(fov, SIDE, SIDE).expect("a camera");
    for (split, count) in [("train", 8), ("test", 2)] {
        std::fs::create_dir_all(folder.join(split)).expect("made");
        let frames: Vec<Value> = (0..count)
            .map(|index| {
                let turn = f64::from(index) * 0.7 + if split == "test" { 0.3 } else { 0.0 };
                let eye = DVec3::new(4.0 * turn.cos(), 4.0 * turn.sin(), 1.0);
                let pose = Pose::look_at(eye, DVec3::ZERO, DVec3::Z).expect("a view");
                let camera = Camera::new(intrinsics, pose).expect("a camera");
                let name = format!("{split}/r_{index}");
                std::fs::write(folder.join(format!("{name}.png")), ball(&camera)).expect("writes");
                let rows = pose.camera_to_world(Convention::Opengl).transpose().to_cols_array_2d();
                json!({ "file_path": format!("./{name}"), "transform_matrix": rows })
            })
            .collect();
        let document = json!({ "camera_angle_x": fov, "frames": frames });
        std::fs::write(folder.join(format!("transforms_{split}.json")), document.to_string())
            .expect("writes");
    }
}

/// The ball of radius 0.8 as a PNG.
fn ball(camera: &Camera) -> Vec<u8> {
    let Intrinsics { fx, fy, cx, cy, width, height } = camera.intrinsics;
    let center = camera.pose.rotation() * -camera.pose.center();
    let samples = (0..width * height)
        .flat_map(|pixel| {
            let (x, y) = (f64::from(pixel % width) + 0.5, f64::from(pixel / width) + 0.5);
            let ray = DVec3::new((x - cx) / fx, (y - cy) / fy, 1.0).normalize();
            let hit = center.cross(ray).length() < 0.8;
            if hit { [128, 128, 128, 255] } else { [0; 4] }
        })
        .collect();
    let image = Image::new(width, height, 4, samples).expect("an image");
    let mut file = Vec::new();
    PngEncoder::new(&mut file)
        .write_image(image.samples(), width, height, ExtendedColorType::Rgba8)
        .expect("a picture");
    file
}
