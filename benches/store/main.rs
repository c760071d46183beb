//! What a long history costs: `cargo bench --bench store`.
//!
//! One project has 100 000 finished jobs with two files each (an argument chooses another number), another project has one. Timed are the
//! transactions behind `POST /v1/jobs` of either project, a list of either one's jobs, usage, a claim with its end, and what each scrape of
//! `/metrics` asks. None should take longer the more jobs there are. Then it counts claims, which an address counts on that empty database
//! of PostgreSQL instead: `cargo bench --bench store -- postgres://USER@HOST/DATABASE`.
//!
//! `cargo bench --bench store -- simulation` runs the queue under a simulated clock instead, with 100 000 jobs and 1000 workers; two numbers
//! after it choose others.

#![allow(clippy::unwrap_used, reason = "a benchmark stops at the first fault")]

mod claims;
mod history;
mod simulation;

use std::{
    future::Future,
    sync::Arc,
    time::{Duration, Instant},
};

use tcgs::{
    domain::{Digest, JobId, ProjectId, ProjectLimits, SystemClock, TrainOptions},
    store::{BlobRef, DatabaseLocation, JobFilter, NewJob, Outcome, QueuePolicy, Store},
};
use uuid::Uuid;

const JOBS: usize = 100_000;
const RUNS: usize = 9;

/// The times of some runs, sorted.
async fn times<F: Future>(mut run: impl FnMut() -> F) -> Vec<Duration> {
    let mut times = Vec::with_capacity(RUNS);
    for _ in 0..RUNS {
        let start = Instant::now();
        run().await;
        times.push(start.elapsed());
    }
    times.sort();
    times
}

fn line(what: &str, times: &[Duration]) {
    let milliseconds = |time: Duration| time.as_secs_f64() * 1e3;
    println!(
        "{what:40} {:>12.3} {:>12.3}",
        milliseconds(times[times.len() / 2]),
        milliseconds(times[times.len() - 1])
    );
}

async fn add_job(store: &Store, project: ProjectId) {
    let dataset = BlobRef { digest: Digest::of(b"a dataset"), bytes: 9 };
    let id = JobId(Uuid::now_v7());
    let new = NewJob { project, ..NewJob::new(id, TrainOptions::default(), dataset) };
    store.create_job(new).await.unwrap();
}

async fn run_one(store: &Store) {
    let claim = store.claim("a worker").await.unwrap().unwrap();
    store.finish(&claim.lease, Outcome::Cancelled).await.unwrap();
}

async fn list(store: &Store, project: ProjectId) {
    let filter = JobFilter { project: Some(project), ..JobFilter::default() };
    assert!(!store.jobs(&filter, None, 20).await.unwrap().is_empty());
}

/// Simulates as many jobs and workers as the arguments say.
async fn simulate(arguments: &[String]) {
    let number = |place: usize| arguments.get(place).and_then(|argument| argument.parse().ok());
    let size =
        simulation::Size { jobs: number(0).unwrap_or(JOBS), workers: number(1).unwrap_or(1000), seed: 1 };
    let folder = tempfile::tempdir().unwrap();
    let clock = simulation::clock();
    let path = folder.path().join("tcgs.sqlite");
    let store = Store::open(&path, clock.clone(), simulation::policy()).await.unwrap();
    let report = simulation::run(&store, &clock, size, &|| Outcome::Cancelled).await;
    store.close().await;
    print!("{report}");
}

#[tokio::main]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(place) = arguments.iter().position(|argument| argument == "simulation") {
        return simulate(&arguments[place + 1..]).await;
    }
    if let Some(url) = std::env::args().skip(1).find_map(|argument| argument.parse().ok()) {
        let location = DatabaseLocation::Postgres(url);
        let store = Store::open(location, Arc::new(SystemClock), QueuePolicy::default()).await.unwrap();
        return claims::measure(Arc::new(store), ProjectId::DEFAULT).await;
    }
    let jobs = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(JOBS);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tcgs.sqlite");
    // Both are bounded, so that both bounds are looked at.
    let limits = ProjectLimits {
        quota_bytes: Some(1 << 50),
        max_active_jobs: Some(1 << 20),
        max_running_jobs: None,
        max_priority: None,
    };
    let policy = QueuePolicy { limits, ..QueuePolicy::default() };
    let store = Store::open(&path, Arc::new(SystemClock), policy).await.unwrap();
    let [busy, quiet] = [1, 2].map(|number| ProjectId(Uuid::from_u128(number)));
    history::write(&path, busy, quiet, jobs).await;
    add_job(&store, quiet).await;

    println!("{jobs} finished jobs of one project, {RUNS} runs\n");
    println!("{:40} {:>12} {:>12}", "", "median ms", "longest ms");
    line("POST /v1/jobs, the project with the history", &times(|| add_job(&store, busy)).await);
    line("POST /v1/jobs, another project", &times(|| add_job(&store, quiet)).await);
    line("GET /v1/jobs, the project with the history", &times(|| list(&store, busy)).await);
    line("GET /v1/jobs, another project", &times(|| list(&store, quiet)).await);
    line("claim and end of an attempt", &times(|| run_one(&store)).await);
    line("GET /v1/usage", &times(|| async { store.project_usage(None, None, 20).await.unwrap() }).await);
    line("GET /metrics", &times(|| async { store.stats().await.unwrap() }).await);
    let store = Arc::new(store);
    claims::measure(store.clone(), quiet).await;
    store.close().await;
}
