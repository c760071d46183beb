//! Contexts in the file: chosen where they pay, decoded to the same bits, refused where they are wrong.

use tcgs_codec::{
    ContextChoice, ContextSearch, ContextSettings, DecodeError, DecodeLimits, EncodeError, EncodeSettings,
    Encoded, GroupChoice, GroupCosts, RegressionSearch,
    context::neighbors,
    decode,
    domain::{ContextCandidates, ContextKind, DenseLayer, Mlp, PlaneContext, Planes},
    efficiency, encode, inspect,
};

use super::{
    dependent::{Dependent, KINDS, UNIT_FRAME, dependent, predictions},
    fixtures::fixed,
    synthetic::{Recipe, scene, settings},
    wire,
};

fn recipe(anchors: usize) -> Recipe {
    Recipe { seed: 31, anchors, feature_dim: 12, offsets: 4, masked: 0.3 }
}

fn kinds(encoded: &Encoded) -> [Option<ContextKind>; 3] {
    encoded.context.groups.map(|group| match group {
        GroupChoice::Static => None,
        GroupChoice::Network { kind, .. } => Some(kind),
    })
}

/// Everything that must hold of a file with contexts.
fn check(encoded: &Encoded) {
    let decoded = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes");
    assert_eq!(decoded.scene, encoded.scene);
    assert_eq!(decoded.manifest.contexts.map(|context| context.kind), kinds(encoded));
    let inspection = inspect(&encoded.bytes).expect("inspects");
    let mut end = 0;
    for range in &inspection.ranges {
        assert_eq!(range.offset, end, "a gap before {}", range.what);
        end += range.length;
    }
    assert_eq!(end, encoded.bytes.len() as u64);
    let counts = &inspection.byte_counts;
    assert_eq!(counts.parts().iter().map(|(_, bytes)| bytes).sum::<u64>(), counts.total);
    let samples = kinds(encoded).iter().flatten().any(|kind| kind.sampled() > 0);
    assert_eq!(counts.planes > 0, samples);
    assert_eq!(inspection.sections.iter().any(|section| section.name == "planes"), samples);
    let context = inspection.sections.iter().any(|section| section.name == "context");
    assert_eq!(context, kinds(encoded).iter().any(Option::is_some));
}

#[test]
fn the_networks_that_the_attributes_come_from_are_found_and_pay() {
    let Dependent { scene, candidates } = dependent(recipe(1500));
    let encoded = encode(&scene, Some(&candidates), &settings()).expect("encodes");
    check(&encoded);
    assert_eq!(kinds(&encoded), KINDS.map(Some));
    assert_eq!(encoded.context.planes, Some(0));
    let without = encode(&scene, None, &settings()).expect("encodes");
    assert!(encoded.bytes.len() < without.bytes.len() * 9 / 10);

    let manifest = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes").manifest;
    for (context, kind) in manifest.contexts.iter().zip(KINDS) {
        let costs = context.bytes;
        let all = [costs.tables, costs.position, costs.tri_plane, costs.tri_plane_knn];
        assert!(all.iter().all(Option::is_some), "every kind was tried: {costs:?}");
        let chosen = match kind {
            ContextKind::Position => costs.position,
            ContextKind::TriPlane => costs.tri_plane,
            ContextKind::TriPlaneKnn => costs.tri_plane_knn,
        };
        assert_eq!(chosen, all.into_iter().min().flatten());
    }
    let text = inspect(&encoded.bytes).expect("inspects").to_string();
    for (column, kind) in [("features", "and neighbors"), ("scalings", "tri-plane"), ("offsets", "position")]
    {
        let line = text.lines().find(|line| line.starts_with(column) && line.contains(kind));
        assert!(line.is_some(), "{text}");
    }
}

