//! The simulation of the benchmark in small: many jobs of unequal projects, taken by workers of which some die, on a simulated clock.

use tcgs::store::JobFilter;

use super::{database, queue::succeeded, simulation};

#[tokio::test]
async fn every_job_ends_once_and_no_project_waits_for_another_while_workers_die() {
    let Some(database) = database().await else { return };
    let size = simulation::Size { jobs: 1000, workers: 40, seed: 7 };
    let clock = simulation::clock();
    let store = database.open(clock.clone(), simulation::policy()).await;
    let report = simulation::run(&store, &clock, size, &succeeded).await;
    println!("{report}");
    assert!(report.lost > 0 && report.failed > 0, "something went wrong on the way");
    assert_eq!(report.claims, report.size.jobs + report.lost + report.failed);
    assert!(report.greatest_spread <= 3, "a project has more than its share");
    // What is left over at the end: the longest jobs, and those whose last worker died, twice.
    let slack = 4 * 1_800_000_000;
    assert!(report.makespan_micros < report.ideal_micros + slack, "workers were idle while jobs waited");
    // The late project, which had nothing running, waits for the next workers that are free, not for the queues before it.
    let late = &report.waits["late"];
    let bulk = &report.waits["bulk"];
    assert!(late[0] < 120_000_000, "{} s", late[0] / 1_000_000);
    assert!(late[late.len() / 2] < bulk[bulk.len() / 2] / 4);
    let urgent = &report.waits["urgent"];
    assert!(urgent[urgent.len() / 2] < bulk[bulk.len() / 2] / 2, "its cap alone delays it");

    let stats = store.stats().await.expect("read");
    let ended: u64 = stats.attempts.iter().map(|attempts| attempts.count).sum();
    assert_eq!((stats.claims, ended), (report.claims as u64, report.claims as u64));
    let shown = store.jobs(&JobFilter::default(), None, 20).await.expect("read");
    assert!(shown.iter().all(|record| record.job.state.is_terminal() && record.artifacts.len() == 1));
}
