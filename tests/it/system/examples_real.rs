//! The client in Python against the real program: a real dataset goes in, a scene that decodes and its view come out.

use std::{fs, process::Command};

use serde_json::Value;
use tcgs::{
    codec::{DecodeLimits, decode},
    sample::{self, Settings},
};

use crate::{
    documents::examples::{finishes, there_is},
    support::{server::picture, service::Service},
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_in_python_trains_a_scene_at_the_real_service() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    sample::write(&at("scene.zip"), &Settings { points: 100, ..Settings::square(24) }).expect("writes");
    let service = Service::start(&at("data")).await;
    let mut client = Command::new("python3");
    client.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/client.py")).arg(at("scene.zip"));
    client.args(["--server", &format!("http://{}", service.address()), "--frame", "images/view_06.png"]);
    client.args(["--option", "iterations=12", "--option", "seed=3"]);
    client.current_dir(folder.path()).env_remove("TCGS_API_KEY").env("PYTHONDONTWRITEBYTECODE", "1");
    let output = finishes(client).await;
    let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");

    let path = format!("/v1/jobs/{}", told["job"].as_str().expect("an id"));
    let job = service.get(&path).await.expect(200).json();
    assert_eq!((&job["state"], &job["metrics"]["steps"]), (&"succeeded".into(), &12.into()));
    assert_eq!(told["psnr"], job["metrics"]["test"]["psnr"]);
    let file = fs::read(at("scene.tcgs")).expect("a file");
    assert_eq!(told["bytes"], file.len());
    let decoded = decode(&file, &DecodeLimits::default()).expect("decodes");
    assert_eq!(job["metrics"]["decode_sha256"], decoded.decode_sha256.to_string());
    let view = picture(&fs::read(at("view.png")).expect("a file"));
    assert_eq!((view.width(), view.height()), (24, 24));
    let colors: std::collections::BTreeSet<&[u8]> = view.as_bytes().chunks(3).collect();
    assert!(colors.len() > 20, "{} colors are no picture of the scene", colors.len());
    assert!(service.stop().await.success());
}
