//! What is encoded is what is decoded, and what cannot be encoded is refused with the reason.

use proptest::prelude::*;
use sha2::{Digest as _, Sha256};
use tcgs_codec::{
    DecodeError, DecodeLimits, EncodeError, EncodeSettings, decode, decode_digest,
    domain::{AnchorScene, Lattice},
    encode, inspect,
};

use super::{
    synthetic::{Recipe, scene, settings, small, tiny},
    wire,
};

/// Encodes, decodes and checks everything that must hold of any scene.
fn check(scene: &AnchorScene) {
    let settings = settings();
    let encoded = encode(scene, None, &settings).expect("encodes");
    let decoded = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes");
    assert_eq!(decoded.scene, encoded.scene);
    assert_eq!(decoded.decode_sha256, encoded.decode_sha256);
    assert_eq!(decode_digest(&decoded.scene), encoded.decode_sha256);
    assert_eq!(decoded.scene.check(), Ok(()));
    assert_eq!(decoded.manifest.provenance, settings.provenance);
    assert_eq!(decoded.manifest.background, settings.background);
    assert_eq!(decoded.scene.lattice, scene.lattice);

    let k = scene.offsets_per_anchor;
    let scaling_step = settings.scaling_step * scene.lattice.voxel;
    let mut seen = 0;
    for anchor in (0..scene.len()).filter(|anchor| scene.masks[anchor * k..(anchor + 1) * k].contains(&true))
    {
        let cell = scene.cells[anchor];
        let there = decoded.scene.cells.iter().position(|other| *other == cell).expect("the cell is kept");
        seen += 1;
        let pairs = |values: &[f32], back: &[f32], width: usize| -> Vec<(f32, f32)> {
            let value = values[anchor * width..(anchor + 1) * width].iter().copied();
            value.zip(back[there * width..(there + 1) * width].iter().copied()).collect()
        };
        for (value, back) in pairs(&scene.features, &decoded.scene.features, scene.feature_dim) {
            near(value, back, settings.feature_step);
        }
        for (value, back) in pairs(&scene.scalings, &decoded.scene.scalings, 6) {
            assert!(back > 0.0);
            near(value.max(scaling_step), back, scaling_step);
        }
        for (index, (value, back)) in
            pairs(&scene.offsets, &decoded.scene.offsets, 3 * k).into_iter().enumerate()
        {
            assert_eq!(scene.masks[anchor * k + index / 3], decoded.scene.masks[there * k + index / 3]);
            if scene.masks[anchor * k + index / 3] {
                near(value, back, settings.offset_step);
            } else {
                assert_eq!(back.to_bits(), 0, "an offset that is masked off decodes to zero");
            }
        }
    }
    assert_eq!(decoded.scene.len(), seen);

    let inspection = inspect(&encoded.bytes).expect("inspects");
    let mut end = 0;
    for range in &inspection.ranges {
        assert_eq!(range.offset, end, "a gap before {}", range.what);
        end += range.length;
    }
    assert_eq!(end, encoded.bytes.len() as u64);
    assert_eq!(inspection.byte_counts, encoded.byte_counts);
    let counts = &encoded.byte_counts;
    assert_eq!(counts.total, encoded.bytes.len() as u64);
    let parts = [
        counts.positions,
        counts.networks,
        counts.planes,
        counts.masks,
        counts.features,
        counts.scalings,
        counts.offsets,
        counts.container,
    ];
    assert_eq!(parts.iter().sum::<u64>(), counts.total);
}

/// Within half a step, with room for the roundings of f32 on large values.
fn near(value: f32, back: f32, step: f32) {
    let bound = 0.5 * step * 1.0001 + value.abs() * 1e-6;
    assert!((value - back).abs() <= bound, "{value} came back as {back} with step {step}");
}

#[test]
fn ordinary_scenes_come_back() {
    check(&tiny());
    check(&small());
    // More anchors than a chunk.
    check(&scene(Recipe { seed: 2, anchors: 4100, feature_dim: 3, offsets: 2, masked: 0.4 }));
}

