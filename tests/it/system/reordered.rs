//! Jobs and uploads through proxies before database and bucket that delay requests and let answers overtake each other.

use serde_json::json;
use tcgs::domain::Digest;

use crate::support::{dataset, deployment::Deployment, gate::GateState, service::Service};

const SEED: u64 = 20;
/// Options of jobs, each of which runs once through open proxies too.
const RECIPES: [&str; 2] = ["model=3dgs&iterations=20&seed=6", "model=3dgs&iterations=20&seed=7"];

/// A dataset of two parts of a multipart upload.
fn archive() -> Vec<u8> {
    dataset::padded_zip(9 << 20)
}

/// Sends a dataset in three parts and makes a scene of it.
async fn upload(service: &Service, archive: &[u8]) {
    let tus = |request: reqwest::RequestBuilder| request.header("tus-resumable", "1.0.0");
    let begun = service
        .send("POST", "/v1/uploads", |request| tus(request).header("upload-length", archive.len()))
        .await;
    let upload = begun.expect(201).header("location").to_owned();
    let mut offset = 0;
    for part in archive.chunks(archive.len().div_ceil(3)) {
        let sent = service.send("PATCH", &upload, |request| {
            let request = tus(request).header("upload-offset", offset);
            request.header("content-type", "application/offset+octet-stream").body(part.to_vec())
        });
        sent.await.expect(204);
        offset += part.len();
    }
    let id = upload.rsplit('/').next().expect("an id");
    let scene = service.post_json("/v1/scenes", &json!({ "upload_id": id })).await.json();
    assert_eq!(scene["dataset"]["sha256"], Digest::of(archive).to_string(), "{scene:#}");
}

/// Runs one job of each recipe at the same time, and returns the jobs.
async fn run_jobs(service: &Service) -> Vec<String> {
    let mut jobs = Vec::new();
    for recipe in RECIPES {
        let created = service.upload(&format!("?{recipe}"), dataset::zip()).await.expect(201);
        jobs.push(created.header("location").trim_start_matches("/v1/jobs/").to_owned());
    }
    for job in &jobs {
        service.succeeded(&format!("/v1/jobs/{job}")).await;
    }
    jobs
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answers_that_overtake_each_other_change_no_result() {
    let Some(deployment) = Deployment::shared().await else { return };
    let (deployment, gates) = deployment.behind_gates().await;
    let service = deployment.start(2).await;
    let undisturbed = run_jobs(&service).await;
    for gate in &gates {
        gate.set(GateState::Reordered(SEED));
    }
    let archive = archive();
    // The same dataset from two clients, so that one publishes what the other has just published.
    let uploads = async { tokio::join!(upload(&service, &archive), upload(&service, &archive)) };
    let (jobs, _) = tokio::join!(run_jobs(&service), uploads);
    let artifacts = deployment.artifacts().await;
    for (job, expected) in jobs.iter().zip(&undisturbed) {
        assert_eq!(artifacts[job], artifacts[expected]);
    }
    let attempts = "SELECT count(*) FROM attempts WHERE outcome <> 'succeeded'";
    assert_eq!(deployment.database.number(attempts).await, 0, "{}", service.log());
    deployment.checkpoints_are_gone().await;
    assert!(!service.log().contains("panicked"), "{}", service.log());
    assert!(service.stop().await.success());
    deployment.assert_tidy("answers in another order").await;
}
