//! Jobs of photographs without cameras: found by a stand-in for pycolmap, recorded before training, cancelled, resumed and refused.
#![cfg(unix)]

use std::{
    fs,
    io::Cursor,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
};

use glam::DQuat;
use serde_json::{Value, json};
use tcgs::{
    domain::Dataset,
    sample::{self, Settings},
};
use tempfile::TempDir;

use crate::support::{
    program,
    service::{Service, kill},
};

/// Options that make training short.
const SHORT: &str = "?preset=preview&iterations=3";

/// Photographs with an interpreter that knows their cameras.
struct Setup {
    folder: TempDir,
    /// A zip of the photographs alone.
    photographs: Vec<u8>,
}

impl Setup {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = folder.path().join("scene");
        sample::write(&scene, &Settings { points: 100, ..Settings::square(16) }).expect("writes");
        let dataset = Dataset::load(&scene).expect("a dataset");
        write_model(&dataset, &folder.path().join("model"));
        let mut photographs = Cursor::new(Vec::new());
        tcgs::ingest::pack(&scene.join("images"), &mut photographs).expect("packs");
        let setup = Self { folder, photographs: photographs.into_inner() };
        setup.answer("found");
        setup.write_interpreter(&dataset);
        setup
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Lets the next searches end so: `found`, `no-overlap`, or `never`.
    fn answer(&self, mode: &str) {
        fs::write(self.path("mode"), mode).expect("written");
    }

    /// How many searches have begun.
    fn searches(&self) -> usize {
        self.lines("searches").len()
    }

    /// What searches have recorded.
    fn lines(&self, name: &str) -> Vec<String> {
        fs::read_to_string(self.path(name)).unwrap_or_default().lines().map(str::to_owned).collect()
    }