/// The hash once more, from the documentation of [`decode_digest`].
#[test]
fn the_decode_hash_is_the_documented_one_for_many_runs_of_anchors() {
    let scene = scene(Recipe { seed: 4, anchors: 2 * 4096 + 3, feature_dim: 2, offsets: 2, masked: 0.3 });
    let floats = |hasher: &mut Sha256, values: &[f32]| {
        values.iter().for_each(|value| hasher.update(value.to_le_bytes()));
    };
    let mut hasher = Sha256::new();
    [scene.len(), 2, 2].iter().for_each(|count| hasher.update((*count as u64).to_le_bytes()));
    floats(&mut hasher, &[scene.lattice.voxel]);
    floats(&mut hasher, &scene.lattice.origin);
    for first in [0, 4096, 8192] {
        let run = first..scene.len().min(first + 4096);
        let of = |width: usize| run.start * width..run.end * width;
        let mut of_run = Sha256::new();
        scene.cells[of(1)].as_flattened().iter().for_each(|x| of_run.update(x.to_le_bytes()));
        floats(&mut of_run, &scene.features[of(2)]);
        floats(&mut of_run, &scene.scalings[of(6)]);
        floats(&mut of_run, &scene.offsets[of(6)]);
        scene.masks[of(2)].iter().for_each(|kept| of_run.update([u8::from(*kept)]));
        hasher.update(of_run.finalize());
    }
    for mlp in [&scene.networks.opacity, &scene.networks.covariance, &scene.networks.color] {
        hasher.update((mlp.layers.len() as u64).to_le_bytes());
        for layer in &mlp.layers {
            [layer.inputs, layer.outputs]
                .iter()
                .for_each(|count| hasher.update((*count as u64).to_le_bytes()));
            floats(&mut hasher, &layer.weights);
            floats(&mut hasher, &layer.bias);
        }
    }
    assert_eq!(decode_digest(&scene).as_bytes()[..], hasher.finalize()[..]);
}

#[test]
fn decoded_scenes_are_fixed_points() {
    let first = encode(&small(), None, &settings()).expect("encodes");
    let second = encode(&first.scene, None, &settings()).expect("encodes again");
    assert_eq!(second.scene.features, first.scene.features);
    assert_eq!(second.scene.cells, first.scene.cells);
    assert_eq!(second.scene.offsets, first.scene.offsets);
    assert_eq!(second.scene.scalings, first.scene.scalings);
    assert_eq!(second.scene.masks, first.scene.masks);
}

#[test]
fn bytes_and_scene_do_not_depend_on_the_number_of_threads() {
    let scene = scene(Recipe { seed: 3, anchors: 9000, feature_dim: 4, offsets: 2, masked: 0.2 });
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| encode(&scene, None, &settings()).expect("encodes"))
    };
    let (one, four) = (with(1), with(4));
    assert_eq!(one.bytes, four.bytes);
    assert_eq!(one.decode_sha256, four.decode_sha256);
}

#[test]
fn the_order_of_the_input_does_not_matter() {
    let scene = small();
    let mut reversed = scene.clone();
    let (f, k) = (scene.feature_dim, scene.offsets_per_anchor);
    reversed.cells.reverse();
    fn reverse<T: Clone>(values: &[T], width: usize) -> Vec<T> {
        values.chunks(width).rev().flatten().cloned().collect()
    }
    reversed.features = reverse(&scene.features, f);
    reversed.scalings = reverse(&scene.scalings, 6);
    reversed.offsets = reverse(&scene.offsets, 3 * k);
    reversed.masks = reverse(&scene.masks, k);
    let (a, b) = (encode(&scene, None, &settings()), encode(&reversed, None, &settings()));
    assert_eq!(a.expect("encodes").scene.features, b.expect("encodes").scene.features);
}

#[test]
fn a_background_is_kept() {
    for background in tcgs_codec::domain::Background::ALL {
        let settings = tcgs_codec::EncodeSettings { background, ..settings() };
        let encoded = encode(&tiny(), None, &settings).expect("encodes");
        let decoded = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes");
        assert_eq!(decoded.manifest.background, background);
    }
}

fn refusal(change: impl FnOnce(&mut AnchorScene)) -> EncodeError {
    let mut scene = small();
    change(&mut scene);
    encode(&scene, None, &settings()).expect_err("must be refused")
}

