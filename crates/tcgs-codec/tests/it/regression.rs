//! Regressions within an anchor: used where they save bytes, decoded to the same bits, refused where they are wrong.

use tcgs_codec::{
    ContextSettings, DecodeLimits, EncodeSettings, RegressionSearch, decode, efficiency, encode, inspect,
};

use super::{
    fixtures::GOLDENS,
    synthetic::{Recipe, related, scene, settings},
    wire,
};

const RECIPE: Recipe = Recipe { seed: 77, anchors: 5000, feature_dim: 6, offsets: 2, masked: 0.3 };

fn without() -> EncodeSettings {
    let context = ContextSettings { regression: RegressionSearch::Never, ..ContextSettings::default() };
    EncodeSettings { context, ..settings() }
}

fn ids(bytes: &[u8]) -> Vec<[u8; 4]> {
    wire::parts(bytes).iter().map(|part| part.0).collect()
}

fn golden(name: &str) -> Vec<u8> {
    let (_, make) = GOLDENS.into_iter().find(|golden| golden.0 == name).expect("a golden file");
    make().bytes
}

#[test]
fn channels_that_follow_from_each_other_take_fewer_bytes_for_the_same_scene() {
    let scene = related(RECIPE);
    let with = encode(&scene, None, &settings()).expect("encodes");
    let plain = encode(&scene, None, &without()).expect("encodes");
    assert_eq!(with.scene, plain.scene);
    assert_eq!(with.decode_sha256, plain.decode_sha256);
    assert!(with.bytes.len() < plain.bytes.len() * 3 / 4, "{} of {}", with.bytes.len(), plain.bytes.len());
    // Two chunks: each decodes alone, from residuals of its own anchors.
    assert_eq!(decode(&with.bytes, &DecodeLimits::default()).expect("decodes").scene, plain.scene);

    // The entropies that the recipe has, per symbol beyond the first of an anchor: a tenth of the size, 0.8 of a step of features,
    // 0.2 units in steps of 0.2 of offsets.
    let symbols = 5000.0 * 5.0;
    let bytes = with.byte_counts.features as f64 * 8.0;
    let first = 5000.0 * (0.5 * libm::log2(std::f64::consts::TAU * std::f64::consts::E) + libm::log2(6.1));
    // A feature given the k before it: the common part is known to 0.8 / sqrt(k).
    let later = |k: f64| {
        let sigma = libm::sqrt(0.64 + 0.64 / k + 1.0 / 12.0);
        0.5 * libm::log2(std::f64::consts::TAU * std::f64::consts::E) + libm::log2(sigma)
    };
    let ideal = first + 5000.0 * (1..=5).map(|k| later(f64::from(k))).sum::<f64>();
    assert!(bytes < ideal + 0.1 * symbols, "{} bits a feature, at best {}", bytes / symbols, ideal / symbols);
}

#[test]
fn channels_that_are_independent_get_none_and_files_stay_of_the_first_version() {
    let scene = scene(RECIPE);
    let encoded = encode(&scene, None, &settings()).expect("encodes");
    assert_eq!(encoded.bytes, encode(&scene, None, &without()).expect("encodes").bytes);
    assert!(!ids(&encoded.bytes).contains(b"REGR"));
    assert_eq!(inspect(&encoded.bytes).expect("inspects").version, "1.0");
}

