//! `serve --keep-jobs` removes what ended long ago, on the real program.

use sqlx::{ConnectOptions as _, sqlite::SqliteConnectOptions};

use crate::support::{
    dataset,
    eventually::eventually,
    program::{answers, tcgs},
    service::Service,
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_removes_jobs_that_ended_before_the_days_it_keeps() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path().join("data");
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    let mut jobs = Vec::new();
    for number in 0..3 {
        let made = service.upload("", dataset::padded_zip(number)).await.expect(201);
        jobs.push(made.header("location").to_owned());
    }
    for job in &jobs[..2] {
        service.send("POST", &format!("{job}/cancel"), |request| request).await.expect(200);
    }
    service.stop().await;

    // The first and the one that waits are 40 days older than they are.
    let path = data.join("tcgs.sqlite");
    let mut database = SqliteConnectOptions::new().filename(path).connect().await.expect("a database");
    let micros = 40_i64 * 24 * 3600 * 1_000_000;
    for job in [&jobs[0], &jobs[2]] {
        let id = job.rsplit('/').next().expect("an id");
        let aged =
            "UPDATE jobs SET created_at = created_at - ?1, finished_at = finished_at - ?1 WHERE id = ?2";
        sqlx::query(aged).bind(micros).bind(id).execute(&mut database).await.expect("aged");
    }
    drop(database);

    let service = Service::start_with(&data, ["--workers", "0"]).await;
    service.get(&jobs[0]).await.expect(200);
    service.stop().await;
    let service = Service::start_with(&data, ["--workers", "0", "--keep-jobs", "30"]).await;
    eventually("the job is removed", async || service.get(&jobs[0]).await.status == 404).await;
    service.get(&jobs[1]).await.expect(200);
    assert_eq!(service.get(&jobs[2]).await.expect(200).json()["state"], "queued", "however old it is");
    service.stop().await;
    let report = answers(["fsck", "--data", data.to_str().expect("UTF-8"), "--json"]);
    assert_eq!(report["missing"], serde_json::json!([]));
    let refused = tcgs(["serve", "--data", data.to_str().expect("UTF-8"), "--keep-jobs", "0"]);
    assert_eq!(refused.status.code(), Some(2), "a day is the least");
}