#[test]
fn listed_costs_are_the_bytes_of_the_real_files() {
    let Dependent { scene, candidates } = dependent(recipe(300));
    let tables = encode(&scene, Some(&candidates), &fixed([None; 3], None)).expect("encodes");
    let manifest = |encoded: &Encoded| decode(&encoded.bytes, &DecodeLimits::NONE).expect("decodes").manifest;
    let costs = manifest(&tables).contexts.map(|context| context.bytes.tables.expect("was coded"));
    let counts = &tables.byte_counts;
    assert_eq!(costs, [counts.features, counts.scalings, counts.offsets]);
    let networks = encode(&scene, Some(&candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes");
    let costs = manifest(&networks).contexts.map(|context| context.bytes);
    let sum: u64 =
        [costs[0].tri_plane_knn, costs[1].tri_plane, costs[2].position].into_iter().flatten().sum();
    let counts = &networks.byte_counts;
    let frame = inspect(&networks.bytes).expect("inspects");
    let frame = frame.ranges.iter().find(|range| range.what.starts_with("frame of")).expect("a frame").length;
    let context = counts.networks - tables.byte_counts.networks - frame;
    assert_eq!(sum, counts.features + counts.scalings + counts.offsets + context);
}

#[test]
fn of_every_kind_the_cheapest_width_is_found() {
    let Dependent { scene, candidates } = dependent(recipe(24));
    let costs = |search: ContextSearch| {
        let context = ContextSettings { search, regression: RegressionSearch::Never, coarser: [0; 3] };
        let encoded = encode(&scene, Some(&candidates), &EncodeSettings { context, ..settings() });
        let bytes = encoded.expect("encodes").bytes;
        let manifest = decode(&bytes, &DecodeLimits::NONE).expect("decodes").manifest;
        (bytes.len(), manifest.contexts.map(|context| context.bytes))
    };
    let (length, cheapest) = costs(ContextSearch::Cheapest);
    for kind in [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn] {
        let of_kind = |costs: [GroupCosts; 3]| {
            costs.map(|costs| match kind {
                ContextKind::Position => costs.position,
                ContextKind::TriPlane => costs.tri_plane,
                ContextKind::TriPlaneKnn => costs.tri_plane_knn,
            })
        };
        let mut min = [u64::MAX; 3];
        for weight_bits in [8, 6, 4] {
            let groups = [GroupChoice::Network { kind, weight_bits }; 3];
            let (other, costs) = costs(ContextSearch::Fixed(ContextChoice { planes: Some(0), groups }));
            assert!(length <= other, "{length} bytes, {other} with {kind:?} of {weight_bits} bits");
            for (min, cost) in min.iter_mut().zip(of_kind(costs)) {
                *min = (*min).min(cost.expect("was coded"));
            }
        }
        assert_eq!(of_kind(cheapest), min.map(Some), "{kind:?}");
    }
}

#[test]
fn every_kind_and_width_comes_back_in_every_group() {
    let Dependent { scene, candidates } = dependent(recipe(60));
    for kind in [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn] {
        for group in 0..3 {
            for weight_bits in 2..=8 {
                let mut choice = ContextChoice { planes: Some(0), groups: [GroupChoice::Static; 3] };
                choice.groups[group] = GroupChoice::Network { kind, weight_bits };
                let search = ContextSearch::Fixed(choice);
                let context = ContextSettings { search, ..ContextSettings::default() };
                let settings = EncodeSettings { context, ..settings() };
                let encoded = encode(&scene, Some(&candidates), &settings).expect("encodes");
                check(&encoded);
                assert_eq!(encoded.context.groups, choice.groups);
            }
        }
    }
}

/// A small scene has no use for large planes, whatever training made of them.
#[test]
fn two_thousand_anchors_do_not_carry_a_plane_of_fifty_channels() {
    let scene = scene(Recipe { seed: 3, anchors: 2000, feature_dim: 16, offsets: 4, masked: 0.3 });
    let (edge, channels) = (32, 50);
    let latents = (0..3 * channels * edge * edge).map(|i| ((i * 7919 % 257) as f32 - 128.0) / 20.0).collect();
    let network = |inputs: usize, width: usize| {
        let layer = |inputs: usize, outputs: usize| DenseLayer {
            inputs,
            outputs,
            weights: (0..inputs * outputs).map(|i| ((i * 31 % 61) as f32 - 30.0) / 400.0).collect(),
            bias: vec![0.1; outputs],
        };
        Some(Mlp { layers: vec![layer(inputs, 32), layer(32, 2 * width + 1)] })
    };
    let widths = [16, 6, 12];
    let planes = Planes { edge, channels, latents, layers: Vec::new() };
    let set = PlaneContext {
        own: widths.map(|width| network(ContextKind::TriPlane.inputs(channels), width)),
        neighbors: [None, None, None],
        planes,
    };
    let candidates = ContextCandidates {
        frame: UNIT_FRAME,
        static_steps: [0.0; 3],
        position: [None, None, None],
        planes: vec![set],
    };
    let encoded = encode(&scene, Some(&candidates), &settings()).expect("encodes");
    check(&encoded);
    assert_eq!(encoded.byte_counts.planes, 0);
    assert_eq!(encoded.context, ContextChoice::STATIC);
    let without = encode(&scene, None, &settings()).expect("encodes");
    assert!(encoded.bytes.len() <= without.bytes.len() + 10, "only the list of costs is longer");
}

#[test]
fn coarser_steps_save_bytes_whatever_predicts() {
    let Dependent { scene, candidates } = dependent(recipe(200));
    for groups in [[None; 3], KINDS.map(Some)] {
        let size = |coarser: i8| {
            let mut settings = fixed(groups, Some(0));
            settings.context.coarser = [coarser; 3];
            let encoded = encode(&scene, Some(&candidates), &settings).expect("encodes");
            check(&encoded);
            encoded.bytes.len()
        };
        let sizes = [-6, 0, 4, 8, 12].map(size);
        assert!(sizes.windows(2).all(|pair| pair[1] < pair[0]), "{sizes:?}");
    }
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let Dependent { scene, candidates } = dependent(recipe(5000));
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| encode(&scene, Some(&candidates), &settings()).expect("encodes"))
    };
    let (one, three) = (with(1), with(3));
    assert!(one.bytes == three.bytes && one.context == three.context);
    check(&one);
}

