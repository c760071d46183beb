//! How many jobs are claimed in a second.

use std::{sync::Arc, time::Instant};

use tcgs::{
    domain::{Digest, JobId, ProjectId, TrainOptions},
    store::{BlobRef, NewJob, Outcome, Store},
};
use uuid::Uuid;

/// Jobs for each number of claimers.
const JOBS: usize = 400;

/// Prints how many jobs a second one claimer takes, and eight at the same time.
pub(crate) async fn measure(store: Arc<dyn Store>, project: ProjectId) {
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
        for claim in claims {
            store.finish(&claim.lease, Outcome::Cancelled).await.unwrap();
        }
    }
}
