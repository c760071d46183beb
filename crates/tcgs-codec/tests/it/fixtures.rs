//! How the golden files and the first files of the fuzzing corpus are made: by the tests that hold the encoder to them, and by
//! `examples/fixtures.rs`, which writes them into a folder.

use tcgs_codec::{
    ContextChoice, ContextSearch, ContextSettings, EncodeSettings, Encoded, GroupChoice, RegressionSearch,
    domain::{AnchorScene, ContextKind, NearPlane, Planes, SceneScale, ViewDegree},
    encode,
};

use super::{
    dependent::{KINDS, dependent},
    synthetic::{Normal, Recipe, networks, related, scene, settings, tiny},
    wire,
};

/// Makes a golden file.
type Maker = fn() -> Encoded;

/// Name and maker of every golden file but the trained one.
pub(super) const GOLDENS: [(&str, Maker); 7] = [
    ("shell_v1.tcgs", shell),
    ("context_v1.tcgs", context),
    ("direct_v1.tcgs", direct),
    ("unit_v1.tcgs", scene_scale),
    ("regression_v1.tcgs", regression),
    ("regressions_v1.tcgs", regressions),
    ("harmonics_v1.tcgs", harmonics),
];

/// That of the file that has one, in world units.
pub(super) const UNIT: f32 = 0.0025;

/// Settings with one choice of contexts, without regressions.
pub(super) fn fixed(groups: [Option<ContextKind>; 3], planes: Option<usize>) -> EncodeSettings {
    let group = |kind: Option<ContextKind>| {
        kind.map_or(GroupChoice::Static, |kind| GroupChoice::Network { kind, weight_bits: 8 })
    };
    let choice = ContextChoice { planes, groups: groups.map(group) };
    let (search, regression) = (ContextSearch::Fixed(choice), RegressionSearch::Never);
    EncodeSettings { context: ContextSettings { search, regression, coarser: [0; 3] }, ..settings() }
}

/// Tables for every group; masks, dropped anchors, escapes, a constant channel, negative cells.
fn shell() -> Encoded {
    let mut scene: AnchorScene =
        scene(Recipe { seed: 2024, anchors: 400, feature_dim: 8, offsets: 4, masked: 0.35 });
    scene.masks[40..44].fill(false);
    scene.offsets[100] = 12_345.6;
    scene.offsets[101] = -7.0e5;
    scene.features.iter_mut().skip(3).step_by(8).for_each(|value| *value = 2.0);
    encode(&scene, None, &settings()).expect("encodes")
}

