//! Training curves.

use serde_json::{Value, json};
use tcgs::{
    domain::{Phase, Problem, ProblemType, Progress},
    store::{Lease, Outcome, StoreError},
};

use crate::support::{
    contract::Coverage,
    server::{Server, Setup},
};

fn report(step: u64, elapsed_seconds: f64, psnr: f64) -> Progress {
    Progress {
        step,
        total: 100,
        elapsed_seconds,
        anchors: 1000 + step,
        gaussians: 4000,
        loss: Some(1.0 / step as f64),
        psnr: Some(psnr),
        ssim: Some(psnr / 40.0),
        bytes: (step >= 30).then_some(50_000 - step),
        ..Progress::default()
    }
}

async fn claim(server: &Server) -> Lease {
    server.store.claim("test").await.expect("a claim").expect("a job").lease
}

async fn steps(server: &Server, path: &str) -> Value {
    server.get(path).await.expect(200).json()["step"].clone()
}

pub(super) async fn the_course_of_training_is_served_as_columns(coverage: Coverage) {
    let server = Server::start_with(&coverage, Setup { worker: false, ..Setup::default() }).await;
    let job = server.create("succeed").await;
    let path = format!("{job}/series");
    assert_eq!(steps(&server, &path).await, json!([]));

    let lease = claim(&server).await;
    let points: Vec<Progress> =
        [(10, 1.0), (20, 2.0), (30, 3.0), (40, 4.0)].map(|(step, at)| report(step, at, 20.0)).into();
    server.store.record(&lease, &points[..2]).await.expect("stored");
    server.store.record(&lease, &points[2..]).await.expect("stored");
    server.store.report(&lease, Phase::Train, &points[3]).await.expect("stored");
    let whole = server.get(&path).await.expect(200);
    let etag = whole.header("etag").to_owned();
    assert_eq!(
        whole.json(),
        json!({
            "attempt": [1, 1, 1, 1],
            "step": [10, 20, 30, 40],
            "seconds": [1.0, 2.0, 3.0, 4.0],
            "loss": [0.1, 0.05, 1.0 / 30.0, 0.025],
            "psnr": [20.0, 20.0, 20.0, 20.0],
            "ssim": [0.5, 0.5, 0.5, 0.5],
            "anchors": [1010, 1020, 1030, 1040],
            "gaussians": [4000, 4000, 4000, 4000],
            "bytes": [null, null, 49_970, 49_960],
        })
    );
    let same = server.send("GET", &path, |request| request.header("if-none-match", &etag)).await;
    assert_eq!(same.expect(304).body.len(), 0);
    assert_eq!(steps(&server, &format!("{path}?points=2")).await, json!([10, 40]));
    for (query, named) in [("?points=0", "points"), ("?points=1001", "points"), ("?every=2", "every")] {
        let detail = server.get(&format!("{path}{query}")).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with(named), "{detail}");
    }

    // The next attempt goes on from a checkpoint at step 20, which it tells of before it has a loss.
    let lost = Outcome::Retry(Problem::new(ProblemType::DeviceLost, "as the test wants it"));
    server.store.finish(&lease, lost.clone()).await.expect("ended");
    let late = server.store.record(&lease, &points).await;
    assert!(matches!(late, Err(StoreError::LeaseLost { .. })), "{late:?}");
    let second = claim(&server).await;
    let resumed = [Progress { loss: None, psnr: None, ..report(20, 0.5, 0.0) }, report(25, 1.0, 21.0)];
    server.store.record(&second, &resumed).await.expect("stored");
    server.store.report(&second, Phase::Train, &resumed[1]).await.expect("stored");
    let changed = server.send("GET", &path, |request| request.header("if-none-match", &etag)).await;
    let changed = changed.expect(200).json();
    assert_eq!(changed["step"], json!([10, 20, 25]), "what the checkpoint did not know is gone");
    assert_eq!(changed["attempt"], json!([1, 1, 2]));
    assert_eq!(changed["seconds"], json!([1.0, 2.0, 3.0]));
    assert_eq!(changed["psnr"], json!([20.0, 20.0, 21.0]), "the measured point stays");

    // The one after that begins anew.
    server.store.finish(&second, lost).await.expect("ended");
    let third = claim(&server).await;
    server.store.record(&third, &[report(10, 1.5, 19.0)]).await.expect("stored");
    server.store.report(&third, Phase::Train, &report(10, 1.5, 19.0)).await.expect("stored");
    let anew = server.get(&path).await.expect(200).json();
    assert_eq!(
        (&anew["step"], &anew["attempt"], &anew["seconds"]),
        (&json!([10]), &json!([3]), &json!([1.5]))
    );

    // However many reports there are, a job keeps a thousand.
    let many: Vec<Progress> =
        (11..=5000).map(|step| Progress { total: 5000, ..report(step, step as f64, 20.0) }).collect();
    server.store.record(&third, &many).await.expect("stored");
    let kept = server.get(&path).await.expect(200).json();
    let kept = kept["step"].as_array().expect("steps");
    assert!(kept.len() <= 1000, "{}", kept.len());
    assert_eq!(kept.last(), Some(&json!(5000)));
    let infinite = Progress { loss: Some(f64::INFINITY), psnr: Some(f64::NAN), ..report(5001, 9.0, 0.0) };
    server.store.record(&third, &[infinite]).await.expect("what is not finite is left out");
    server.get(&path).await.expect(200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_of_moments_has_a_course_too() {
    let server = Server::start(&Coverage::default()).await;
    let job = server.succeeded().await;
    let series = server.get(&format!("{job}/series")).await.expect(200).json();
    assert_eq!((&series["step"], &series["loss"]), (&json!([1]), &json!([0.5])));
}
