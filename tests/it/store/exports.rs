//! Exports of finished jobs, found by their hash.

use tcgs::{
    domain::{ProjectId, SceneFormat},
    store::{Artifact, ArtifactKind, ExportRecord, FileRecord, Outcome},
};

use super::totals::{Fixture, blob};
use crate::support::fakes;

#[tokio::test]
async fn the_export_of_a_file_that_two_weights_share_is_found() {
    let Some(fixture) = Fixture::new().await else { return };
    let job = fixture.job(1, ProjectId::DEFAULT, None, "a dataset").await;
    let kind = ArtifactKind::Scene(SceneFormat::Tcgs);
    let artifact = |lambda| Artifact { kind, lambda: Some(lambda), blob: blob("the same file") };
    let artifacts = vec![artifact(0.001), artifact(0.004)];
    fixture.finish(Outcome::Succeeded { metrics: Box::new(fakes::metrics()), artifacts }).await;
    let export = ExportRecord {
        job,
        source: blob("the same file").digest,
        format: SceneFormat::Ply,
        blob: blob("as ply"),
        gaussians: 1,
        sh_degree: 0,
        fidelity: None,
    };
    fixture.store.add_export(export).await.expect("kept").expect("known");
    let found = fixture.store.file(export.blob.digest, None).await.expect("read");
    let kind = ArtifactKind::Scene(SceneFormat::Ply);
    assert_eq!(found, Some(FileRecord { job, kind, lambda: Some(0.001), blob: export.blob }));
}