#[test]
fn a_file_says_what_its_regressions_are_and_save() {
    let bytes = golden("regression_v1.tcgs");
    let inspection = inspect(&bytes).expect("inspects");
    assert_eq!(inspection.version, "1.1");
    assert_eq!(ids(&bytes)[4..], [*b"REGR", *b"ATTR"]);
    let [None, Some(scalings), None] = inspection.regressions else {
        panic!("{:?}", inspection.regressions);
    };
    let section = inspection.sections.iter().find(|section| section.name == "regression").expect("has one");
    assert_eq!(scalings, inspection.byte_counts.scalings + section.length - 1, "tables have no network");
    assert!(scalings < inspection.manifest.contexts[1].bytes.tables.expect("was tried"));
    let choices: Vec<&str> = inspection.choices.iter().map(|choice| &choice.value[..]).collect();
    let tables = "tables: position no, planes no, neighbors no, regression";
    assert_eq!(
        choices[choices.len() - 3..],
        [format!("{tables} no"), format!("{tables} yes"), format!("{tables} no")]
    );
    let text = inspection.to_string();
    let line = text.lines().find(|line| line.starts_with("scalings ") && line.contains("tables"));
    assert!(line.is_some_and(|line| line.ends_with(&format!(" {scalings}"))), "{text}");

    let bytes = golden("regressions_v1.tcgs");
    let inspection = inspect(&bytes).expect("inspects");
    let positions = inspection.manifest.contexts.map(|context| context.bytes.position.expect("is used"));
    for (with, without) in inspection.regressions.into_iter().zip(positions) {
        assert!(with.expect("every group has one") < without, "{with:?} for {without}");
    }
    let places: Vec<u64> = inspection.ranges.iter().map(|range| range.offset + range.length).collect();
    assert!(places.is_sorted() && places.last() == Some(&(bytes.len() as u64)));
    assert_eq!(inspection.byte_counts.parts().iter().map(|part| part.1).sum::<u64>(), bytes.len() as u64);
}

#[test]
fn the_coder_is_as_close_to_the_entropy_as_without() {
    let bytes = encode(&related(RECIPE), None, &settings()).expect("encodes").bytes;
    let overhead = efficiency(&bytes, &DecodeLimits::default(), None).expect("measures").entropy_overhead();
    assert!((1.0..1.005).contains(&overhead), "{overhead}");
}

/// A file whose regression section is another.
fn with_section(content: Vec<u8>) -> Vec<u8> {
    let mut parts = wire::parts(&golden("regression_v1.tcgs"));
    let section = parts.iter_mut().find(|part| &part.0 == b"REGR").expect("has one");
    section.2 = content;
    wire::file((1, 1), &parts)
}

#[test]
fn sections_that_the_format_does_not_allow_are_refused() {
    let limits = DecodeLimits::default();
    let valid = wire::parts(&golden("regression_v1.tcgs")).swap_remove(4).2;
    assert!(decode(&with_section(valid.clone()), &limits).is_ok());
    let mut longer = valid.clone();
    longer.push(0);
    let shorter = valid[..valid.len() - 1].to_vec();
    // A factor of 2^15 + 1 in the first channel.
    let large = vec![2, 0x81, 0x80, 0x02, 0, 0, 0, 0, 0, 0, 0];
    for content in [Vec::new(), vec![0], vec![8], vec![2], longer, shorter, large] {
        let bytes = with_section(content.clone());
        let error = decode(&bytes, &limits).expect_err("must be refused");
        assert!(error.to_string().contains("regression"), "{error}");
        assert_eq!(inspect(&bytes).expect_err("must be refused"), error);
    }
    // Of the format, but not what the symbols were coded with.
    for content in [vec![2, 0, 0, 0, 0, 0, 0], vec![1, 0, 0, 0, 0]] {
        assert!(decode(&with_section(content), &limits).is_err());
    }
}

#[test]
fn more_work_than_the_format_allows_is_refused_before_anything_is_decoded() {
    let recipe = Recipe { seed: 78, anchors: 200, feature_dim: 256, offsets: 1, masked: 0.0 };
    let bytes = encode(&scene(recipe), None, &settings()).expect("encodes").bytes;
    let mut parts = wire::parts(&bytes);
    let place = parts.iter().position(|part| &part.0 == b"ATTR").expect("has attributes");
    parts.insert(place, (*b"REGR", 1, [vec![1], vec![0; 256]].concat()));
    assert!(decode(&wire::file((1, 1), &parts), &DecodeLimits::default()).is_ok());
    // 2^23 anchors of 2^15 products are as many as allowed.
    assert_eq!(parts[0].2[..2], [0xc8, 0x01], "200 anchors");
    parts[0].2.splice(..2, [0x80, 0x80, 0x80, 0x04]);
    let refusal = |parts: &[wire::Part]| {
        decode(&wire::file((1, 1), parts), &DecodeLimits::NONE).expect_err("must be refused").to_string()
    };
    assert!(refusal(&parts).contains("number of anchors"), "{}", refusal(&parts));
    parts[0].2[0] = 0x81;
    assert!(refusal(&parts).contains("multiplications"), "{}", refusal(&parts));
}
