//! What the inputs of context models save: models of every kind fitted to one finished scene and coded with it.
//!
//! Every model codes the same symbols, so the files differ in their bytes alone.

mod scene;

use std::{sync::Arc, time::Instant};

use serde::Serialize;

pub use scene::TrialScene;

use tcgs_codec::{
    ContextChoice, ContextSearch, ContextSettings, EncodeSettings, Encoded, GroupChoice, Provenance,
    domain::{
        Background, ByteCounts, CancelFlag, ContextCandidates, ContextKind, Problem, ProblemType,
        anchors::SCALINGS_PER_ANCHOR,
    },
    encode,
};
use tcgs_engine::train::{
    ContextFitSettings,
    context::{ContextConfig, PlaneConfig},
    fit_contexts,
};
use tcgs_render::gpu::Device;

/// Edges of the planes that are tried.
const EDGES: [usize; 3] = [32, 64, 128];

/// Edge of the planes whose neighbors are tried too.
const NEIGHBORS_EDGE: usize = 64;

/// Bits of a weight that are tried.
const WEIGHT_BITS: [u8; 3] = [8, 6, 4];

/// The smallest file of a scene with one kind of context.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ContextTrial {
    /// What is given to the networks.
    pub context: String,
    /// Where the bytes go.
    pub bytes: ByteCounts,
    pub fit_seconds: f64,
}

/// Fits and codes every kind: tables, the position, planes of three edges, and neighbors on one of them; then the encoder's own
/// choice among all of these, group by group. Calls `begin` with the name of each.
///
/// # Errors
/// Problems of fitting and encoding.
pub fn context_trials(
    device: &Arc<Device>,
    trial: &TrialScene,
    settings: ContextFitSettings,
    begin: &mut dyn FnMut(&str),
    cancel: &CancelFlag,
) -> Result<Vec<ContextTrial>, Problem> {
    let scene = &trial.scene;
    let channels = [scene.feature_dim, SCALINGS_PER_ANCHOR, 3 * scene.offsets_per_anchor];
    let config = |kind, edge| {
        let config = ContextConfig::for_anchors(kind, channels, scene.len());
        ContextConfig { planes: PlaneConfig { edge, ..config.planes.without_layers() }, ..config }
    };
    let kinds = [(ContextKind::Position, EDGES[0])]
        .into_iter()
        .chain(EDGES.map(|edge| (ContextKind::TriPlane, edge)))
        .chain([(ContextKind::TriPlaneKnn, NEIGHBORS_EDGE)]);

    begin("tables");
    let tables = code(trial, None, ContextSearch::Cheapest)?;
    let mut trials =
        vec![ContextTrial { context: "tables".to_owned(), bytes: tables.byte_counts, fit_seconds: 0.0 }];
    let mut all: Option<ContextCandidates> = None;
    for (kind, edge) in kinds {
        let context = match kind {
            ContextKind::Position => "position".to_owned(),
            ContextKind::TriPlane => format!("planes of {edge}"),
            ContextKind::TriPlaneKnn => format!("planes of {edge}, neighbors"),
        };
        begin(&context);
        let started = Instant::now();
        let fitted = fit_contexts(device, scene, trial.steps, &[config(kind, edge)], settings, cancel)?;
        let fit_seconds = started.elapsed().as_secs_f64();
        for candidates in fitted {
            let bytes = smallest(trial, &candidates, kind)?;
            trials.push(ContextTrial { context: context.clone(), bytes, fit_seconds });
            match &mut all {
                None => all = Some(candidates),
                Some(all) => all.planes.extend(candidates.planes),
            }
        }
    }
    begin("the encoder's choice");
    let chosen = code(trial, all.as_ref(), ContextSearch::Cheapest)?;
    let context = format!("the encoder's choice: {}", in_words(&chosen.context));
    trials.push(ContextTrial { context, bytes: chosen.byte_counts, fit_seconds: 0.0 });
    Ok(trials)
}

/// The smallest file whose groups all have the network of `kind`.
fn smallest(
    trial: &TrialScene,
    candidates: &ContextCandidates,
    kind: ContextKind,
) -> Result<ByteCounts, Problem> {
    let mut best: Option<ByteCounts> = None;
    for weight_bits in WEIGHT_BITS {
        let groups = [GroupChoice::Network { kind, weight_bits }; 3];
        let planes = (kind.sampled() > 0).then_some(0);
        let search = ContextSearch::Fixed(ContextChoice { planes, groups });
        let bytes = code(trial, Some(candidates), search)?.byte_counts;
        if best.as_ref().is_none_or(|best| bytes.total < best.total) {
            best = Some(bytes);
        }
    }
    Ok(best.unwrap_or_default())
}

fn code(
    trial: &TrialScene,
    candidates: Option<&ContextCandidates>,
    search: ContextSearch,
) -> Result<Encoded, Problem> {
    let TrialScene { scene, steps } = trial;
    let settings = EncodeSettings {
        feature_step: steps.feature,
        scaling_step: steps.scaling,
        offset_step: steps.offset,
        context: ContextSettings { search, ..ContextSettings::default() },
        background: Background::Black,
        provenance: Provenance::unstated(),
    };
    encode(scene, candidates, &settings)
        .map_err(|error| Problem::new(ProblemType::NotEncodable, error.to_string()))
}

/// The kinds of features, scalings and offsets.
fn in_words(choice: &ContextChoice) -> String {
    let group = |group: GroupChoice| match group {
        GroupChoice::Static => "tables",
        GroupChoice::Network { kind: ContextKind::Position, .. } => "position",
        GroupChoice::Network { kind: ContextKind::TriPlane, .. } => "planes",
        GroupChoice::Network { kind: ContextKind::TriPlaneKnn, .. } => "neighbors",
    };
    choice.groups.map(group).join(", ")
}
