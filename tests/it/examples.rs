//! What the documents show is run here, so that it stays true: the session with curl, and the client in Python.

use std::{
    fs,
    path::Path,
    process::{Command, Output, Stdio},
};

use serde_json::Value;
use tcgs::{
    domain::{Scope, WebhookSecret},
    sample::{self, Settings},
    webhooks::sign,
};

use crate::support::{contract::Coverage, fakes, server::Server, skip::skip};

const KEY: &str = "TCGS_API_KEY";

/// Whether a program that an example is written for is there; in CI it has to be.
pub(crate) fn there_is(program: &str, arguments: &[&str]) -> bool {
    let status = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
    let found = status.is_ok_and(|status| status.success());
    if !found {
        skip(&format!("{program} {} does not work here", arguments.join(" ")));
    }
    found
}

pub(crate) async fn finishes(mut command: Command) -> Output {
    let output = tokio::task::spawn_blocking(move || command.output().expect("starts")).await.expect("ran");
    let said = |stream: &[u8]| String::from_utf8_lossy(stream).into_owned();
    assert!(output.status.success(), "{}\n{}", said(&output.stdout), said(&output.stderr));
    output
}

fn scene(folder: &Path) -> std::path::PathBuf {
    let path = folder.join("sample.zip");
    sample::write(&path, &Settings { side: 16, points: 50, seed: 1 }).expect("writes");
    path
}

/// The session with curl.
fn session() -> String {
    fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/API.md")).expect("readable")
}

/// The blocks of a document that are marked `language`.
fn blocks(document: &str, language: &str) -> String {
    let (begin, mut inside, mut text) = (format!("```{language}"), false, String::new());
    for line in document.lines() {
        match line {
            line if line == begin => inside = true,
            "```" => inside = false,
            _ if inside => text.extend([line, "\n"]),
            _ => {}
        }
    }
    text
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_session_with_curl_goes_as_it_is_written() {
    let needed = [("bash", "--version"), ("curl", "--version"), ("openssl", "version")];
    if !needed.iter().all(|(program, argument)| there_is(program, &[argument])) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::ScenesWrite, Scope::JobsWrite]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let script = folder.path().join("session.sh");
    fs::write(&script, format!("set -euo pipefail\n{}", blocks(&session(), "sh"))).expect("writes");
    let mut session = Command::new("bash");
    session.arg(&script).current_dir(folder.path()).stdin(Stdio::null());
    session.env("TCGS_SERVER", format!("http://{}", server.address)).env(KEY, &key.key);
    session.env("DATASET", scene(folder.path())).env("FRAME", "test/r_0");
    let output = finishes(session).await;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.contains("event: state") && said.contains("job-not-found"), "{said}");
    let file = |name: &str| fs::read(folder.path().join(name)).expect("a file");
    assert_eq!(file("scene.tcgs"), fakes::FILE);
    for (name, begin) in [
        ("frame.png", &b"\x89PNG"[..]),
        ("pose.webp", b"RIFF"),
        ("matrix.png", b"\x89PNG"),
        ("report.html", b"<!DOCTYPE html>"),
    ] {
        assert!(file(name).starts_with(begin), "{name}");
    }
}

#[tokio::test]
async fn the_check_of_a_message_tells_the_services_own_from_others() {
    if !there_is("python3", &["--version"]) {
        return;
    }
    let secret = WebhookSecret::stored("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw".into());
    let body = "{\"type\": \"job.succeeded\"}";
    let signature = sign(&secret, "msg_1", 1_614_265_330, body).expect("signed");
    let mut check = Command::new("python3");
    check.args(["-c", &format!("{}{CHECKS}", blocks(&session(), "python"))]);
    check.args([secret.expose(), &signature, body]);
    finishes(check).await;
}

/// Asks the function of the document about a message and about others that differ from it.
const CHECKS: &str = r#"
import sys

secret, signature, body = sys.argv[1:]

def asked(secret=secret, id="msg_1", time="1614265330", signature=signature, body=body):
    headers = {"webhook-id": id, "webhook-timestamp": time, "webhook-signature": signature}
    return is_from_the_service(secret, headers, body.encode())

assert asked() and asked(signature="v1,AAAA " + signature)
for other in [{"id": "msg_2"}, {"time": "1614265331"}, {"body": body + " "}, {"signature": "v1,AAAA"}, {"secret": "whsec_AAAA"}]:
    assert not asked(**other), other
"#;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_in_python_brings_a_scene_and_a_view() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::ScenesWrite, Scope::JobsWrite]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = scene(folder.path());
    let part = (fs::metadata(&dataset).expect("a file").len() / 3).to_string();
    // A download that broke off is gone on with.
    fs::write(folder.path().join("scene.tcgs.part"), &fakes::FILE[..7]).expect("writes");
    let mut client = Command::new("python3");
    client.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/client.py")).arg(&dataset);
    client.args(["--server", &format!("http://{}", server.address), "--frame", "test/r_0", "--part", &part]);
    client.args(["--option", "iterations=7", "--option", "preset=standard"]);
    client.current_dir(folder.path()).env(KEY, &key.key).env("PYTHONDONTWRITEBYTECODE", "1");
    let output = finishes(client).await;
    let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((&told["bytes"], &told["psnr"]), (&fakes::FILE.len().into(), &30.0.into()));
    assert!(!String::from_utf8_lossy(&output.stderr).contains(&key.key));
    let file = |name: &str| fs::read(folder.path().join(name)).expect("a file");
    assert_eq!(file("scene.tcgs"), fakes::FILE);
    assert!(file("view.png").starts_with(b"\x89PNG"));
    let path = format!("/v1/jobs/{}", told["job"].as_str().expect("an id"));
    let job = server.send("GET", &path, |request| request.bearer_auth(&key.key));
    let job = job.await.expect(200).json();
    assert_eq!((&job["options"]["iterations"], &job["options"]["preset"]), (&7.into(), &"standard".into()));

    let mut refused = Command::new("python3");
    refused.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/client.py")).arg(&dataset);
    refused.args(["--server", &format!("http://{}", server.address), "--frame", "x"]);
    refused.env_remove(KEY).current_dir(folder.path()).env("PYTHONDONTWRITEBYTECODE", "1");
    let output = tokio::task::spawn_blocking(move || refused.output().expect("starts")).await.expect("ran");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("401") && !said.contains("Traceback"), "{said}");
}
