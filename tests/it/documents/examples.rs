//! What the documents show is run here, so that it stays true: the session with curl, and the client in Python.

use std::{
    fs,
    path::Path,
    process::{Command, Output, Stdio},
};

use serde_json::Value;
use tcgs::{
    domain::{Digest, Scope, WebhookSecret},
    sample::{self, Settings},
    webhooks::sign,
};

use crate::support::{
    contract::Coverage,
    cutter::{Cutter, Fault, Rule},
    fakes,
    server::{Server, TestKey},
    skip::skip,
    tree::text,
};

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
    sample::write(&path, &Settings { points: 50, ..Settings::square(16) }).expect("writes");
    path
}

/// Runs an example of the folder `examples`, which cargo builds beside the program unless it is told to build this test alone.
fn example(name: &str, arguments: &[&Path]) -> bool {
    let program = Path::new(env!("CARGO_BIN_EXE_tcgs")).with_file_name("examples").join(name);
    if !program.exists() {
        skip(&format!("the example {name} is not built: cargo test --examples"));
        return false;
    }
    let output = Command::new(program).args(arguments).output().expect("starts");
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    true
}

#[test]
fn the_examples_in_rust_train_a_scene_and_render_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let [file, picture] = ["scene.tcgs", "view.png"].map(|name| folder.path().join(name));
    if !example("train", &[&scene(folder.path()), &file, Path::new("3")]) {
        return;
    }
    let bytes = fs::read(&file).expect("a file");
    let decoded = tcgs::codec::decode(&bytes, &tcgs::codec::DecodeLimits::default()).expect("decodes");
    assert!(decoded.scene.len() > 10, "{} anchors", decoded.scene.len());
    example("render", &[&file, Path::new("2.6,-2.2,2.4"), Path::new("0.12,0.1,0.32"), &picture]);
    let picture = fs::read(picture).expect("a picture");
    // Width and height of a PNG follow its signature and the name of its first chunk.
    assert_eq!(picture[16..24], [0, 0, 3, 32, 0, 0, 2, 88], "800 x 600");
    for name in ["train", "render"] {
        assert!(text(&format!("examples/{name}.rs")).lines().count() <= 40, "{name}");
    }
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
    let key = server.key(&[Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let script = folder.path().join("session.sh");
    fs::write(&script, format!("set -euo pipefail\n{}", blocks(&session(), "sh"))).expect("writes");
    let mut session = Command::new("bash");
    session.arg(&script).current_dir(folder.path()).stdin(Stdio::null());
    session.env("TCGS_SERVER", format!("http://{}", server.address)).env(KEY, &key.key);
    let dataset = scene(folder.path());
    let part = fs::metadata(&dataset).expect("a file").len() / 3;
    session.env("DATASET", dataset).env("FRAME", "test/r_0").env("PART", part.to_string());
    let output = finishes(session).await;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.contains("event: state") && said.contains("job-not-found"), "{said}");
    let file = |name: &str| fs::read(folder.path().join(name)).expect("a file");
    assert_eq!(file("scene.tcgs"), fakes::FILE);
    let jobs =
        server.send("GET", "/v1/jobs", |request| request.bearer_auth(&key.key)).await.expect(200).json();
    let jobs = jobs["jobs"].as_array().expect("jobs").len();
    assert_eq!(jobs, 2, "of three jobs one was deleted");
    for (name, begin) in [
        ("frame.png", &b"\x89PNG"[..]),
        ("pose.webp", b"RIFF"),
        ("matrix.png", b"\x89PNG"),
        ("report.html", b"<!DOCTYPE html>"),
    ] {
        assert!(file(name).starts_with(begin), "{name}");
    }
}

