//! Says for people what a file's run chose and why: from its provenance, and from the bytes of the contexts that the encoder compared.

use serde_json::Value;

use super::manifest::{GroupContext, Manifest};
use crate::domain::{
    SceneFrame,
    choices::{Choices, Explanation, Widths},
    context_model::ContextKind,
    options::Voxel,
};

/// Every choice that `manifest` states; of files of earlier versions, the contexts alone. `regressions` are the bytes of the groups that
/// have one; `frame` is the scene's.
pub(super) fn explain(
    manifest: &Manifest,
    regressions: [Option<u64>; 3],
    frame: SceneFrame,
) -> Vec<Explanation> {
    let settings = &manifest.provenance.settings;
    let choices: Option<Choices> = read(settings, "choices");
    let voxel = read(settings, "voxel").unwrap_or(Voxel::Auto);
    let edge = (f64::from(manifest.lattice.voxel) * frame.scale()) as f32;
    let narrowed_from = choices.as_ref().and_then(|choices| choices.narrowed_from);
    let mut all = choices.map_or_else(Vec::new, |choices| choices.explain(voxel, edge));
    let shape = manifest.shape();
    all.push(Explanation::new(
        "feature width",
        manifest.feature_dim.to_string(),
        match narrowed_from {
            Some(Widths { features, .. }) => format!(
                "of {features} learnt: in the basis of what pictures show, the others vary by less than a quarter of a step"
            ),
            None => "the preset's, for a run of its length".to_owned(),
        },
    ));
    let slots = shape.anchors.saturating_mul(shape.offsets_per_anchor).max(1);
    all.push(Explanation::new(
        "offsets per anchor",
        manifest.offsets_per_anchor.to_string(),
        format!(
            "{}; masks keep {} of {slots}, {:.2} an anchor",
            narrowed_from.map_or("as published".to_owned(), |from| format!(
                "the slots of {} that an anchor uses",
                from.offsets
            )),
            manifest.gaussians,
            manifest.gaussians as f64 / shape.anchors.max(1) as f64
        ),
    ));
    let groups = ["features", "scalings", "offsets"].into_iter().zip(&manifest.contexts).zip(regressions);
    all.extend(groups.map(|((group, chosen), regression)| context(group, chosen, regression)));
    all
}

fn read<T: serde::de::DeserializeOwned>(settings: &Value, name: &str) -> Option<T> {
    settings.get(name).and_then(|value| serde_json::from_value(value.clone()).ok())
}

/// The context of one attribute group.
fn context(group: &str, context: &GroupContext, regression: Option<u64>) -> Explanation {
    let inputs = match context.kind {
        None => "tables: position no, planes no, neighbors no",
        Some(ContextKind::Position) => "position yes, planes no, neighbors no",
        Some(ContextKind::TriPlane) => "position yes, planes yes, neighbors no",
        Some(ContextKind::TriPlaneKnn) => "position yes, planes yes, neighbors yes",
    };
    let value = format!("{inputs}, regression {}", if regression.is_some() { "yes" } else { "no" });
    let bytes = context.bytes;
    let tried: Vec<String> = [
        ("tables", bytes.tables),
        ("position", bytes.position),
        ("planes", bytes.tri_plane),
        ("planes and neighbors", bytes.tri_plane_knn),
    ]
    .iter()
    .filter_map(|(name, bytes)| bytes.map(|bytes| format!("{bytes} with {name}")))
    .collect();
    let because = if tried.is_empty() {
        "nothing else was tried".to_owned()
    } else {
        let with = regression
            .map_or(String::new(), |bytes| format!("; {bytes} with a regression beside the chosen one"));
        format!("bytes with its network, without planes: {}{with}", tried.join(", "))
    };
    Explanation::new(&format!("context of the {group}"), &value, because)
}
