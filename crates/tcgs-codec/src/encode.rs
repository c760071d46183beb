//! Encodes a scene as a file and verifies it by decoding it.

use super::{
    EncodeSettings, Encoded, attributes, container,
    decode::{DecodeLimits, KnownNeighbors, decode_with},
    digest::decode_digest,
    error::EncodeError,
    inspect::inspect,
    manifest::{ColorSpace, MAX_FEATURE_DIM, MAX_OFFSETS, Manifest, QuantSteps, WorldFrame},
    masks,
    networks::{self, QuantizedNetworks},
    positions,
    precision::{self, Activation},
    quantize::{self, Symbols},
    search::{self, Anchors},
    sections::{self, SectionId},
    view,
};
use crate::domain::{AnchorScene, ContextCandidates, Digest};

/// Anchors in a chunk: about 100 kB of attributes, enough that index and stream endings are a thousandth.
const CHUNK_ANCHORS: usize = 4096;

/// Writes `scene` as a `.tcgs` file and reads it back.
///
/// Of the contexts that training left, those are used that `settings` asks for; without any, every group has tables.
/// Anchors without a kept offset are left out; the others are put into Morton order. The bytes depend on the
/// arguments alone, not on the machine or its threads.
///
/// # Errors
/// [`EncodeError`] where the scene or the settings cannot be written, saying which value and why.
pub fn encode(
    scene: &AnchorScene,
    context: Option<&ContextCandidates>,
    settings: &EncodeSettings,
) -> Result<Encoded, EncodeError> {
    let stage = tracing::debug_span!("encode").entered();
    check_counts(scene)?;
    scene.check()?;
    networks::check(&scene.networks)?;

    let AnchorOrder { ordered, order } = order_anchors(scene)?;

    let mut manifest = new_manifest(scene, order.len(), settings);
    manifest.check_numbers()?;

    let (shape, k) = (manifest.shape(), scene.offsets_per_anchor);
    let cells: Vec<[i32; 3]> = order.iter().map(|anchor| scene.cells[*anchor]).collect();
    let masks: Vec<bool> =
        order.iter().flat_map(|anchor| &scene.masks[anchor * k..(anchor + 1) * k]).copied().collect();
    let chunks = attributes::ranges(shape.anchors, manifest.chunk_anchors);
    let anchors = Anchors {
        scene,
        order: &order,
        cells: &cells,
        masks: &masks,
        shape,
        steps: manifest.steps,
        chunks: &chunks,
    };
    let (chosen, (networks, rest)) = rayon::join(
        || stage.in_scope(|| search::choose(&anchors, context, &settings.context)),
        || {
            stage.in_scope(|| {
                let networks = quantize_networks(scene);
                let rest =
                    [networks::encode(&networks), positions::encode(&ordered), masks::encode(&masks, k)];
                (networks, rest)
            })
        },
    );
    let chosen = chosen?;
    manifest.contexts = chosen.contexts;
    let attributes = attributes::encode(chosen.groups.each_ref());
    let [features, scalings, offsets] = chosen.groups;
    let symbols = Symbols {
        cells,
        masks,
        groups: [features.symbols, scalings.symbols, offsets.symbols],
        step_indices: [features.step_indices, scalings.step_indices, offsets.step_indices],
    };
    let expected = quantize::dequantize(symbols, &networks, &manifest);
    manifest.decode_sha256 = decode_digest(&expected);
    let [networks, positions, masks] = rest;
    let payload = [
        Some((sections::NETWORKS, networks)),
        Some((sections::POSITIONS, positions)),
        Some((sections::MASKS, masks)),
        chosen.context.map(|section| (sections::CONTEXT, section)),
        chosen.planes.map(|section| (sections::PLANES, section)),
        chosen.regression.map(|section| (sections::REGRESSION, section)),
        Some((sections::ATTRIBUTES, attributes)),
    ];
    let bytes = assemble_sections(&manifest, payload, scene);

    let known = KnownNeighbors { cells: &expected.cells, neighbors: chosen.neighbors };
    let decoded = decode_with(&bytes, &DecodeLimits::NONE, Some(known)).map_err(EncodeError::ReadBack)?;
    // The hash covers every other value.
    let view = |scene: &AnchorScene| (scene.near, scene.scene_scale, scene.frame);
    if decoded.decode_sha256 != manifest.decode_sha256 || view(&decoded.scene) != view(scene) {
        return Err(EncodeError::Verification);
    }
    let byte_counts = inspect(&bytes).map_err(EncodeError::ReadBack)?.byte_counts;
    Ok(Encoded {
        bytes,
        scene: decoded.scene,
        decode_sha256: decoded.decode_sha256,
        byte_counts,
        context: chosen.choice,
    })
}