#[test]
fn what_cannot_be_written_is_refused_with_the_reason() {
    assert_eq!(refusal(|scene| scene.masks.fill(false)), EncodeError::Empty);
    assert!(matches!(refusal(|scene| scene.features[3] = f32::NAN), EncodeError::Shape(_)));
    assert!(matches!(refusal(|scene| scene.offsets[3] = f32::INFINITY), EncodeError::Shape(_)));
    assert!(matches!(refusal(|scene| scene.features.truncate(5)), EncodeError::Shape(_)));
    assert!(matches!(refusal(|scene| scene.networks.color.layers.clear()), EncodeError::Shape(_)));
    assert!(matches!(refusal(|scene| scene.cells[1] = scene.cells[0]), EncodeError::DuplicateCell { .. }));
    assert!(matches!(refusal(|scene| scene.cells[1] = [1 << 22; 3]), EncodeError::TooLarge { .. }));
    assert!(matches!(
        refusal(|scene| scene.features[0] = 1e9),
        EncodeError::OutOfRange { what: "features", index: 0, .. }
    ));
    assert!(matches!(
        refusal(|scene| scene.scalings[2] = -0.1),
        EncodeError::NegativeScaling { index: 2, .. }
    ));
    for voxel in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-40, f32::MAX] {
        let error = refusal(|scene| scene.lattice.voxel = voxel);
        assert!(matches!(error, EncodeError::Setting { .. }), "voxel {voxel}: {error}");
    }
    let error = refusal(|scene| scene.lattice.origin[1] = f32::NAN);
    assert!(matches!(error, EncodeError::Setting { name: "origin", .. }));
    let wrong = tcgs_codec::EncodeSettings { feature_step: 0.0, ..settings() };
    assert_eq!(
        encode(&small(), None, &wrong).expect_err("no step"),
        EncodeError::Setting { name: "feature step", value: 0.0 }
    );
    let (what, value, limit) = ("feature channels", 257, 256);
    assert_eq!(refusal(|scene| scene.feature_dim = 257), EncodeError::TooLarge { what, value, limit });
    let (what, value, limit) = ("offsets per anchor", 65, 64);
    assert_eq!(refusal(|scene| scene.offsets_per_anchor = 65), EncodeError::TooLarge { what, value, limit });
    // As many as the format has, but not as many as the scene has numbers for.
    assert!(matches!(refusal(|scene| scene.feature_dim = 256), EncodeError::Shape(_)));
    assert!(matches!(refusal(|scene| scene.offsets_per_anchor = 64), EncodeError::Shape(_)));
    let empty = scene(Recipe { seed: 1, anchors: 0, feature_dim: 2, offsets: 2, masked: 0.0 });
    assert_eq!(encode(&empty, None, &settings()).expect_err("no anchor"), EncodeError::Empty);
}

#[test]
fn steps_and_positions_are_usable_at_both_ends_of_their_range() {
    let with = |feature_step: f32, voxel: f32, origin: f32| {
        let mut scene = tiny();
        scene.features.fill(0.0);
        scene.scalings.fill(voxel);
        scene.lattice = Lattice { voxel, origin: [0.0, origin, 0.0] };
        let encoded = encode(&scene, None, &EncodeSettings { feature_step, ..settings() })?;
        Ok::<_, EncodeError>(encoded.scene.lattice.position([i32::MIN; 3]))
    };
    for (feature_step, voxel, origin) in [(1.4e-37, 3e-36, 0.0), (1.7e30, 1e29, 1e38), (1.0, 1.0, -f32::MAX)]
    {
        let position = with(feature_step, voxel, origin).expect("encodes");
        assert!(position.iter().all(|x| x.is_finite()), "{position:?}");
    }
    // Normal numbers whose finest step is not; finite ones whose coarsest value is not.
    for feature_step in [1.2e-38, 1.3e-37, 2e30, 1e31, 1e32] {
        let error = EncodeError::Setting { name: "feature step", value: feature_step };
        assert_eq!(with(feature_step, 0.01, 0.0), Err(error));
    }
    for origin in [3e38, -3e38] {
        assert_eq!(with(1.0, 1e29, origin), Err(EncodeError::Setting { name: "origin", value: origin }));
    }
}

#[test]
fn limits_are_kept() {
    let bytes = encode(&small(), None, &settings()).expect("encodes").bytes;
    let default = DecodeLimits::default();
    for limits in [
        DecodeLimits { max_anchors: 119, ..default },
        DecodeLimits { max_file_bytes: 100, ..default },
        DecodeLimits { max_memory_bytes: 1000, ..default },
    ] {
        assert!(matches!(decode(&bytes, &limits), Err(DecodeError::Limit { .. })), "{limits:?}");
    }
    assert!(decode(&bytes, &DecodeLimits { max_anchors: 120, ..default }).is_ok());
}