#[test]
fn candidates_that_do_not_fit_are_refused() {
    let dependent = dependent(recipe(20));
    let refused = |change: fn(&mut ContextCandidates)| {
        let mut candidates = dependent.candidates.clone();
        change(&mut candidates);
        let error = encode(&dependent.scene, Some(&candidates), &settings()).expect_err("must be refused");
        assert!(matches!(error, EncodeError::Candidate { .. }), "{error}");
    };
    refused(|candidates| candidates.frame.half[1] = 0);
    refused(|candidates| candidates.position.swap(0, 1));
    refused(|candidates| candidates.planes[0].planes.channels = 3);
    refused(|candidates| candidates.planes[0].own.swap(0, 1));
    refused(|candidates| candidates.position[0].as_mut().expect("there").layers.clear());
    refused(|candidates| candidates.planes[0].planes.latents[0] = f32::NAN);
    for (groups, planes) in [(KINDS.map(Some), None), (KINDS.map(Some), Some(1))] {
        let error = encode(&dependent.scene, Some(&dependent.candidates), &fixed(groups, planes));
        assert!(matches!(error, Err(EncodeError::Candidate { .. })));
    }
    let error = encode(&dependent.scene, None, &fixed(KINDS.map(Some), Some(0)));
    assert!(matches!(error, Err(EncodeError::Candidate { .. })));
}

