//! How many jobs are claimed in a second, and how many leases are renewed and reports of progress written.

use std::{sync::Arc, time::Instant};

use tcgs::{
    domain::{Digest, JobId, Phase, Progress, ProjectId, TrainOptions},
    store::{BlobRef, Lease, NewJob, Outcome, Store},
};
use uuid::Uuid;

/// Jobs for each number of claimers.
const JOBS: usize = 400;

/// Prints how many jobs a second one claimer takes, and eight at the same time.
pub(crate) async fn measure(store: Arc<Store>, project: ProjectId) {
    for claimers in [1, 8] {
        for _ in 0..JOBS {
            let dataset = BlobRef { digest: Digest::of(b"a dataset"), bytes: 9 };
            let new = NewJob::new(JobId(Uuid::now_v7()), TrainOptions::default(), dataset);
            store.create_job(NewJob { project, ..new }).await.unwrap();
        }
        let start = Instant::now();
        let claiming = (0..claimers).map(|claimer| {
            let store = Arc::clone(&store);
            tokio::spawn(async move {
                let (worker, mut claims) = (format!("worker {claimer}"), Vec::new());
                while let Some(claim) = store.claim(&worker).await.unwrap() {
                    claims.push(claim);
                }
                claims
            })
        });
        let mut claims = Vec::new();
        for claiming in claiming.collect::<Vec<_>>() {
            claims.extend(claiming.await.unwrap());
        }
        let seconds = start.elapsed().as_secs_f64();
        println!("{:40} {:>12.0} claims/s", format!("{claimers} claiming"), claims.len() as f64 / seconds);
        let leases: Vec<Lease> = claims.iter().map(|claim| claim.lease.clone()).collect();
        renew_and_report(&store, leases, claimers).await;
        for claim in claims {
            store.finish(&claim.lease, Outcome::Cancelled).await.unwrap();
        }
    }
}

/// Prints how many leases so many workers renew in a second, and how many reports they write.
async fn renew_and_report(store: &Arc<Store>, leases: Vec<Lease>, workers: usize) {
    for what in ["renewals", "reports"] {
        let start = Instant::now();
        let working = leases.chunks(leases.len().div_ceil(workers)).map(|leases| {
            let (store, leases) = (Arc::clone(store), leases.to_vec());
            tokio::spawn(async move {
                for lease in leases {
                    if what == "renewals" {
                        store.heartbeat(&lease).await.unwrap();
                    } else {
                        store.report(&lease, Phase::Train, &Progress::default()).await.unwrap();
                    }
                }
            })
        });
        for worker in working.collect::<Vec<_>>() {
            worker.await.unwrap();
        }
        let rate = leases.len() as f64 / start.elapsed().as_secs_f64();
        println!("{:40} {rate:>12.0} {what}/s", format!("{workers} at work"));
    }
}