/// A network of another kind for each group, and planes with an up-sampling layer.
fn context() -> Encoded {
    let recipe = Recipe { seed: 2025, anchors: 90, feature_dim: 5, offsets: 2, masked: 0.3 };
    let dependent = dependent(recipe);
    encode(&dependent.scene, Some(&dependent.candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes")
}

/// Planes that are stored as they are, and a near plane of its own.
fn direct() -> Encoded {
    let recipe = Recipe { seed: 2026, anchors: 60, feature_dim: 5, offsets: 2, masked: 0.3 };
    let mut dependent = dependent(recipe);
    let planes = &mut dependent.candidates.planes[0].planes;
    let (edge, channels) = (planes.plane_edge(), planes.plane_channels());
    let wave = |index: usize| ((index * 37 % 101) as f32 - 50.0) / 16.0;
    let latents = (0..3 * channels * edge * edge).map(wave).collect();
    *planes = Planes { edge, channels, latents, layers: Vec::new() };
    dependent.scene.near = NearPlane::new(0.0125).expect("a depth");
    encode(&dependent.scene, Some(&dependent.candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes")
}

/// Networks whose distances are in a unit of the scene's own.
fn scene_scale() -> Encoded {
    let scene = scene(Recipe { seed: 2027, anchors: 40, feature_dim: 4, offsets: 2, masked: 0.3 });
    let scene_scale = SceneScale::new(UNIT).expect("a length");
    encode(&AnchorScene { scene_scale, ..scene }, None, &settings()).expect("encodes")
}

/// Tables for every group, a constant channel, and a regression of the scalings alone.
fn regression() -> Encoded {
    let recipe = Recipe { seed: 2028, anchors: 120, feature_dim: 4, offsets: 2, masked: 0.3 };
    let mut scene = scene(recipe);
    scene.scalings = related(recipe).scalings;
    scene.scalings.iter_mut().skip(2).step_by(6).for_each(|scaling| *scaling = 0.5);
    encode(&scene, None, &settings()).expect("encodes")
}

/// A regression of every group beside networks of positions, with masked offsets.
fn regressions() -> Encoded {
    let recipe = Recipe { seed: 2029, anchors: 150, feature_dim: 4, offsets: 3, masked: 0.4 };
    let candidates = dependent(recipe).candidates;
    let mut settings = fixed([Some(ContextKind::Position); 3], None);
    settings.context.regression = RegressionSearch::WhereItPays;
    encode(&related(recipe), Some(&candidates), &settings).expect("encodes")
}

/// Networks that get harmonics of the view direction, of degrees 2 and 3.
fn harmonics() -> Encoded {
    let (feature_dim, offsets) = (4, 2);
    let mut scene = scene(Recipe { seed: 2030, anchors: 40, feature_dim, offsets, masked: 0.3 });
    let inputs = feature_dim + ViewDegree::MAX.inputs();
    scene.networks = networks(&mut Normal::new(2032), [inputs, feature_dim, offsets]);
    encode(&scene, None, &settings()).expect("encodes")
}

/// Three anchors with every section and every kind of context.
pub(super) fn tiny_context_file() -> Vec<u8> {
    let tiny = dependent(Recipe { seed: 9, anchors: 3, feature_dim: 1, offsets: 1, masked: 0.0 });
    let settings = fixed(KINDS.map(Some), Some(0));
    encode(&tiny.scene, Some(&tiny.candidates), &settings).expect("encodes").bytes
}

/// A file as the target of headers is given it: two bytes of version, then each section's place in its list of ids,
/// length and content.
fn described(file: &[u8]) -> Option<Vec<u8>> {
    const IDS: [&[u8; 4]; 7] = [b"MANI", b"NETS", b"CELL", b"MASK", b"ATTR", b"CTXT", b"PLAN"];
    let mut bytes = vec![0, 0];
    for (id, _, content) in wire::parts(file) {
        bytes.push(IDS.iter().position(|known| **known == id)? as u8);
        bytes.push(u8::try_from(content.len()).ok().filter(|length| *length < 255)?);
        bytes.extend(content);
    }
    Some(bytes)
}

/// Target, name and content of each file that fuzzing began with; what it finds is added by hand.
pub(super) fn corpus() -> Vec<(&'static str, String, Vec<u8>)> {
    let mut files = vec![encode(&tiny(), None, &settings()).expect("encodes").bytes];
    for seed in 0..8 {
        let scale = seed as usize;
        let recipe = Recipe {
            seed,
            anchors: 1 + 5 * scale,
            feature_dim: 1 + scale % 3,
            offsets: 1 + scale % 4,
            masked: 0.1 * seed as f64,
        };
        files.push(encode(&scene(recipe), None, &settings()).expect("encodes").bytes);
    }
    // The order that the committed files are numbered in.
    let (first, later) = GOLDENS.split_at(4);
    files.extend(first.iter().map(|(_, make)| make().bytes));
    files.push(tiny_context_file());
    files.extend(later.iter().map(|(_, make)| make().bytes));
    let mut corpus = Vec::new();
    for (number, file) in files.iter().enumerate() {
        corpus.push(("decode", format!("file-{number:02}"), file.clone()));
        corpus.push(("decode", format!("cut-{number:02}"), file[..file.len() * 2 / 3].to_vec()));
        if let Some(bytes) = described(file) {
            corpus.push(("decode_header", format!("cut-{number:02}"), bytes[..bytes.len() / 2].to_vec()));
            corpus.push(("decode_header", format!("file-{number:02}"), bytes));
        }
    }
    let mut state = 1_u64;
    for number in 0..12_usize {
        let bytes: Vec<u8> = (0..40 + 150 * number)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect();
        corpus.push(("decode_header", format!("noise-{number:02}"), bytes[..bytes.len().min(200)].to_vec()));
        corpus.push(("roundtrip", format!("noise-{number:02}"), bytes));
    }
    corpus
}
