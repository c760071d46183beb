//! A service and two workers as processes of their own on one PostgreSQL database, which goes away and comes back.

#![cfg(unix)]

use std::{path::Path, process::Stdio};

use tokio::process::Child;

use crate::support::{
    dataset,
    eventually::eventually,
    postgres::{Cluster, PASSWORD, PostgresDatabase},
    program,
    service::Service,
};

const JOBS: usize = 4;

fn worker(data: &Path, database: &PostgresDatabase) -> Child {
    let mut command = tokio::process::Command::from(program::command());
    command.args(["worker", "--data"]).arg(data).env("TCGS_DATABASE", database.url().expose());
    command.stdin(Stdio::null()).stderr(Stdio::null()).kill_on_drop(true).spawn().expect("the binary runs")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_workers_finish_every_job_once_although_the_database_is_gone_for_a_while() {
    let Some(cluster) = Cluster::own() else { return };
    let database = cluster.empty_database().await;
    let data = tempfile::tempdir().expect("a folder");
    let url = database.url();
    let service = Service::start_with(data.path(), ["--workers", "0", "--database", url.expose()]).await;
    let archive = dataset::zip();
    let mut jobs = Vec::new();
    for seed in 0..JOBS {
        let query = format!("?preset=preview&iterations=30&seed={seed}");
        let created = service.upload(&query, archive.clone()).await.expect(201);
        jobs.push(created.header("location").to_owned());
    }
    let _workers = [worker(data.path(), &database), worker(data.path(), &database)];
    let begun = async || {
        let mut begun = 0;
        for job in &jobs {
            begun += u64::from(service.get(job).await.expect(200).json()["state"] != "queued");
        }
        begun > 0
    };
    eventually("a job has begun", begun).await;

    cluster.stop();
    service.get(&jobs[0]).await.expect(503);
    // What was found last is told again for a while.
    eventually("the service is not ready", async || service.get("/readyz").await.status == 503).await;
    cluster.restart();
    eventually("the service is ready again", async || service.get("/readyz").await.status == 200).await;

    for job in &jobs {
        let done = service.succeeded(job).await;
        let succeeded: Vec<_> = done["attempts"]
            .as_array()
            .expect("attempts")
            .iter()
            .filter(|attempt| attempt["outcome"] == "succeeded")
            .collect();
        assert_eq!(succeeded.len(), 1, "{done:#}");
    }
    assert!(!data.path().join("tcgs.sqlite").exists(), "nothing is in SQLite");
    for unwanted in ["panicked", PASSWORD] {
        assert!(!service.log().contains(unwanted), "the log shows '{unwanted}'");
    }
    assert!(service.stop().await.success());
}
