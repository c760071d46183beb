//! The commands on the jobs of a service: listing, cancelling, repeating and deleting them, and no longer watching one.

use std::collections::HashMap;

use axum::{Json, Router, extract::Query, routing::get};
use serde_json::{Value, json};

use super::clients::{failed, line, run, succeeded, text};
use crate::support::{contract::Coverage, server::Server};

fn id(path: &str) -> &str {
    path.rsplit('/').next().expect("an id")
}

fn listed(output: &std::process::Output) -> Vec<String> {
    let jobs = succeeded(output)["jobs"].as_array().expect("jobs").clone();
    jobs.iter().map(|job| job["id"].as_str().expect("an id").to_owned()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_are_listed_cancelled_retried_and_deleted() {
    let server = Server::start(&Coverage::default()).await;
    let url = format!("http://{}", server.address);
    let tcgs = |arguments: &[&str]| {
        run(arguments.iter().chain(&["--server", &url]).map(std::ffi::OsString::from).collect())
    };
    assert_eq!(text(&tcgs(&["jobs"]).await.stdout), "There are no jobs.\n");

    let done = server.succeeded().await;
    let broken = server.create("fail").await;
    server.reaches(&broken, "failed").await;
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let queued = server.upload("?name=garden", "succeed").await.expect(201).header("location").to_owned();
    let [done, broken, running, queued] = [&done, &broken, &running, &queued].map(|path| id(path));

    assert_eq!(listed(&tcgs(&["jobs", "--json"]).await), [queued, running, broken, done]);
    assert_eq!(listed(&tcgs(&["jobs", "--state", "running,failed", "--json"]).await), [running, broken]);
    let newest = tcgs(&["jobs", "--limit", "1", "--json"]).await;
    assert_eq!((listed(&newest), succeeded(&newest)["more"].clone()), (vec![queued.to_owned()], json!(true)));
    let table = tcgs(&["jobs"]).await;
    let lines: Vec<&str> = text(&table.stdout).lines().collect();
    let cells = [
        ["queued", "position 1", "garden"],
        ["running", "train ", "/10"],
        ["failed", "worker-panicked", ""],
        ["succeeded", "30.00 dB, ", " bytes"],
    ];
    assert_eq!(lines.len(), 1 + cells.len(), "{lines:#?}");
    for (line, cells) in lines[1..].iter().zip(cells) {
        assert!(cells.iter().all(|cell| line.contains(cell)), "{line}: {cells:?}");
    }

    let cancelled = tcgs(&["cancel", queued]).await;
    succeeded(&cancelled);
    assert_eq!(text(&cancelled.stdout), format!("job {queued} is cancelled\n"));
    let answer = succeeded(&tcgs(&["cancel", running, "--json"]).await);
    assert_eq!((&answer["id"], &answer["cancel_requested"]), (&json!(running), &json!(true)));
    server.reaches(&format!("/v1/jobs/{running}"), "cancelled").await;
    succeeded(&tcgs(&["cancel", running]).await);
    let error = failed(&tcgs(&["cancel", done, "--json"]).await, 3);
    assert_eq!(error["type"], "urn:tcgs:problem:job-finished");

    let new =
        succeeded(&tcgs(&["retry", running, "--without-checkpoint", "--deadline", "600", "--json"]).await);
    assert_eq!(new["retry_of"], running);
    assert!(new["deadline_at"].is_string(), "{new:#}");
    let again = new["id"].as_str().expect("an id");
    let told = tcgs(&["retry", broken]).await;
    succeeded(&told);
    assert!(text(&told.stdout).contains(&format!("--server {url}")), "{}", text(&told.stdout));
    let error = failed(&tcgs(&["retry", done, "--json"]).await, 3);
    assert_eq!(error["type"], "urn:tcgs:problem:job-not-retryable");

    let error = failed(&tcgs(&["delete", again, "--json"]).await, 3);
    assert_eq!(error["type"], "urn:tcgs:problem:job-active");
    let deleted = tcgs(&["delete", &format!("{url}/v1/jobs/{done}"), "--json"]).await;
    assert_eq!(succeeded(&deleted), json!({ "id": done, "deleted": true }));
    for command in ["delete", "cancel", "retry"] {
        let error = failed(&tcgs(&[command, done, "--json"]).await, 3);
        assert_eq!(error["type"], "urn:tcgs:problem:job-not-found", "{command}");
    }
    succeeded(&tcgs(&["cancel", again]).await);
}

/// A page of 250 jobs.
async fn page(Query(query): Query<HashMap<String, String>>) -> Json<Value> {
    let number =
        |name: &str, default: usize| query.get(name).map_or(default, |text| text.parse().expect("a number"));
    let (from, limit) = (number("cursor", 0), number("limit", 20));
    assert!(limit <= 100, "the service answers no page of {limit}");
    let jobs: Vec<Value> = (from..(from + limit).min(250)).map(job).collect();
    let next = (from + limit < 250).then(|| format!("/v1/jobs?limit={limit}&cursor={}", from + limit));
    Json(json!({ "jobs": jobs, "next": next }))
}

fn job(number: usize) -> Value {
    json!({ "id": uuid::Uuid::from_u128(number as u128), "name": null, "state": "cancelled", "phase": "train",
        "progress": tcgs::domain::Progress::default(), "metrics": null, "error": null, "artifacts": [],
        "queue_position": null, "cancel_requested": true, "created_at": "2026-01-01T00:00:00Z" })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn more_jobs_are_listed_than_a_page_has() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    let app = Router::new().route("/v1/jobs", get(page));
    tokio::spawn(async move { axum::serve(listener, app).await });
    for (limit, count, more) in
        [(20, 20, true), (100, 100, true), (150, 150, true), (250, 250, false), (9000, 250, false)]
    {
        let output = run(line!["jobs", "--limit", limit.to_string(), "--server", url, "--json"]).await;
        let document = succeeded(&output);
        assert_eq!(document["jobs"].as_array().expect("jobs").len(), count, "{limit}");
        assert_eq!(document["more"], more, "{limit}");
        assert_eq!(document["jobs"][count - 1]["id"], job(count - 1)["id"]);
    }
    let told = run(line!["jobs", "--server", url]).await;
    assert!(text(&told.stdout).ends_with("There are more; see --limit and --state.\n"));
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_is_no_longer_watched_goes_on_and_the_command_says_how_to_cancel_it() {
    use std::process::Stdio;

    use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};

    use crate::support::{eventually::within, program, service::kill};

    let server = Server::start(&Coverage::default()).await;
    let url = format!("http://{}", server.address);
    let running = server.create("wait").await;
    server.reaches(&running, "running").await;
    let advice = format!("the job goes on; cancel it with 'tcgs cancel {} --server {url}'", id(&running));
    for (signal, status) in [("-INT", 130), ("-TERM", 143)] {
        let mut command = tokio::process::Command::from(program::command());
        command.args(["watch", id(&running), "--json", "--server", &url]);
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).kill_on_drop(true);
        let mut watching = command.spawn().expect("the binary runs");
        let mut told = BufReader::new(watching.stderr.take().expect("piped"));
        let mut line = String::new();
        within("it shows progress", told.read_line(&mut line)).await.expect("text");
        kill(signal, watching.id().expect("running"));
        let output = within("it has ended", watching.wait_with_output()).await.expect("ended");
        told.read_to_string(&mut line).await.expect("text");
        let problem = failed(&output, status);
        assert_eq!(problem["type"], "urn:tcgs:problem:stopped", "{line}");
        assert!(problem["detail"].as_str().expect("a detail").contains(&advice), "{problem:#}");
        assert!(line.contains(&advice), "{line}");
    }
    assert_eq!(server.get(&running).await.json()["state"], "running");
    server.post(&format!("{running}/cancel")).await;
}
