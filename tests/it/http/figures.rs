//! Metrics of known jobs and pictures, as operators read them.

use std::sync::Arc;

use jiff::SignedDuration;
use tcgs::{
    domain::{JobMetrics, ManualClock, PhaseSeconds},
    http::config::RequestLimits,
    store::Outcome,
};

use crate::support::{
    contract::Coverage,
    eventually::eventually,
    fakes,
    server::{Server, Setup},
};

async fn metrics(server: &Server) -> String {
    String::from_utf8(server.get("/metrics").await.expect(200).body.to_vec()).expect("UTF-8")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_seconds_of_each_phase_are_those_of_the_jobs_that_succeeded() {
    let server = Server::start_with(&Coverage::default(), Setup { worker: false, ..Setup::default() }).await;
    for scale in [1.0, 3.0] {
        server.create(&format!("succeed {scale}")).await;
        let lease = server.store.claim("test").await.expect("an answer").expect("a job").lease;
        let seconds = PhaseSeconds {
            ingest: 1.5 * scale,
            train: 60.0 * scale,
            encode: 2.0 * scale,
            decode: 0.25 * scale,
        };
        let metrics = JobMetrics { seconds, ..fakes::metrics() };
        let outcome = Outcome::Succeeded { metrics: Box::new(metrics), artifacts: vec![] };
        server.store.finish(&lease, outcome).await.expect("ended");
    }
    let expected = [("ingest", "6.0"), ("train", "240.0"), ("encode", "8.0"), ("decode", "1.0")];
    eventually("the figures of both jobs", async || {
        let text = metrics(&server).await;
        expected.iter().all(|(phase, seconds)| {
            text.contains(&format!("\ntcgs_phase_seconds_total{{phase=\"{phase}\"}} {seconds}\n"))
        })
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_in_the_line_for_the_renderer_are_counted() {
    let limits = RequestLimits { renders: 1, renders_waiting: 4, ..Setup::default().limits };
    let server = Server::start_with(&Coverage::default(), Setup { limits, ..Setup::default() }).await;
    let job = server.succeeded().await;
    let view = |x: u32| format!("{job}/view?position={x},0,0&look_at=0,0,0&height=16&width=17");
    let depth = async |rendering: u32, waiting: u32| {
        let text = metrics(&server).await;
        let of = |state: &str, count: u32| format!("\ntcgs_render_queue{{state=\"{state}\"}} {count}.0\n");
        text.contains(&of("rendering", rendering)) && text.contains(&of("waiting", waiting))
    };
    eventually("an empty line", async || depth(0, 0).await).await;
    let (first, second, third) = (view(1), view(2), view(3));
    let (a, b, c, ()) = tokio::join!(server.get(&first), server.get(&second), server.get(&third), async {
        eventually("one at the renderer and two behind it", async || depth(1, 2).await).await;
        server.renderer.gate.open();
    });
    for answer in [a, b, c] {
        answer.expect(200);
    }
    eventually("an empty line again", async || depth(0, 0).await).await;
}

#[tokio::test]
async fn a_job_that_a_database_ahead_has_queued_in_the_future_has_no_age() {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let setup = Setup { worker: false, clock: clock.clone(), ..Setup::default() };
    let server = Server::start_with(&Coverage::default(), setup).await;
    server.create("succeed").await;
    clock.set_by(SignedDuration::from_secs(-5));
    let text = metrics(&server).await;
    assert!(text.contains("\ntcgs_oldest_queued_job_age_seconds 0.0\n"), "{text}");
}