/// The commands for any HTTP client in README.
fn readme_session() -> String {
    let readme = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).expect("readable");
    let (_, rest) = readme.split_once("Any HTTP client will do:").expect("the introduction");
    let (_, block) = rest.split_once("```sh\n").expect("a block");
    block.split_once("```").expect("its end").0.to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_session_of_the_readme_waits_and_writes_no_problem_into_a_file() {
    if ![("bash", "--version"), ("curl", "--version")]
        .iter()
        .all(|(program, argument)| there_is(program, &[argument]))
    {
        return;
    }
    let session = readme_session();
    let run = async |server: &Server, session: &str| {
        let folder = tempfile::tempdir().expect("a folder");
        fs::rename(scene(folder.path()), folder.path().join("scene.zip")).expect("moved");
        let session = session
            .replace("http://127.0.0.1:8080", &format!("http://{}", server.address))
            .replace("images/view_06.png", "test/r_0");
        let mut command = Command::new("bash");
        command.args(["-uc", &session]).current_dir(folder.path()).stdin(Stdio::null());
        let output =
            tokio::task::spawn_blocking(move || command.output().expect("starts")).await.expect("ran");
        (folder, output)
    };
    let server = Server::start(&Coverage::default()).await;
    let (folder, output) = run(&server, &session).await;
    assert!(output.status.success(), "{output:?}");
    let file = |name: &str| fs::read(folder.path().join(name)).expect(name);
    assert_eq!(file("scene.tcgs"), fakes::FILE);
    for name in ["frame.png", "pose.png"] {
        assert!(file(name).starts_with(b"\x89PNG"), "{name}");
    }
    // What is refused writes nothing.
    let broken =
        session.replace("/artifact\"", "/artifact?nothing=1\"").replace("/view?", "/view?nothing=1&");
    let (folder, output) = run(&server, &broken).await;
    assert!(!output.status.success(), "{output:?}");
    for name in ["scene.tcgs", "frame.png", "pose.png"] {
        assert!(!folder.path().join(name).exists(), "{name}");
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

/// A program of `examples/`, to be run in a folder.
fn python_client(name: &str, folder: &Path) -> Command {
    let mut program = Command::new("python3");
    program.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(name));
    program.current_dir(folder).env("PYTHONDONTWRITEBYTECODE", "1");
    program
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_in_python_brings_a_scene_and_a_view() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = scene(folder.path());
    let part = (fs::metadata(&dataset).expect("a file").len() / 3).to_string();
    // A download that broke off is gone on with.
    let part_of_file = format!("scene.tcgs.{}.part", &Digest::of(fakes::FILE).to_string()[..16]);
    fs::write(folder.path().join(part_of_file), &fakes::FILE[..7]).expect("writes");
    let mut client = python_client("client.py", folder.path());
    client.arg(&dataset).env(KEY, &key.key);
    client.args(["--server", &format!("http://{}", server.address), "--frame", "test/r_0", "--part", &part]);
    client.args(["--option", "iterations=7", "--option", "preset=standard"]);
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

    // Options that the check of the dataset needs come before the job.
    fs::write(folder.path().join("astray.zip"), "succeed with astray masks").expect("writes");
    let mut unmasked = python_client("client.py", folder.path());
    unmasked.arg("astray.zip").env(KEY, &key.key);
    unmasked.args(["--server", &format!("http://{}", server.address), "--frame", "test/r_0"]);
    unmasked.args(["--option", "masks=none"]);
    finishes(unmasked).await;

    let mut refused = python_client("client.py", folder.path());
    refused.arg(&dataset).args(["--server", &format!("http://{}", server.address), "--frame", "x"]);
    refused.env_remove(KEY);
    let output = tokio::task::spawn_blocking(move || refused.output().expect("starts")).await.expect("ran");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("401") && !said.contains("Traceback"), "{said}");

    let mut lost = python_client("client.py", folder.path());
    lost.args(["nope.zip", "--frame", "x"]);
    let output = lost.output().expect("starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("nope.zip") && !said.contains("Traceback"), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_short_client_in_python_brings_a_scene() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = scene(folder.path());
    let mut client = python_client("submit.py", folder.path());
    client.arg(&dataset).arg("scene.tcgs").env(KEY, &key.key);
    client.env("TCGS_SERVER", format!("http://{}", server.address));
    let output = finishes(client).await;
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(told, format!("scene.tcgs: {} bytes, 30.00 dB\n", fakes::FILE.len()));
    assert_eq!(fs::read(folder.path().join("scene.tcgs")).expect("a file"), fakes::FILE);
}

/// Targets of requests in the order in which rules look at them: what a name is part of stands behind it.
const TARGETS: [&str; 9] = [
    "POST /v1/uploads",
    "PATCH /v1/uploads",
    "HEAD /v1/uploads",
    "POST /v1/datasets",
    "POST /v1/jobs",
    "/events",
    "/artifact",
    "/view",
    "GET /v1/jobs/",
];

/// Runs the client through a proxy to its end and returns what it says on standard error, and how many rules met no request.
async fn runs_through(server: &Server, key: &TestKey, rules: Vec<Rule>) -> (String, usize) {
    let cutter = Cutter::start(server.address, rules).await;
    let folder = tempfile::tempdir().expect("a folder");
    let dataset = scene(folder.path());
    let part = (fs::metadata(&dataset).expect("a file").len() / 3).to_string();
    let mut client = python_client("client.py", folder.path());
    client.arg(&dataset).env(KEY, &key.key);
    client.args(["--server", &format!("http://{}", cutter.address), "--frame", "test/r_0", "--part", &part]);
    client.args(["--option", "iterations=7", "--pause", "0.001"]);
    let output = finishes(client).await;
    assert_eq!(fs::read(folder.path().join("scene.tcgs")).expect("a file"), fakes::FILE);
    assert!(fs::read(folder.path().join("view.png")).expect("a file").starts_with(b"\x89PNG"));
    (String::from_utf8(output.stderr).expect("UTF-8"), cutter.left())
}

async fn count(server: &Server, key: &TestKey, list: &str) -> usize {
    let path = format!("/v1/{list}");
    let answer = server.send("GET", &path, |request| request.bearer_auth(&key.key)).await.expect(200).json();
    answer[list].as_array().expect("a list").len()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_in_python_survives_connections_that_break_at_any_byte() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite]).await;
    // Within the status, within headers, at their end, within bodies.
    let cuts = [[1, 12, 17], [40, 80, 130], [190, 260, 330], [390, 450, 520], [580, 700, 1000]];
    for (round, cuts) in cuts.into_iter().enumerate() {
        let mut rules = Vec::new();
        for bytes in cuts {
            rules.extend(TARGETS.map(|target| Rule { target, error: Fault::Answer(bytes) }));
            // Within the request's head and its body.
            rules.push(Rule { target: "PATCH /v1/uploads", error: Fault::Request(bytes * 8) });
            rules.push(Rule { target: "POST /v1/jobs", error: Fault::Request(bytes) });
        }
        let (_, left) = runs_through(&server, &key, rules).await;
        // The shortest answers end before the later cuts, and are then not asked for again.
        assert!(left == 0 || cuts.iter().any(|bytes| *bytes > 130), "{left} rules met no request");
        assert_eq!(count(&server, &key, "jobs").await, round + 1, "a repeated request makes nothing again");
        assert_eq!(count(&server, &key, "scenes").await, 1);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_in_python_comes_again_when_it_is_asked_to() {
    if !there_is("python3", &["-c", "import requests"]) {
        return;
    }
    let server = Server::start(&Coverage::default()).await;
    let key = server.key(&[Scope::Read, Scope::DatasetsWrite, Scope::JobsWrite]).await;
    let many =
        "HTTP/1.1 429 Too Many Requests\r\nRetry-After: 0\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    let busy = "HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    let mut rules: Vec<Rule> =
        TARGETS.map(|target| Rule { target, error: Fault::Says(many) }).into_iter().collect();
    rules.push(Rule { target: "POST /v1/jobs", error: Fault::Says(busy) });
    rules.push(Rule { target: "/artifact", error: Fault::Says(busy) });
    let (said, left) = runs_through(&server, &key, rules).await;
    assert_eq!(left, 0, "rules met no request");
    let asked = |seconds: &str| said.matches(&format!("the service asks to wait {seconds} s")).count();
    assert_eq!((asked("0"), asked("1")), (TARGETS.len(), 2), "{said}");
    assert_eq!(count(&server, &key, "jobs").await, 1);
}