#[test]
fn sixteen_mebibytes_are_allowed_whatever_the_length_of_a_file() {
    let bytes = encode(&small(), None, &settings()).expect("encodes").bytes;
    let limits = DecodeLimits { max_expansion: 0, ..DecodeLimits::default() };
    assert!(decode(&bytes, &limits).is_ok());
    // The manifest's first varint: 100 000 anchors instead of 120.
    let mut parts = wire::parts(&bytes);
    assert_eq!(parts[0].2[0], 120);
    parts[0].2.splice(..1, [0xa0, 0x8d, 0x06]);
    let bytes = wire::file((1, 0), &parts);
    for max_expansion in [0, 7] {
        let error = decode(&bytes, &DecodeLimits { max_expansion, ..limits });
        let Err(DecodeError::Limit { limit, .. }) = error else { panic!("{error:?}") };
        assert_eq!(limit, (16 << 20) + max_expansion * bytes.len() as u64);
    }
}

#[test]
fn the_memory_limit_covers_every_array_of_an_anchor() {
    for (feature_dim, offsets) in [(2, 7), (16, 1), (5, 4)] {
        let scene = scene(Recipe { seed: 3, anchors: 50, feature_dim, offsets, masked: 0.0 });
        let bytes = encode(&scene, None, &settings()).expect("encodes").bytes;
        let error = decode(&bytes, &DecodeLimits { max_memory_bytes: 1, ..DecodeLimits::default() });
        let Err(DecodeError::Limit { value, limit: 1, .. }) = error else { panic!("{error:?}") };
        // A symbol and a float a value, a byte a mask, three coordinates.
        let arrays = 50 * (8 * (feature_dim + 6 + 3 * offsets) + offsets + 12) as u64;
        // Step indices, and a code, six neighbors and a family in two levels of the octree, whatever the widths are.
        let min = arrays + 50 * (3 + 2 * (8 + 6 * 4 + 1));
        assert!((min..=arrays + 50 * 100).contains(&value), "{value} bytes for arrays of {arrays}");
    }
}

#[test]
fn the_networks_give_nearly_the_same_colors() {
    let scene = scene(Recipe { seed: 8, anchors: 300, feature_dim: 32, offsets: 10, masked: 0.0 });
    let encoded = encode(&scene, None, &settings()).expect("encodes");
    let forward = |mlp: &tcgs_codec::domain::Mlp, feature: &[f32]| -> Vec<f32> {
        let mut values = feature.to_vec();
        values.extend([0.6, 0.0, 0.8, 0.5]);
        for (index, layer) in mlp.layers.iter().enumerate() {
            if index > 0 {
                values.iter_mut().for_each(|value| *value = value.max(0.0));
            }
            let row = |row: usize| {
                let weights = &layer.weights[row * layer.inputs..(row + 1) * layer.inputs];
                layer.bias[row] + weights.iter().zip(&values).map(|(w, x)| w * x).sum::<f32>()
            };
            values = (0..layer.outputs).map(row).collect();
        }
        values.iter().map(|value| 1.0 / (1.0 + (-value).exp())).collect()
    };
    let (mut square, mut count) = (0.0_f64, 0.0_f64);
    for feature in scene.features.chunks(32) {
        let exact = forward(&scene.networks.color, feature);
        let coded = forward(&encoded.scene.networks.color, feature);
        for (a, b) in exact.iter().zip(&coded) {
            square += f64::from(a - b).powi(2);
            count += 1.0;
        }
    }
    let error = (square / count).sqrt();
    assert!(error < 3.5e-3, "colors differ by {error} in the mean");
}

prop_compose! {
    fn any_scene()(
        seed in any::<u64>(),
        anchors in 1_usize..60,
        feature_dim in 1_usize..7,
        offsets in 1_usize..6,
        masked in 0.0..1.0_f64,
        huge in prop::collection::vec((any::<prop::sample::Index>(), -3e6_f32..3e6), 0..4),
        shift in prop::array::uniform3(-1_000_000_i32..1_000_000),
        dropped in prop::collection::vec(any::<prop::sample::Index>(), 0..20),
        constant in any::<bool>(),
    ) -> AnchorScene {
        let mut scene = scene(Recipe { seed, anchors, feature_dim, offsets, masked });
        for (index, value) in huge {
            *index.get_mut(&mut scene.offsets) = value;
        }
        for cell in &mut scene.cells {
            (0..3).for_each(|axis| cell[axis] += shift[axis]);
        }
        for index in dropped {
            // Every anchor but one may lose all of its offsets.
            let anchor = index.index(anchors);
            if anchor != 0 {
                scene.masks[anchor * offsets..(anchor + 1) * offsets].fill(false);
            }
        }
        if constant {
            scene.features.fill(4.0);
        }
        scene
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn any_scene_comes_back(scene in any_scene()) {
        check(&scene);
    }
}
