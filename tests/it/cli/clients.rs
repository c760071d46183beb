//! The commands that work at a service, run as scripts would run them, against a service on a real socket.

use std::{
    ffi::OsString,
    fs,
    path::Path,
    process::Output,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
};

use axum::{
    Router,
    extract::State,
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse as _, Response},
    routing::{get, options, patch, post},
};
use serde_json::{Value, json};
use tcgs::{
    domain::{Digest, JobId, Scope},
    ingest, sample,
};

use crate::support::{
    authority::Authority, contract::Coverage, fakes, program, receiver::Receiver, server::Server,
};

/// Runs a command beside the service.
pub(super) async fn run(arguments: Vec<OsString>) -> Output {
    run_with(arguments, Vec::new()).await
}

async fn run_with(arguments: Vec<OsString>, environment: Vec<(&'static str, String)>) -> Output {
    let command =
        move || program::command().args(arguments).envs(environment).output().expect("the binary runs");
    tokio::task::spawn_blocking(command).await.expect("ran")
}

/// Arguments of several types as one line.
macro_rules! line {
    ($($argument:expr),+ $(,)?) => { vec![$(std::ffi::OsString::from(&$argument)),+] };
}
pub(super) use line;

pub(super) fn text(stream: &[u8]) -> &str {
    std::str::from_utf8(stream).expect("UTF-8")
}

#[track_caller]
pub(super) fn succeeded(output: &Output) -> Value {
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap_or(Value::Null)
}

/// Asserts an exit status and gives the problem on standard output.
#[track_caller]
pub(super) fn failed(output: &Output, status: i32) -> Value {
    assert_eq!(output.status.code(), Some(status), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap_or(Value::Null)
}

fn dataset(folder: &Path, wish: &str) -> std::path::PathBuf {
    let path = folder.join("dataset.zip");
    fs::write(&path, wish).expect("writes");
    path
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_is_submitted_watched_fetched_and_viewed() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let zip = dataset(folder.path(), "succeed");
    let submitted = run(line![
        "submit",
        zip,
        "--server",
        url,
        "--unchecked",
        "--iterations",
        "7",
        "--seed",
        "3",
        "--json"
    ])
    .await;
    let job = succeeded(&submitted);
    assert_eq!((&job["options"]["iterations"], &job["options"]["seed"]), (&json!(7), &json!(3)));
    let id = job["id"].as_str().expect("an id").to_owned();

    let watched = succeeded(&run(line!["watch", id, "--server", url, "--json"]).await);
    assert_eq!((&watched["state"], &watched["id"]), (&json!("succeeded"), &json!(id)));
    let again = run(line!["watch", format!("{url}/v1/jobs/{id}"), "--server", url]).await;
    succeeded(&again);
    assert!(text(&again.stdout).contains("PSNR 30.00 dB"), "{}", text(&again.stdout));

    let file = folder.path().join("out/scene.tcgs");
    let fetched = succeeded(&run(line!["fetch", id, "--server", url, "-o", file, "--json"]).await);
    assert_eq!(fs::read(&file).expect("a file"), fakes::FILE);
    assert_eq!(fetched["sha256"], Digest::of(fakes::FILE).to_string());
    assert_eq!(
        fs::read_dir(folder.path().join("out")).expect("a folder").count(),
        1,
        "nothing is left beside it"
    );

    let pose = json!({ "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]],
        "fx": 30, "width": 32, "height": 24 });
    for (camera, size) in [
        (vec!["--frame".to_owned(), "test/r_0".to_owned(), "--width".to_owned(), "20".to_owned()], (20, 16)),
        (
            ["--position", "-4,0,1", "--look-at", "0,0,0", "--fov", "50", "--width", "30", "--height", "20"]
                .map(str::to_owned)
                .to_vec(),
            (30, 20),
        ),
        (vec!["--pose".to_owned(), pose.to_string()], (32, 24)),
    ] {
        for name in ["view.png", "view.jpg", "view.webp"] {
            let out = folder.path().join(name);
            let mut arguments = line!["view", id, "--server", url, "-o", out];
            arguments.extend(camera.iter().map(OsString::from));
            succeeded(&run(arguments).await);
            let picture = crate::support::server::picture(&fs::read(&out).expect("a file"));
            assert_eq!((picture.width(), picture.height()), size, "{camera:?} {name}");
        }
    }
}

/// Runs the command that `output` prints after a word, in a folder.
async fn run_printed(word: &str, output: &Output, folder: &Path) -> Output {
    let mut lines =
        text(&output.stdout).lines().filter_map(|line| line.strip_prefix(word)?.split_once("tcgs "));
    let (_, line) = lines.next().unwrap_or_else(|| panic!("no '{word}' in {}", text(&output.stdout)));
    let mut command = program::command();
    command.args(line.split_whitespace()).current_dir(folder);
    tokio::task::spawn_blocking(move || command.output().expect("the binary runs")).await.expect("ran")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_commands_that_are_printed_work_as_they_are() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let zip = dataset(folder.path(), "succeed");
    for (model, file) in [("tcgs", "scene.tcgs"), ("3dgs", "scene.ply"), ("scaffold", "scene.safetensors")] {
        let submitted = run(line!["submit", zip, "--server", url, "--unchecked", "--model", model]).await;
        succeeded(&submitted);
        let watched = run_printed("watch", &submitted, folder.path()).await;
        succeeded(&watched);
        succeeded(&run_printed("fetch", &watched, folder.path()).await);
        assert_eq!(fs::read(folder.path().join(file)).expect("a file"), fakes::FILE);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_folder_is_packed_on_the_way_and_waited_for() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let scene = folder.path().join("scene");
    sample::write(&scene, &sample::Settings { points: 50, ..sample::Settings::square(16) }).expect("writes");
    let url = format!("http://{}", server.address);
    let submit =
        || run(line!["submit", scene, "--server", url, "--wait", "--rd-curve", "0.001,0.004", "--json"]);
    let (job, other) = (succeeded(&submit().await), succeeded(&submit().await));
    assert_eq!(job["state"], "succeeded");
    assert_ne!(job["id"], other["id"]);
    assert_eq!(job["dataset"], other["dataset"], "the same folder is the same archive");
    // What was packed is the dataset that the folder is.
    let archive = folder.path().join("packed.zip");
    ingest::pack(&scene, &mut fs::File::create(&archive).expect("a file")).expect("packs");
    assert_eq!(job["dataset"]["sha256"], Digest::of(&fs::read(&archive).expect("a file")).to_string());
    let digest = |path: &Path| ingest::load(path).expect("a dataset").digest;
    assert_eq!(digest(&archive), digest(&scene));

    let id = job["id"].as_str().expect("an id");
    let file = folder.path().join("second.tcgs");
    succeeded(&run(line!["fetch", id, "--server", url, "-o", file, "--lambda", "0.004"]).await);
    assert_eq!(fs::read(&file).expect("a file"), fakes::curve_file(1));
    let error =
        failed(&run(line!["fetch", id, "--server", url, "-o", file, "--lambda", "7", "--json"]).await, 3);
    assert!(error["detail"].as_str().expect("a detail").contains("lambda 7"), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_is_checked_before_it_is_sent() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let scene = folder.path().join("scene");
    sample::write(&scene, &sample::Settings { points: 50, ..sample::Settings::square(16) }).expect("writes");
    fs::remove_file(scene.join("images/view_07.png")).expect("removes");
    let submit = line!["submit", scene, "--server", format!("http://{}", server.address), "--json"];
    let refused = failed(&run(submit.clone()).await, 3);
    assert!(refused.to_string().contains("view_07.png"), "{refused}");
    assert_eq!(server.get("/v1/jobs").await.json()["jobs"], json!([]), "nothing was sent");
    let sent = succeeded(&run([submit, line!["--unchecked"]].concat()).await);
    assert_eq!(sent["state"], "queued", "the check of this service's stand-in takes everything");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_download_that_broke_off_is_gone_on_with_and_a_wrong_one_is_not_kept() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let file = folder.path().join("scene.tcgs");
    let digest = Digest::of(fakes::FILE).to_string();
    let part = folder.path().join(format!("scene.tcgs.{}.part", &digest[..16]));
    let fetch = || run(line!["fetch", job, "--server", url, "-o", file, "--json"]);

    fs::write(&part, &fakes::FILE[..10]).expect("writes");
    assert_eq!(succeeded(&fetch().await)["resumed_at"], 10);
    assert_eq!(fs::read(&file).expect("a file"), fakes::FILE);

    fs::remove_file(&file).expect("removes");
    fs::write(&part, b"not these bytes").expect("writes");
    let error = failed(&fetch().await, 1);
    assert_eq!(error["type"], "urn:tcgs:problem:unexpected-answer", "{error}");
    assert!(!file.exists() && !part.exists(), "neither a wrong file nor its beginning stays");
    assert_eq!(succeeded(&fetch().await)["resumed_at"], 0);

    let longer = [fakes::FILE, b"more"].concat();
    fs::write(&part, longer).expect("writes");
    succeeded(&fetch().await);
    assert_eq!(fs::read(&file).expect("a file"), fakes::FILE);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_service_refuses_and_what_fails_there_is_the_commands_failure() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let submit = |wish: &str| {
        let zip = dataset(folder.path(), wish);
        run(line!["submit", zip, "--server", url, "--unchecked", "--wait", "--json"])
    };

    let refused = failed(&submit("bad zip").await, 3);
    assert_eq!(
        (&refused["type"], &refused["file"]),
        (&json!("urn:tcgs:problem:invalid-dataset"), &json!("transforms.json"))
    );
    let broke = failed(&submit("fail").await, 1);
    assert_eq!(broke["type"], "urn:tcgs:problem:worker-panicked");
    let missing = line!["submit", folder.path().join("missing"), "--server", url];
    assert!(text(&run(missing).await.stderr).contains("missing"));

    let absent = "0190a5d8-0000-7000-8000-000000000000";
    for command in
        [line!["watch", absent, "--json"], line!["fetch", absent, "-o", folder.path().join("f"), "--json"]]
    {
        let error = failed(&run([command, line!["--server", url]].concat()).await, 3);
        assert_eq!(error["type"], "urn:tcgs:problem:job-not-found");
    }
    let running = server.create("wait").await;
    let error = failed(
        &run(line!["fetch", running, "--server", url, "-o", folder.path().join("f"), "--json"]).await,
        3,
    );
    assert_eq!(error["type"], "urn:tcgs:problem:no-artifact");
    let watching = tokio::spawn(run(line!["watch", running, "--server", url, "--json"]));
    server.reaches(&running, "running").await;
    server.post(&format!("{running}/cancel")).await;
    let watched = watching.await.expect("ran");
    assert_eq!(failed(&watched, 1)["type"], "urn:tcgs:problem:job-cancelled");
    let retry = format!("tcgs retry {} --server {url}", running.rsplit('/').next().expect("an id"));
    assert!(text(&watched.stderr).contains(&retry), "{}", text(&watched.stderr));

    // Nobody listens on a port that was just given back.
    let free = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let nobody = format!("http://{}", free.local_addr().expect("bound"));
    drop(free);
    let error = failed(&run(line!["watch", absent, "--server", nobody, "--json"]).await, 4);
    assert_eq!(error["type"], "urn:tcgs:problem:unreachable");
}

/// A service that ends its streams of events early, and keeps what it was asked with.
#[derive(Clone)]
struct Moody {
    asked: Arc<Mutex<Vec<(String, HeaderMap)>>>,
    streams: bool,
    /// How many requests for the job, after the first, are answered 503.
    away: usize,
    job: JobId,
}

impl Moody {
    async fn start(streams: bool) -> (Self, String) {
        Self::start_away(streams, 0).await
    }

    async fn start_away(streams: bool, away: usize) -> (Self, String) {
        let job = JobId("01a20055-454e-788e-bcc5-854572fb30d3".parse().expect("a UUID"));
        let this = Self { asked: Arc::default(), streams, away, job };
        let app = Router::new()
            .route("/v1/jobs/{id}", get(Self::job))
            .route("/v1/jobs/{id}/events", get(Self::events))
            .with_state(this.clone());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("bound"));
        tokio::spawn(async move { axum::serve(listener, app).await });
        (this, url)
    }

    fn count(&self, what: &str) -> usize {
        self.asked.lock().expect("not poisoned").iter().filter(|(asked, _)| asked == what).count()
    }

    /// Runs until its events were all told, or until it was asked for a third time.
    async fn job(State(this): State<Self>, headers: HeaderMap) -> Response {
        this.asked.lock().expect("not poisoned").push(("job".to_owned(), headers));
        if (2..2 + this.away).contains(&this.count("job")) {
            return (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "0")]).into_response();
        }
        let ended = if this.streams { this.count("events") >= 3 } else { this.count("job") >= 3 };
        let state = if ended { "succeeded" } else { "running" };
        let progress = serde_json::to_value(tcgs::domain::Progress::default()).expect("JSON");
        let body = json!({ "id": this.job, "state": state, "phase": "train", "progress": progress,
            "metrics": ended.then(fakes::metrics), "error": null, "artifacts": [] });
        ([(header::CONTENT_TYPE, "application/json")], body.to_string()).into_response()
    }

    /// Two events a connection; the last of five ends the job.
    async fn events(State(this): State<Self>, headers: HeaderMap) -> Response {
        let last = headers.get("last-event-id").and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
        this.asked.lock().expect("not poisoned").push(("events".to_owned(), headers));
        if !this.streams {
            return StatusCode::NOT_ACCEPTABLE.into_response();
        }
        let first = last.unwrap_or(0) + 1;
        let event = |seq: u64| {
            let (kind, data) = match seq {
                5 => ("state", json!({ "state": "succeeded" })),
                2 => ("phase", json!({ "phase": "train" })),
                _ => {
                    ("progress", json!(tcgs::domain::Progress { step: seq, total: 5, ..Default::default() }))
                }
            };
            let data =
                json!({ "seq": seq, "at": "2026-01-01T00:00:00Z", "kind": kind, "attempt": 1, "data": data });
            format!("id: {seq}\nevent: {kind}\ndata: {data}\n\n")
        };
        let body: String = (first..=5).take(2).map(event).collect();
        ([(header::CONTENT_TYPE, "text/event-stream")], format!(": hello\n\n{body}id: 99\ndata: {{\"cut"))
            .into_response()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_breaks_off_is_gone_on_with_where_it_was() {
    let (service, url) = Moody::start(true).await;
    let watched = run(line!["watch", service.job.to_string(), "--server", url, "--json"]).await;
    assert_eq!(succeeded(&watched)["state"], "succeeded");
    let asked = service.asked.lock().expect("not poisoned").clone();
    let last: Vec<&str> = asked
        .iter()
        .filter(|(what, _)| what == "events")
        .map(|(_, headers)| headers["last-event-id"].to_str().expect("ASCII"))
        .collect();
    assert_eq!(last, ["0", "2", "4"], "each stream begins after the last whole event of the one before");
    assert!(
        text(&watched.stderr).contains("train 4/5") || text(&watched.stderr).contains("train 1/5"),
        "{}",
        text(&watched.stderr)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_watched_on_after_the_service_was_away() {
    let (service, url) = Moody::start_away(false, 12).await;
    let watched = run(line!["watch", service.job.to_string(), "--server", url, "--json"]).await;
    assert_eq!(succeeded(&watched)["state"], "succeeded");
    assert!(service.count("job") > 12);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_not_let_in_is_told_where_the_command_takes_its_key_from() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let job = job.rsplit('/').next().expect("an id");
    server.key(&[Scope::Read]).await;
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("key.txt");
    fs::write(&file, "tcgs_nobodys").expect("writes");
    let set = |name| vec![(name, "tcgs_nobodys".to_owned())];
    for (flags, environment, source) in [
        (Vec::new(), Vec::new(), "the variable TCGS_API_KEY"),
        (line!["--key-env", "MY_KEY"], set("MY_KEY"), "the variable MY_KEY"),
        (line!["--key-file", file], set("TCGS_API_KEY"), "key.txt"),
    ] {
        let watch = line!["watch", job, "--server", format!("http://{}", server.address)];
        let output = run_with([watch, flags].concat(), environment).await;
        failed(&output, 3);
        assert!(text(&output.stderr).contains(source), "{}", text(&output.stderr));
        if source != "the variable TCGS_API_KEY" {
            assert!(!text(&output.stderr).contains("TCGS_API_KEY"), "{}", text(&output.stderr));
        }
    }
}

#[tokio::test]
async fn a_variable_that_is_named_for_the_key_has_to_hold_one() {
    let job = JobId(uuid::Uuid::nil()).to_string();
    for (environment, error) in [
        (Vec::new(), "the variable MY_KEY is not set"),
        (vec![("MY_KEY", "  ".to_owned())], "the variable MY_KEY is empty"),
    ] {
        let usual = ("TCGS_API_KEY", "tcgs_from_environment".to_owned());
        let watch = line!["watch", job, "--key-env", "MY_KEY", "--json"];
        let output = run_with(watch, [environment, vec![usual]].concat()).await;
        assert_eq!(failed(&output, 2)["type"], "urn:tcgs:problem:usage");
        assert!(text(&output.stderr).contains(error), "{}", text(&output.stderr));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_cannot_show_who_it_is_gets_no_word() {
    let theirs = Authority::new("theirs");
    let mut stranger = Receiver::start_tls(theirs.acceptor("localhost")).await;
    let job = JobId(uuid::Uuid::nil()).to_string();
    let watch = line!["watch", job, "--server", stranger.https_url("localhost")];
    let output = run(watch.clone()).await;
    failed(&output, 4);
    let told = text(&output.stderr);
    assert!(told.contains("is signed by no authority that is trusted here"), "{told}");
    assert!(stranger.is_quiet());

    if cfg!(target_os = "linux") {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("ca.pem");
        fs::write(&file, theirs.pem()).expect("written");
        let trusted = ("SSL_CERT_FILE", file.to_str().expect("UTF-8").to_owned());
        run_with(watch, vec![trusted]).await;
        assert!(
            stranger.next().await.path.ends_with(&job),
            "who is among the system's authorities is trusted"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_without_streams_is_asked_and_the_key_is_sent_and_never_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("key");
    fs::write(&file, "tcgs_from_file\n").expect("writes");
    let other = ("MY_KEY", "tcgs_from_elsewhere".to_owned());
    let usual = ("TCGS_API_KEY", "tcgs_from_environment".to_owned());
    for (flags, environment, key) in [
        (Vec::new(), vec![usual.clone(), other.clone()], Some("tcgs_from_environment")),
        (line!["--key-env", "MY_KEY"], vec![usual.clone(), other], Some("tcgs_from_elsewhere")),
        (line!["--key-file", file], vec![usual], Some("tcgs_from_file")),
        (Vec::new(), Vec::new(), None),
    ] {
        let (service, url) = Moody::start(false).await;
        let watch = line!["watch", service.job.to_string(), "--server", url, "--json"];
        let output =
            run_with([watch, flags].concat(), [environment, vec![("RUST_LOG", "trace".to_owned())]].concat())
                .await;
        assert_eq!(succeeded(&output)["state"], "succeeded");
        let asked = service.asked.lock().expect("not poisoned").clone();
        assert!(asked.len() >= 4, "the stream once and the job until it has ended");
        for (what, headers) in asked {
            let sent =
                headers.get(header::AUTHORIZATION).map(|value| value.to_str().expect("ASCII").to_owned());
            assert_eq!(sent, key.map(|key| format!("Bearer {key}")), "{what}");
        }
        assert!(!text(&output.stderr).contains("tcgs_from") && !text(&output.stdout).contains("tcgs_from"));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_large_dataset_goes_in_parts_and_becomes_a_job_of_a_scene() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let zip = folder.path().join("scene.zip");
    sample::write(&zip, &sample::Settings { points: 50, ..sample::Settings::square(16) }).expect("writes");
    let bytes = fs::metadata(&zip).expect("a file").len();
    for part in [bytes / 4, bytes - 1] {
        let line =
            line!["submit", zip, "--server", url, "--part-bytes", part.to_string(), "--wait", "--json"];
        let named = line!["--name", " a garden ", "--metadata", "site=north", "--metadata", "note=a=b&c, d"];
        let chosen = line!["--without", "knn,masks", "--priority", "-3"];
        let job = succeeded(&run([line, named, chosen].concat()).await);
        assert_eq!(job["name"], "a garden");
        assert_eq!(job["metadata"], json!({ "site": "north", "note": "a=b&c, d" }));
        assert!(job["scene_id"].is_string(), "what came in parts is a scene: {job:#}");
        assert_eq!(job["dataset"]["sha256"], Digest::of(&fs::read(&zip).expect("a file")).to_string());
        assert_eq!(job["options"]["without"], json!(["knn", "masks"]));
        assert_eq!(job["priority"], -3);
    }
    let uploads = async || {
        let metrics = server.get("/metrics").await.expect(200);
        let text = String::from_utf8_lossy(&metrics.body).into_owned();
        let of_uploads = |line: &&str| line.contains("_count{") && line.contains("route=\"/v1/uploads\"");
        text.lines().filter(of_uploads).map(str::to_owned).collect::<Vec<_>>()
    };
    let before = uploads().await;
    assert!(!before.is_empty());
    let line = line!["submit", zip, "--server", url, "--part-bytes", bytes.to_string(), "--json"];
    let named = line!["--name", "a garden", "--metadata", "site=north", "--metadata", "note=a=b&c, d"];
    let whole = succeeded(&run([line, named].concat()).await);
    assert_eq!(uploads().await, before, "one part is one request");
    assert!(whole["dataset_id"].is_string(), "{whole:#}");
    assert_eq!(whole["name"], "a garden");
    assert_eq!(whole["metadata"], json!({ "site": "north", "note": "a=b&c, d" }));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_large_dataset_is_checked_as_its_job_reads_it() {
    let server = Server::start(&Coverage::default()).await;
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("http://{}", server.address);
    let zip = dataset(folder.path(), "succeed with astray masks");
    let submit = line!["submit", zip, "--server", url, "--unchecked", "--part-bytes", "8", "--json"];
    let refused = failed(&run(submit.clone()).await, 3);
    assert_eq!(refused["type"], "urn:tcgs:problem:dataset-rejected");
    let job = succeeded(&run([submit, line!["--masks", "none"]].concat()).await);
    assert_eq!(job["options"]["masks"], "none");
}

/// A service that refuses the first requests to begin an upload and to make a scene.
#[derive(Clone, Default)]
struct Crowded {
    begun: Arc<AtomicUsize>,
    scenes: Arc<AtomicUsize>,
}

impl Crowded {
    async fn begin(State(this): State<Self>) -> Response {
        match this.begun.fetch_add(1, Ordering::SeqCst) {
            0 => (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "0")]).into_response(),
            _ => (StatusCode::CREATED, [(header::LOCATION, "/v1/uploads/one")]).into_response(),
        }
    }

    async fn part(headers: HeaderMap, body: bytes::Bytes) -> Response {
        let offset: usize = headers["upload-offset"].to_str().expect("ASCII").parse().expect("a number");
        (StatusCode::NO_CONTENT, [("upload-offset", (offset + body.len()).to_string())]).into_response()
    }

    async fn scene(State(this): State<Self>) -> Response {
        let under_way = |kind: &str| {
            let problem = json!({ "type": format!("urn:tcgs:problem:{kind}"), "title": kind, "status": 409,
                "detail": "an earlier request is still being answered" });
            (StatusCode::CONFLICT, problem.to_string()).into_response()
        };
        match this.scenes.fetch_add(1, Ordering::SeqCst) {
            0 => under_way("upload-locked"),
            1 => under_way("idempotency-in-flight"),
            _ => (StatusCode::CREATED, json!({ "id": "a scene" }).to_string()).into_response(),
        }
    }

    async fn job() -> Response {
        let progress = serde_json::to_value(tcgs::domain::Progress::default()).expect("JSON");
        let body = json!({ "id": "01a20055-454e-788e-bcc5-854572fb30d3", "state": "queued", "phase": "queued",
            "progress": progress, "metrics": null, "error": null, "artifacts": [] });
        (StatusCode::CREATED, body.to_string()).into_response()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_is_submitted_to_a_service_that_is_busy_or_still_checks_it() {
    let service = Crowded::default();
    let versions = async || (StatusCode::NO_CONTENT, [("tus-version", "1.0.0")]);
    let app = Router::new()
        .route("/v1/uploads", options(versions).post(Crowded::begin))
        .route("/v1/uploads/one", patch(Crowded::part))
        .route("/v1/scenes", post(Crowded::scene))
        .route("/v1/jobs", post(Crowded::job))
        .with_state(service.clone());
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    tokio::spawn(async move { axum::serve(listener, app).await });
    let folder = tempfile::tempdir().expect("a folder");
    let zip = folder.path().join("scene.zip");
    sample::write(&zip, &sample::Settings { points: 50, ..sample::Settings::square(16) }).expect("writes");
    let part = (fs::metadata(&zip).expect("a file").len() / 2).to_string();
    let submitted = run(line!["submit", zip, "--server", url, "--part-bytes", part, "--json"]).await;
    assert_eq!(succeeded(&submitted)["state"], "queued");
    let asked = [service.begun, service.scenes].map(|count| count.load(Ordering::SeqCst));
    assert_eq!(asked, [2, 3]);
}