    fn write_interpreter(&self, dataset: &Dataset) {
        let mut names: Vec<&str> =
            dataset.frames.iter().map(|frame| frame.name.trim_start_matches("images/")).collect();
        names.sort_unstable();
        let found = json!({ "result": {
            "registered": names, "models": 1, "points": 100, "cameras": 1, "reprojection_error": 0.5, "verified_pairs": 9,
        }});
        fs::write(self.path("found.json"), format!("{found}\n")).expect("written");
        let script = format!(
            r#"#!/bin/sh
            cd '{folder}'
            for last; do :; done
            echo '{{"version": "1.2.3", "network": "none"}}'
            [ "$last" = --probe ] && exit
            echo search >> searches
            work=$(sed -n 's/.*"work":"\([^"]*\)".*/\1/p' "$last")
            echo "$(sed -n 's/.*"camera_model":"\([^"]*\)","matching":"\([^"]*\)".*/\1 \2/p' "$last")" >> asked
            # Features that an interrupted search has found.
            [ -e "$work/features.db" ] && echo known >> known
            touch "$work/features.db"
            echo '{{"stage": "features", "done": 12, "total": 48}}'
            case $(cat mode) in
            never) exec sleep 600;;
            no-overlap) echo '{{"failure": "no-overlap", "detail": "nothing in common"}}';;
            *)
                mkdir -p "$work/sparse/0"
                cp model/* "$work/sparse/0"
                echo '{{"stage": "mapping", "done": 48, "total": 48, "reprojection_error": 0.5}}'
                sleep 2
                cat found.json;;
            esac
            "#,
            folder = self.folder.path().display()
        );
        let path = self.path("python");
        fs::write(&path, script).expect("a script");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("executable");
    }

    async fn service(&self) -> Service {
        self.service_with(&self.path("python")).await
    }

    async fn service_with(&self, python: &Path) -> Service {
        let mut command = program::command();
        command.env("TCGS_POSES_PYTHON", python).env("TCGS_FFMPEG", "/no/ffmpeg");
        Service::start_as(command, &self.path("data"), ["--workers", "1"]).await
    }
}

/// COLMAP's model of a dataset, as text.
fn write_model(dataset: &Dataset, folder: &Path) {
    let (mut cameras, mut images) = (String::new(), String::new());
    for (number, frame) in (1..).zip(&dataset.frames) {
        let (camera, pose) = (&frame.camera.intrinsics, &frame.camera.pose);
        let quaternion = DQuat::from_mat3(&pose.rotation());
        let moved = -(pose.rotation() * pose.center());
        let name = frame.name.trim_start_matches("images/");
        let [x, y, z, w] = quaternion.to_array();
        let (k, size) = (camera, (camera.width, camera.height));
        cameras.push_str(&format!(
            "{number} PINHOLE {} {} {} {} {} {}\n",
            size.0, size.1, k.fx, k.fy, k.cx, k.cy
        ));
        images.push_str(&format!(
            "{number} {w} {x} {y} {z} {} {} {} {number} {name}\n\n",
            moved.x, moved.y, moved.z
        ));
    }
    let points = dataset.points.as_ref().expect("points");
    let points: String = (1..)
        .zip(points.positions.iter().zip(&points.colors))
        .map(|(number, ([x, y, z], [r, g, b]))| format!("{number} {x} {y} {z} {r} {g} {b} 0.5\n"))
        .collect();
    fs::create_dir(folder).expect("a folder");
    for (name, text) in [("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", points)] {
        fs::write(folder.join(name), text).expect("written");
    }
}

/// The path of a job that was created.
async fn post(service: &Service, photographs: &[u8]) -> (String, Value) {
    let job = service.upload(SHORT, photographs.to_vec()).await.expect(201).json();
    (format!("/v1/jobs/{}", job["id"].as_str().expect("an id")), job)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_of_photographs_finds_their_cameras_once() {
    let setup = Setup::new();
    let service = setup.service().await;
    let (path, created) = post(&service, &setup.photographs).await;
    let mapped = |job: &Value| job["progress"]["poses"]["stage"] == "mapping" || job["state"] != "running";
    let job = service.job_until(&path, |job| job["state"] != "queued" && mapped(job)).await;
    assert_eq!(
        (&job["phase"], &job["progress"]["poses"]["reprojection_error"]),
        (&json!("poses"), &json!(0.5))
    );
    let page = service.get(&format!("{path}/report")).await.expect(200);
    let page = String::from_utf8(page.body.to_vec()).expect("UTF-8");
    assert!(page.contains("cameras are found: mapping 48 of 48"), "{page}");
    let job = service.succeeded(&path).await;
    let events = service.get(&format!("{path}/events")).await.expect(200).json();
    let events = events["events"].as_array().expect("events").iter();
    let phases: Vec<&str> = events.filter_map(|event| event["data"]["phase"].as_str()).collect();
    assert_eq!(
        (phases[..2].to_vec(), phases.last()),
        (vec!["ingest", "poses"], Some(&"publish")),
        "{phases:?}"
    );

    // The dataset with cameras has taken the place of the photographs, and the model is a file of the job.
    assert_ne!(job["dataset"]["sha256"], created["dataset"]["sha256"]);
    let files = service.get(&format!("{path}/artifacts")).await.expect(200).json();
    let model =
        files["artifacts"].as_array().expect("files").iter().find(|file| file["kind"] == "sparse_model");
    let model = model.expect("the model");
    assert_eq!(model["media_type"], "application/zip");
    let zip = service.get(model["href"].as_str().expect("an address")).await.expect(200);
    for name in ["sparse/0/cameras.txt", "poses.json"] {
        assert!(zip.body.windows(name.len()).any(|window| window == name.as_bytes()), "{name}");
    }

    // Another job of the same photographs trains at once.
    let (path, again) = post(&service, &setup.photographs).await;
    assert_eq!(again["dataset"]["sha256"], job["dataset"]["sha256"]);
    service.succeeded(&path).await;
    assert_eq!(setup.searches(), 1);
    assert_eq!(service.stop().await.code(), Some(0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_search_ends_with_its_job_and_goes_on_after_a_crash_and_in_a_retry() {
    let setup = Setup::new();
    setup.answer("no-overlap");
    let service = setup.service().await;
    let (path, _) = post(&service, &setup.photographs).await;
    let failed = service.job_until(&path, |job| job["state"] == "failed").await;
    assert_eq!(failed["error"]["type"], "urn:tcgs:problem:no-overlap", "{failed:#}");

    setup.answer("never");
    let searching = |job: &Value| job["progress"]["poses"]["done"] == 12;
    let (path, _) = post(&service, &setup.photographs).await;
    service.job_until(&path, searching).await;
    service.send("POST", &format!("{path}/cancel"), |request| request).await.expect(202);
    service.job_until(&path, |job| job["state"] == "cancelled").await;

    let retried = service.send("POST", &format!("{path}/retry"), |request| request).await.expect(201).json();
    let path = format!("/v1/jobs/{}", retried["id"].as_str().expect("an id"));
    service.job_until(&path, searching).await;
    setup.answer("found");
    for worker in service.workers() {
        kill("-KILL", worker);
    }
    let job = service.succeeded(&path).await;
    assert_eq!((&job["attempt"], setup.searches()), (&json!(2), 4));
    assert_eq!(setup.lines("known").len(), 2, "the retry and its second attempt knew the features");
    // Nothing of the searches is left.
    let checkpoints = setup.path("data/checkpoints");
    let left: Vec<_> = fs::read_dir(&checkpoints).map(Iterator::collect).unwrap_or_default();
    let is_left =
        |job: &fs::DirEntry| ["poses-1", "poses-2"].iter().any(|name| job.path().join(name).exists());
    assert!(!left.iter().flatten().any(is_left), "{left:?}");
    assert_eq!(service.stop().await.code(), Some(0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_search_finds_cameras_anew_and_the_same_one_does_not() {
    let setup = Setup::new();
    let service = setup.service().await;
    let post = async |options: &str| {
        let query = format!("{SHORT}{options}");
        let job = service.upload(&query, setup.photographs.clone()).await.expect(201).json();
        let path = format!("/v1/jobs/{}", job["id"].as_str().expect("an id"));
        service.succeeded(&path).await;
        path
    };
    post("").await;
    let wide = post("&camera_model=opencv&matching=sequential").await;
    post("&camera_model=opencv&matching=sequential&seed=5").await;
    post("&matching=auto").await;
    assert_eq!(setup.lines("asked"), ["SIMPLE_RADIAL auto", "OPENCV sequential"]);

    let retry = async |body: Value| {
        let answer = service.send("POST", &format!("{wide}/retry"), |request| request.json(&body)).await;
        let job = answer.expect(201).json();
        service.succeeded(&format!("/v1/jobs/{}", job["id"].as_str().expect("an id"))).await
    };
    retry(json!({ "seed": 7 })).await;
    retry(json!({ "camera_model": "simple-radial", "matching": "auto" })).await;
    assert_eq!(setup.searches(), 2);
    let job = retry(json!({ "camera_model": "radial" })).await;
    assert_eq!(job["options"]["camera_model"], "radial");
    assert_eq!(setup.lines("asked")[2..], ["RADIAL sequential"]);
    assert_eq!(service.stop().await.code(), Some(0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_whose_workers_cannot_find_cameras_says_so_at_once() {
    let setup = Setup::new();
    let service = setup.service_with(Path::new("/no/python")).await;
    let refused = async {
        loop {
            // Before its worker is known, the service waits for one.
            let answer = service.upload(SHORT, setup.photographs.clone()).await;
            if answer.status != 201 {
                return answer;
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    let refused = crate::support::eventually::within("the worker is announced", refused).await;
    let detail = refused.expect_problem(503, "poses-unavailable");
    assert!(detail.contains("TCGS_POSES_PYTHON"), "{detail}");
    // A worker that is killed counts as alive for a while.
    assert_eq!(service.stop().await.code(), Some(0));

    let service = setup.service().await;
    let video = b"\0\0\0\x14ftypisom\0\0\0\0isom".to_vec();
    let refused = async {
        loop {
            let answer = service.send("POST", "/v1/jobs", |request| {
                request.header("content-type", "video/mp4").body(video.clone())
            });
            let answer = answer.await;
            if answer.status != 201 {
                return answer;
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    let refused = crate::support::eventually::within("the worker is announced", refused).await;
    assert_eq!(refused.expect(503).json()["type"], "urn:tcgs:problem:video-unavailable");
}
