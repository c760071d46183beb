//! Context models of a finished scene.

use tcgs::{
    codec::{
        ContextChoice, ContextSearch, ContextSettings, EncodeSettings, Encoded, GroupChoice, Provenance,
        encode,
    },
    domain::{Background, CancelFlag, ContextCandidates, ContextKind},
    train::{
        ContextFitSettings, TrainError,
        context::{ContextConfig, PlaneConfig},
        fit_contexts,
    },
};
use tcgs_lab::context_trials::TrialScene;

use crate::support::gpu::gpu;

const KINDS: [ContextKind; 3] = [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn];

fn trial() -> TrialScene {
    TrialScene::read(include_bytes!("../../../golden/trained_v1.tcgs")).expect("a file").crop(100)
}

fn configs(trial: &TrialScene) -> [ContextConfig; 3] {
    let channels = [trial.scene.feature_dim, 6, 3 * trial.scene.offsets_per_anchor];
    KINDS.map(|kind| {
        let config = ContextConfig::for_anchors(kind, channels, trial.scene.len());
        ContextConfig { planes: PlaneConfig { edge: 16, ..config.planes.without_layers() }, ..config }
    })
}

fn file(trial: &TrialScene, candidates: Option<&ContextCandidates>, choice: ContextChoice) -> Encoded {
    let settings = EncodeSettings {
        background: Background::Black,
        feature_step: trial.steps.feature,
        scaling_step: trial.steps.scaling,
        offset_step: trial.steps.offset,
        context: ContextSettings { search: ContextSearch::Fixed(choice), ..ContextSettings::default() },
        provenance: Provenance::unstated(),
    };
    encode(&trial.scene, candidates, &settings).expect("a file")
}

#[test]
fn files_of_every_model_decode_to_the_same_scene_in_fewer_bytes_after_more_steps() {
    let trial = trial();
    let tables = file(&trial, None, ContextChoice::STATIC);
    let fitted = |steps| {
        let settings = ContextFitSettings { steps, seed: 3 };
        fit_contexts(&gpu(), &trial.scene, trial.steps, &configs(&trial), settings, &CancelFlag::default())
            .expect("fits")
    };
    let attributes = |candidates: &ContextCandidates, kind: ContextKind| {
        let groups = [GroupChoice::Network { kind, weight_bits: 8 }; 3];
        let planes = (kind != ContextKind::Position).then_some(0);
        let encoded = file(&trial, Some(candidates), ContextChoice { planes, groups });
        assert_eq!(encoded.decode_sha256, tables.decode_sha256, "{kind:?}");
        let bytes = encoded.byte_counts;
        bytes.features + bytes.scalings + bytes.offsets
    };
    let (first, later) = (fitted(1), fitted(200));
    for ((kind, first), later) in KINDS.into_iter().zip(&first).zip(&later) {
        let (first, later) = (attributes(first, kind), attributes(later, kind));
        assert!(later < first, "{kind:?}: {later} bytes after 200 steps, {first} after one");
    }
}

#[test]
fn a_cancelled_fit_ends() {
    let (trial, cancel) = (trial(), CancelFlag::default());
    cancel.cancel();
    let settings = ContextFitSettings { steps: 1000, seed: 0 };
    let ended = fit_contexts(&gpu(), &trial.scene, trial.steps, &configs(&trial), settings, &cancel);
    assert!(matches!(ended, Err(TrainError::Cancelled)), "{ended:?}");
}