/// The anchors that a file holds.
struct AnchorOrder {
    /// Their cells, sorted.
    ordered: positions::Ordered,
    /// Their indices in the scene, in file order.
    order: Vec<usize>,
}

/// Drops the anchors without a kept offset and puts the others into Morton order.
fn order_anchors(scene: &AnchorScene) -> Result<AnchorOrder, EncodeError> {
    let k = scene.offsets_per_anchor;
    let kept: Vec<usize> = (0..scene.len())
        .filter(|anchor| scene.masks[anchor * k..(anchor + 1) * k].iter().any(|kept| *kept))
        .collect();
    let ordered = positions::order(&kept.iter().map(|anchor| scene.cells[*anchor]).collect::<Vec<_>>())?;
    let order = ordered.order.iter().map(|index| kept[*index]).collect();
    Ok(AnchorOrder { ordered, order })
}

/// The manifest of a file of `anchors` anchors, before contexts are chosen and the decode hash is known.
fn new_manifest(scene: &AnchorScene, anchors: usize, settings: &EncodeSettings) -> Manifest {
    Manifest {
        contexts: Default::default(),
        anchors,
        gaussians: scene.gaussians(),
        feature_dim: scene.feature_dim,
        offsets_per_anchor: scene.offsets_per_anchor,
        chunk_anchors: CHUNK_ANCHORS,
        lattice: scene.lattice,
        steps: QuantSteps {
            feature: settings.feature_step,
            scaling: settings.scaling_step * scene.lattice.voxel,
            offset: settings.offset_step,
        },
        world_frame: WorldFrame::Dataset,
        color_space: ColorSpace::Srgb,
        background: settings.background,
        decode_sha256: Digest::from_bytes([0; 32]),
        provenance: settings.provenance.clone(),
    }
}

/// The whole file: manifest, payload, and the optional sections whose values are not the default.
fn assemble_sections(
    manifest: &Manifest,
    payload: [Option<(SectionId, Vec<u8>)>; 7],
    scene: &AnchorScene,
) -> Vec<u8> {
    let mut content = vec![(sections::MANIFEST, manifest.encode())];
    content.extend(payload.into_iter().flatten());
    content
        .extend(view::encode_scene_scale(scene.scene_scale).map(|scene_scale| (sections::UNIT, scene_scale)));
    content.extend(view::encode_frame(scene.frame).map(|frame| (sections::FRAME, frame)));
    content
        .extend(view::encode_view_degree(scene.view_degree()).map(|degree| (sections::DIRECTIONS, degree)));
    content.extend(view::encode_near(scene.near).map(|view| (sections::VIEW, view)));
    container::write(&content, &[sections::VIEW])
}

/// Refuses widths of zero, which no array could be split by, and counts that the format cannot state.
fn check_counts(scene: &AnchorScene) -> Result<(), EncodeError> {
    let counts = [
        ("feature channels", scene.feature_dim, MAX_FEATURE_DIM),
        ("offsets per anchor", scene.offsets_per_anchor, MAX_OFFSETS),
        ("anchors", scene.len(), u32::MAX as usize),
    ];
    for (what, value, limit) in counts {
        if value == 0 {
            return Err(EncodeError::Empty);
        }
        if value > limit {
            return Err(EncodeError::TooLarge { what, value: value as u64, limit: limit as u64 });
        }
    }
    Ok(())
}

fn quantize_networks(scene: &AnchorScene) -> QuantizedNetworks {
    let _stage = tracing::debug_span!("networks").entered();
    let inputs = precision::sample_inputs(scene);
    QuantizedNetworks([
        precision::quantize(&scene.networks.opacity, Activation::Tanh, &inputs),
        precision::quantize(&scene.networks.covariance, Activation::Covariance, &inputs),
        precision::quantize(&scene.networks.color, Activation::Logistic, &inputs),
    ])
}
