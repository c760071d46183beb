//! Workers stand back behind the service that starts them, if they are to.

#![cfg(target_os = "linux")]

use std::fs;

use crate::support::{eventually::eventually, service::Service};

/// Places of what [`fields`] returns.
const PARENT: usize = 0;
const NICE: usize = 15;

/// Numbers of a `stat` file in `/proc`, from the parent's on.
fn fields(path: &str) -> Vec<i64> {
    let stat = fs::read_to_string(path).expect("a process");
    let (_, fields) = stat.rsplit_once(')').expect("a name in parentheses");
    // The state comes before, which is a letter.
    fields.split_whitespace().skip(1).map(|field| field.parse().unwrap_or_default()).collect()
}

/// Niceness of each thread of a process.
fn niceness(process: &str) -> Vec<i64> {
    let threads = fs::read_dir(format!("/proc/{process}/task")).expect("a process");
    let paths = threads.map(|thread| thread.expect("an entry").path().join("stat"));
    paths.map(|path| fields(path.to_str().expect("UTF-8"))[NICE]).collect()
}

#[tokio::test]
async fn workers_let_the_service_go_first_by_as_much_as_was_said() {
    let data = tempfile::tempdir().expect("a folder");
    let service = Service::start_with(data.path(), ["--worker-nice", "3"]).await;
    let mut worker = String::new();
    eventually("a worker", async || {
        worker = service.workers().first().map(u32::to_string).unwrap_or_default();
        // It has one thread until it has its priority.
        !worker.is_empty() && niceness(&worker).len() > 1
    })
    .await;
    let of_process = fields(&format!("/proc/{worker}/stat"));
    let own = fields(&format!("/proc/{}/stat", of_process[PARENT]))[NICE];
    // The test itself may run with less than the usual priority, and there is an end to it.
    let lower = (own + 3).min(19);
    assert_eq!(of_process[NICE], lower);
    // Drivers have threads that stand back by themselves.
    let threads = niceness(&worker);
    assert!(threads.iter().all(|nice| *nice >= lower), "{threads:?}, and {own} the service");
    assert!(service.stop().await.success());
}
