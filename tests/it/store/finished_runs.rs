//! Figures of finished jobs, for estimates.

use jiff::SignedDuration;
use tcgs::{
    domain::{Digest, JobMetrics, ModelKind, PhaseSeconds, Preset, ProjectId, TrainOptions},
    store::{FinishedRun, NewJob, Outcome},
};

use super::totals::{Fixture, problem};
use crate::support::fakes;

#[tokio::test]
async fn finished_runs_are_those_of_the_model_and_preset_with_their_other_seconds() {
    let Some(fixture) = Fixture::new().await else { return };
    let finish = async |id, metrics: JobMetrics| {
        fixture.job(id, ProjectId::DEFAULT, None, "a dataset").await;
        let claim = fixture.store.claim("worker").await.expect("an answer").expect("a job");
        fixture.clock.advance(SignedDuration::from_secs(90));
        let outcome = Outcome::Succeeded { metrics: Box::new(metrics), artifacts: vec![] };
        fixture.store.finish(&claim.lease, outcome).await.expect("ended");
    };
    let seconds = PhaseSeconds { train: 60.0, ..PhaseSeconds::default() };
    let metrics = JobMetrics { seconds, steps_per_second: 12.5, ..fakes::metrics() };
    finish(1, metrics.clone()).await;
    finish(2, JobMetrics { view_pixels: None, ..metrics.clone() }).await;
    // Jobs that do more than one file takes have no other seconds.
    let options = TrainOptions { rd_curve: vec![0.001, 0.002], ..TrainOptions::default() };
    let curve = NewJob { options, ..fixture.new_job(4, ProjectId::DEFAULT, "a dataset") };
    let photographs = NewJob {
        photographs: Some(Digest::of(b"photographs")),
        ..fixture.new_job(5, ProjectId::DEFAULT, "a dataset")
    };
    for job in [curve, photographs] {
        fixture.store.create_job(job).await.expect("created");
        let claim = fixture.store.claim("worker").await.expect("an answer").expect("a job");
        let outcome = Outcome::Succeeded { metrics: Box::new(metrics.clone()), artifacts: vec![] };
        fixture.store.finish(&claim.lease, outcome).await.expect("ended");
    }
    fixture.job(3, ProjectId::DEFAULT, None, "a dataset").await;
    fixture.finish(Outcome::Failed(problem())).await;
    let runs = fixture.store.finished_runs(ModelKind::Tcgs, Preset::Preview).await.expect("read");
    let [newer @ .., FinishedRun { adapter, view_pixels, steps_per_second, other_seconds }] = &runs[..]
    else {
        panic!("{runs:?}")
    };
    assert_eq!(newer.iter().map(|run| run.other_seconds).collect::<Vec<_>>(), [None, None]);
    assert_eq!((&**adapter, *view_pixels, *steps_per_second), ("fake", 1280, 12.5));
    let other = other_seconds.expect("one attempt");
    // PostgreSQL has a clock of its own.
    assert!(other == 30.0 || other < 5.0, "{other}");
    for (model, preset) in [(ModelKind::Scaffold, Preset::Preview), (ModelKind::Tcgs, Preset::Standard)] {
        assert_eq!(fixture.store.finished_runs(model, preset).await.expect("read"), []);
    }
}