#[test]
fn sections_must_be_there_where_they_are_needed_and_only_there() {
    let Dependent { scene, candidates } = dependent(recipe(40));
    let with = encode(&scene, Some(&candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes").bytes;
    let without = encode(&scene, None, &settings()).expect("encodes").bytes;
    let context = wire::parts(&with).into_iter().filter(|part| [*b"CTXT", *b"PLAN"].contains(&part.0));
    let context: Vec<wire::Part> = context.collect();
    assert_eq!(context.len(), 2);
    for part in &context {
        let mut lacking = wire::parts(&with);
        lacking.retain(|other| other.0 != part.0);
        let bytes = wire::file((1, 0), &lacking);
        let error = decode(&bytes, &DecodeLimits::NONE).expect_err("must be refused");
        assert!(matches!(error, DecodeError::MissingSection { .. }), "{error}");
        assert_eq!(inspect(&bytes).expect_err("must be refused"), error);
        let mut needless = wire::parts(&without);
        needless.push(part.clone());
        let bytes = wire::file((1, 0), &needless);
        let error = decode(&bytes, &DecodeLimits::NONE).expect_err("must be refused");
        assert!(matches!(error, DecodeError::NeedlessSection { .. }), "{error}");
        assert_eq!(inspect(&bytes).expect_err("must be refused"), error);
    }
}

#[test]
fn memory_of_planes_and_contexts_is_limited() {
    let Dependent { scene, candidates } = dependent(recipe(200));
    let bytes = encode(&scene, Some(&candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes").bytes;
    let limits = DecodeLimits::default();
    for max_memory_bytes in [10, 1000, 10_000] {
        let error = decode(&bytes, &DecodeLimits { max_memory_bytes, ..limits });
        assert!(matches!(error, Err(DecodeError::Limit { .. })), "{max_memory_bytes}: {error:?}");
    }
    assert!(decode(&bytes, &limits).is_ok());
}

#[test]
fn the_memory_limit_covers_the_inputs_of_every_anchor() {
    let scene = scene(Recipe { seed: 3, anchors: 50, feature_dim: 1, offsets: 1, masked: 0.0 });
    for (kind, channels) in [(ContextKind::TriPlane, 100), (ContextKind::TriPlaneKnn, 40)] {
        let inputs = kind.inputs(channels);
        let layer = DenseLayer { inputs, outputs: 3, weights: vec![0.01; 3 * inputs], bias: vec![0.5; 3] };
        let network = [Some(Mlp { layers: vec![layer] }), None, None];
        let none = [None, None, None];
        let (own, neighbors) =
            if kind == ContextKind::TriPlane { (network, none.clone()) } else { (none.clone(), network) };
        let planes = Planes { edge: 1, channels, latents: vec![0.5; 3 * channels], layers: Vec::new() };
        let candidates = ContextCandidates {
            frame: UNIT_FRAME,
            static_steps: [0.0; 3],
            position: none,
            planes: vec![PlaneContext { planes, own, neighbors }],
        };
        let settings = fixed([Some(kind), None, None], Some(0));
        let bytes = encode(&scene, Some(&candidates), &settings).expect("encodes").bytes;
        // As much as attributes, planes and networks take, of which none takes as much as the inputs.
        let limits = DecodeLimits { max_memory_bytes: 11_000, ..DecodeLimits::default() };
        let error = decode(&bytes, &limits);
        let Err(DecodeError::Limit { what, value, .. }) = error else { panic!("{kind:?}: {error:?}") };
        assert_eq!(what, "bytes of memory for the context");
        // Three coordinates, and a sample of all three planes.
        let mut inputs = 12 + 2 * 3 * channels as u64;
        if kind == ContextKind::TriPlaneKnn {
            // Four neighbors by rank and by index, and the cells in their order.
            inputs += 2 * 16 + 12;
        }
        assert!((50 * inputs..=50 * (inputs + 40)).contains(&value), "{value} bytes, {inputs} an anchor");
    }
}

/// Anchors that fill a cube, and networks as wide as they come, without a weight: few bytes, and hours of arithmetic if it
/// were done.
#[test]
fn small_files_that_ask_for_hours_are_refused() {
    let edge = 85;
    let cells: Vec<[i32; 3]> =
        (0..edge * edge * edge).map(|i| [i % edge, i / edge % edge, i / edge / edge]).collect();
    let count = cells.len();
    let scene = tcgs_codec::domain::AnchorScene {
        cells,
        features: vec![0.0; count],
        scalings: vec![0.01; 6 * count],
        offsets: vec![0.0; 3 * count],
        masks: vec![true; count],
        ..scene(Recipe { seed: 1, anchors: 1, feature_dim: 1, offsets: 1, masked: 0.0 })
    };
    let network = |widths: &[usize]| {
        let layer = |pair: &[usize]| DenseLayer {
            inputs: pair[0],
            outputs: pair[1],
            weights: vec![0.0; pair[0] * pair[1]],
            bias: vec![0.0; pair[1]],
        };
        Mlp { layers: widths.windows(2).map(layer).collect() }
    };
    let candidates = |widths: &[usize]| ContextCandidates {
        frame: UNIT_FRAME,
        static_steps: [0.0; 3],
        position: [Some(network(widths)), None, None],
        planes: Vec::new(),
    };
    let settings = fixed([Some(ContextKind::Position), None, None], None);
    let error = encode(&scene, Some(&candidates(&[18, 512, 512, 512, 3])), &settings);
    assert!(matches!(error, Err(EncodeError::Candidate { .. })));

    let bytes = encode(&scene, Some(&candidates(&[18, 3])), &settings).expect("encodes").bytes;
    let mut parts = wire::parts(&bytes);
    let context = parts.iter_mut().find(|part| part.0 == *b"CTXT").expect("has a network");
    // The frame takes a byte a number; then a length, eight bits a weight, four layers, and all constants of zero.
    let zeros = [0, 64].repeat(3);
    let wide = [&[0x80, 0x04], &zeros[..]].concat();
    let mlp = [&[8, 4], &wide[..], &wide, &wide, &[3], &zeros].concat();
    context.2.truncate(6);
    context.2.push(mlp.len() as u8);
    context.2.extend(mlp);
    let bytes = wire::file((1, 0), &parts);
    assert!(bytes.len() < 200_000, "{}", bytes.len());
    let error = decode(&bytes, &DecodeLimits::NONE).expect_err("must be refused").to_string();
    assert!(error.contains("multiplications"), "{error}");
}

/// Bits of a symbol by a normal distribution, in the tail with the smaller cancellation.
fn bits(symbol: f64, mean: f64, sigma: f64) -> f64 {
    let cumulative = |x: f64| 0.5 * libm::erfc(-x / sigma / std::f64::consts::SQRT_2);
    let distance = (symbol - mean).abs();
    -(cumulative(0.5 - distance) - cumulative(-0.5 - distance)).max(1e-30).log2()
}

/// The integer network, its inputs, planes and tables against floats all the way: at most one percent.
#[test]
fn integers_cost_less_than_one_percent_more_than_floats() {
    let Dependent { scene, candidates } = dependent(recipe(1200));
    let encoded = encode(&scene, Some(&candidates), &fixed(KINDS.map(Some), Some(0))).expect("encodes");
    let decoded = &encoded.scene;
    let settings = settings();
    let bases = [settings.feature_step, settings.scaling_step * scene.lattice.voxel, settings.offset_step];
    let counts = &encoded.byte_counts;
    let coded = [counts.features, counts.scalings, counts.offsets];
    assert_eq!(neighbors(&decoded.cells).len(), decoded.len());
    let measured = efficiency(&encoded.bytes, &DecodeLimits::NONE, Some((&candidates, &encoded.context)));
    let measured = measured.expect("decodes");
    for (group, kind) in KINDS.into_iter().enumerate() {
        let values = [&decoded.features, &decoded.scalings, &decoded.offsets][group];
        let predictions = predictions(&decoded.cells, &candidates, group, kind);
        let width = values.len() / decoded.len();
        let mut float_bits = 0.0;
        for (anchor, prediction) in predictions.iter().enumerate() {
            // The step that floats would choose, from the same table.
            let octaves = (prediction.adjustment * 32.0 / 7.0).round().clamp(-16.0, 16.0) * 7.0 / 32.0;
            let step = f64::from(bases[group]) * libm::exp2(octaves);
            for channel in 0..width {
                let kept = group < 2 || decoded.masks[anchor * scene.offsets_per_anchor + channel / 3];
                if kept {
                    let symbol = (f64::from(values[anchor * width + channel]) / step).round();
                    let scale = libm::exp2(-octaves);
                    let mean = prediction.means[channel] * scale;
                    let sigma = libm::exp2(prediction.log_deviations[channel]) * scale;
                    float_bits += bits(symbol, mean, sigma);
                }
            }
        }
        let of_codec = measured.network_bits[group].expect("has a network").floats;
        assert!((of_codec / float_bits - 1.0).abs() < 0.002, "{of_codec} bits, here {float_bits}");
        assert_eq!(measured.bytes[group], coded[group]);
        let ratio = coded[group] as f64 * 8.0 / float_bits;
        println!("{kind:?}: {ratio:.5} of the float network's bits");
        assert!(ratio < 1.01, "{kind:?}: {ratio}");
    }
    let over_floats = measured.over_floats().expect("has networks");
    assert!((0.99..1.01).contains(&over_floats), "{over_floats}");
}

/// What the coder adds to the information in the symbols by their own tables: ends of streams, counts of 2^-24.
#[test]
fn attributes_take_no_more_than_half_a_percent_over_their_tables() {
    let Dependent { scene, candidates } = dependent(recipe(3000));
    for groups in [[None; 3], KINDS.map(Some)] {
        let encoded = encode(&scene, Some(&candidates), &fixed(groups, Some(0))).expect("encodes");
        let measured = efficiency(&encoded.bytes, &DecodeLimits::NONE, None).expect("decodes");
        println!("{groups:?}: {:.5} of the ideal", measured.entropy_overhead());
        assert!((0.999..1.005).contains(&measured.entropy_overhead()), "{measured:?}");
        assert_eq!(measured.over_floats(), None);
    }
}
