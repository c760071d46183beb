//! Later versions: a major is refused, a critical section is refused, an optional section is passed over.

use tcgs_codec::{
    DecodeError, DecodeLimits, decode,
    domain::{AnchorScene, NearPlane, SceneFrame, SceneScale, ViewDegree},
    encode, inspect,
};

use super::{
    synthetic::{Normal, networks, settings, small},
    wire,
};

fn small_file() -> Vec<u8> {
    encode(&small(), None, &settings()).expect("encodes").bytes
}

fn error_of(bytes: &[u8]) -> DecodeError {
    let error = decode(bytes, &DecodeLimits::default()).expect_err("must be refused");
    assert_eq!(inspect(bytes).expect_err("must be refused"), error, "decode and inspect agree");
    error
}

#[test]
fn the_written_layout_is_the_documented_one() {
    let bytes = small_file();
    assert_eq!(wire::file((1, 0), &wire::parts(&bytes)), bytes);
}

#[test]
fn another_major_is_refused_and_another_minor_is_read() {
    let parts = wire::parts(&small_file());
    for major in [0, 2, u16::MAX] {
        let known = DecodeError::UnsupportedVersion { major, minor: 3, known: 1 };
        assert_eq!(error_of(&wire::file((major, 3), &parts)), known);
    }
    let later = wire::file((1, 9), &parts);
    assert!(decode(&later, &DecodeLimits::default()).is_ok());
    assert_eq!(inspect(&later).expect("inspects").version, "1.9");
}

#[test]
fn another_arithmetic_profile_is_refused() {
    let bytes = small_file();
    assert_eq!(inspect(&bytes).expect("inspects").profile, 1);
    for profile in [0_u16, 2, u16::MAX] {
        let mut other = bytes.clone();
        other[14..16].copy_from_slice(&profile.to_le_bytes());
        wire::reseal(&mut other);
        assert_eq!(error_of(&other), DecodeError::UnsupportedProfile { profile, known: 1 });
    }
}

#[test]
fn an_unknown_optional_section_is_passed_over_wherever_it_stands() {
    let bytes = small_file();
    let expected = decode(&bytes, &DecodeLimits::default()).expect("decodes");
    for place in 0..=5 {
        let mut parts = wire::parts(&bytes);
        parts.insert(place, (*b"NEW!", 0, vec![1, 2, 3, 4, 5]));
        let later = wire::file((1, 1), &parts);
        assert_eq!(decode(&later, &DecodeLimits::default()), Ok(expected.clone()));
        let inspection = inspect(&later).expect("inspects");
        assert_eq!(inspection.sections[place].name, "unknown");
        assert_eq!(inspection.byte_counts.total, later.len() as u64);
    }
}

#[test]
fn a_file_has_at_most_64_sections() {
    let bytes = small_file();
    let with_sections = |count: usize| {
        let mut parts = wire::parts(&bytes);
        let more = (parts.len()..count).map(|index| ([b'N', b'E', b'W', index as u8], 0, vec![1]));
        parts.extend(more.collect::<Vec<_>>());
        wire::file((1, 1), &parts)
    };
    assert!(decode(&with_sections(64), &DecodeLimits::default()).is_ok());
    for count in [65, 70] {
        let error = error_of(&with_sections(count)).to_string();
        assert!(error.contains("section count") && error.contains(&count.to_string()), "{error}");
    }
}

#[test]
fn an_unknown_critical_section_is_refused() {
    let mut parts = wire::parts(&small_file());
    parts.push((*b"NEW!", 1, vec![1]));
    assert_eq!(
        error_of(&wire::file((1, 1), &parts)),
        DecodeError::UnknownSection { section: "NEW!".to_owned() }
    );
}

#[test]
fn a_near_plane_that_is_not_the_usual_one_takes_an_optional_section_of_four_bytes() {
    let near = NearPlane::of_extent(0.01);
    let bytes = encode(&AnchorScene { near, ..small() }, None, &settings()).expect("encodes").bytes;
    assert_eq!(decode(&bytes, &DecodeLimits::default()).expect("decodes").scene.near, near);
    let parts = wire::parts(&bytes);
    assert_eq!(parts.last(), Some(&(*b"VIEW", 0, near.depth().to_le_bytes().to_vec())));
    assert_eq!(inspect(&bytes).expect("inspects").sections.last().expect("sections").name, "view");

    let usual = decode(&small_file(), &DecodeLimits::default()).expect("decodes");
    assert_eq!(usual.scene.near, NearPlane::DEFAULT);
    let without = decode(&wire::file((1, 0), &parts[..parts.len() - 1]), &DecodeLimits::default());
    assert_eq!(without, Ok(usual), "the attributes are the same");
    for content in [&[][..], &[0; 3], &[0; 5], &0.0_f32.to_le_bytes(), &f32::NAN.to_le_bytes()] {
        let mut parts = parts.clone();
        parts.last_mut().expect("sections").2 = content.to_vec();
        let error =
            decode(&wire::file((1, 0), &parts), &DecodeLimits::default()).expect_err("must be refused");
        assert!(error.to_string().contains("view"), "{error}");
    }
}

#[test]
fn a_frame_that_is_not_the_worlds_takes_a_critical_section_of_four_doubles_and_version_1_2() {
    let frame = SceneFrame::new([5e5, -4e6, 1.0 / 3.0].into(), 0.1).expect("a frame");
    let bytes = encode(&AnchorScene { frame, ..small() }, None, &settings()).expect("encodes").bytes;
    let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
    assert_eq!(decoded.scene.frame, frame);
    let parts = wire::parts(&bytes);
    let content: Vec<u8> =
        [5e5, -4e6, 1.0 / 3.0, 0.1].iter().flat_map(|value: &f64| value.to_le_bytes()).collect();
    assert_eq!(parts.last(), Some(&(*b"FRAM", 1, content)));
    assert_eq!(wire::file((1, 2), &parts), bytes);
    let inspection = inspect(&bytes).expect("inspects");
    assert_eq!((inspection.frame, inspection.version.as_str()), (frame, "1.2"));
    let text = inspection.to_string();
    assert!(text.contains("500000 -4000000 0.3333333333333333 in the world"), "{text}");

    // The near plane comes last as it always did, and nothing else of the file differs.
    let near = NearPlane::of_extent(0.01);
    let with_near = AnchorScene { frame, near, ..small() };
    let both = encode(&with_near, None, &settings()).expect("encodes").bytes;
    let ids: Vec<[u8; 4]> = wire::parts(&both)[5..].iter().map(|part| part.0).collect();
    assert_eq!(ids, [*b"FRAM", *b"VIEW"]);
    assert_eq!(wire::parts(&small_file()), parts[..parts.len() - 1]);
    assert_eq!(
        decode(&small_file(), &DecodeLimits::default()).expect("decodes").scene.frame,
        SceneFrame::WORLD
    );

    let numbers = |values: [f64; 4]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let whole = numbers([0.0, 0.0, 0.0, 1.0]);
    for content in [
        numbers([0.0, 0.0, 0.0, 0.0]),
        numbers([0.0, 0.0, 0.0, -1.0]),
        numbers([0.0, 0.0, 0.0, f64::NAN]),
        numbers([0.0, 0.0, 0.0, 1e-320]),
        numbers([0.0, f64::INFINITY, 0.0, 1.0]),
        Vec::new(),
        whole[..31].to_vec(),
        [whole, vec![0]].concat(),
    ] {
        let mut parts = parts.clone();
        parts.last_mut().expect("sections").2 = content;
        let error = error_of(&wire::file((1, 2), &parts));
        assert!(error.to_string().contains("frame"), "{error}");
    }
}

#[test]
fn harmonics_of_the_view_direction_take_a_critical_section_of_a_byte_and_version_1_3() {
    let scene = small();
    let usual = decode(&small_file(), &DecodeLimits::default()).expect("decodes").scene;
    assert_eq!(usual.view_degree(), Some(ViewDegree::DEFAULT));
    for degree in [2, 3] {
        let view_degree = ViewDegree::new(degree).expect("a degree");
        let hidden = scene.networks.opacity.layers[0].outputs;
        let widths = [scene.feature_dim + view_degree.inputs(), hidden, scene.offsets_per_anchor];
        let networks = networks(&mut Normal::new(1), widths);
        let seeing = AnchorScene { networks, ..scene.clone() };
        let bytes = encode(&seeing, None, &settings()).expect("encodes").bytes;
        let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
        assert_eq!(decoded.scene.view_degree(), Some(view_degree));
        let parts = wire::parts(&bytes);
        assert_eq!(parts.last(), Some(&(*b"DIRS", 1, vec![degree])));
        assert_eq!(wire::file((1, 3), &parts), bytes);
        let inspection = inspect(&bytes).expect("inspects");
        assert_eq!((inspection.view_degree, inspection.version.as_str()), (degree, "1.3"));
        assert_eq!(inspection.byte_counts.total, bytes.len() as u64);

        // The near plane comes last as it always did.
        let near = NearPlane::of_extent(0.01);
        let both = encode(&AnchorScene { near, ..seeing }, None, &settings()).expect("encodes").bytes;
        let ids: Vec<[u8; 4]> = wire::parts(&both)[5..].iter().map(|part| part.0).collect();
        assert_eq!(ids, [*b"DIRS", *b"VIEW"]);

        for content in [vec![0], vec![1], vec![4], Vec::new(), vec![degree, 0]] {
            let mut parts = parts.clone();
            parts.last_mut().expect("sections").2 = content.clone();
            let error = error_of(&wire::file((1, 3), &parts)).to_string();
            assert!(error.contains("directions"), "{content:?}: {error}");
        }
        // Another degree has networks of another width.
        let mut other = parts.clone();
        other.last_mut().expect("sections").2 = vec![5 - degree];
        assert!(decode(&wire::file((1, 3), &other), &DecodeLimits::default()).is_err());
    }
}

#[test]
fn a_distance_unit_that_is_not_the_usual_one_takes_a_critical_section_of_four_bytes() {
    let scene_scale = SceneScale::new(0.004).expect("a length");
    let bytes = encode(&AnchorScene { scene_scale, ..small() }, None, &settings()).expect("encodes").bytes;
    let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
    assert_eq!(decoded.scene.scene_scale, scene_scale);
    let parts = wire::parts(&bytes);
    assert_eq!(parts.last(), Some(&(*b"UNIT", 1, scene_scale.length().to_le_bytes().to_vec())));
    let inspection = inspect(&bytes).expect("inspects");
    assert_eq!(inspection.sections.last().expect("sections").name, "unit");
    assert_eq!(inspection.scene_scale, scene_scale);
    assert!(
        inspection.to_string().contains(&format!("scene scale        {}\n", scene_scale.length())),
        "{inspection}"
    );

    // With both, the near plane comes last as it always did.
    let near = NearPlane::of_extent(0.01);
    let both =
        encode(&AnchorScene { scene_scale, near, ..small() }, None, &settings()).expect("encodes").bytes;
    let ids: Vec<[u8; 4]> = wire::parts(&both)[5..].iter().map(|part| part.0).collect();
    assert_eq!(ids, [*b"UNIT", *b"VIEW"]);
    let scene = decode(&both, &DecodeLimits::default()).expect("decodes").scene;
    assert_eq!((scene.scene_scale, scene.near), (scene_scale, near));

    let usual = decode(&small_file(), &DecodeLimits::default()).expect("decodes");
    assert!(
        usual.scene.scene_scale.is_default()
            && inspect(&small_file()).expect("inspects").scene_scale.is_default()
    );
    let numbers =
        [0.0, -0.0, -2.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-45, f32::MAX].map(f32::to_le_bytes);
    let contents = numbers.iter().map(|number| &number[..]).chain([&[][..], &[0; 3], &[0; 5]]);
    for content in contents {
        let mut parts = parts.clone();
        parts.last_mut().expect("sections").2 = content.to_vec();
        let error = error_of(&wire::file((1, 0), &parts));
        assert!(error.to_string().contains("unit"), "{error}");
    }
}

#[test]
fn missing_doubled_and_misplaced_sections_are_refused() {
    let bytes = small_file();
    for missing in 0..5 {
        let mut parts = wire::parts(&bytes);
        parts.remove(missing);
        assert!(matches!(error_of(&wire::file((1, 0), &parts)), DecodeError::MissingSection { .. }));
    }
    let mut parts = wire::parts(&bytes);
    parts.push(parts[1].clone());
    assert!(matches!(error_of(&wire::file((1, 0), &parts)), DecodeError::DuplicateSection { .. }));

    let mut moved = bytes.clone();
    moved[wire::HEADER + 8] += 1;
    wire::reseal(&mut moved);
    assert!(matches!(error_of(&moved), DecodeError::SectionPlace { .. }));

    let mut flagged = wire::parts(&bytes);
    flagged[0].1 = 3;
    assert!(matches!(error_of(&wire::file((1, 0), &flagged)), DecodeError::Malformed { .. }));
}

#[test]
fn trailing_bytes_are_refused_even_where_the_header_counts_them() {
    let mut longer = small_file();
    longer.push(0);
    assert!(matches!(error_of(&longer), DecodeError::FileLength { .. }));
    let length = longer.len() as u64;
    longer[16..24].copy_from_slice(&length.to_le_bytes());
    wire::reseal(&mut longer);
    assert_eq!(error_of(&longer), DecodeError::TrailingBytes { part: "file", count: 1 });
    for section in 0..5 {
        let mut parts = wire::parts(&small_file());
        parts[section].2.extend([0; 16]);
        assert!(decode(&wire::file((1, 0), &parts), &DecodeLimits::default()).is_err(), "section {section}");
    }
}

#[test]
fn damage_is_named() {
    assert_eq!(error_of(b"PK\x03\x04, an archive"), DecodeError::NotTcgs);
    let bytes = small_file();
    let mut header = bytes.clone();
    header[17] ^= 1;
    assert!(matches!(error_of(&header), DecodeError::HeaderChecksum { .. }));
    let mut payload = bytes.clone();
    let last = payload.len() - 1;
    payload[last] ^= 1;
    assert!(matches!(error_of(&payload), DecodeError::FileDigest { .. }));
    wire::reseal_header(&mut payload, wire::HEADER + 5 * wire::ENTRY);
    assert!(matches!(error_of(&payload), DecodeError::SectionChecksum { section, .. } if section == "ATTR"));
    wire::reseal(&mut payload);
    let deep = decode(&payload, &DecodeLimits::default()).expect_err("must be refused");
    assert!(matches!(deep, DecodeError::ChunkChecksum { chunk: 0, .. }), "{deep}");
}

#[test]
fn a_wrong_decode_hash_is_refused() {
    let bytes = small_file();
    let mut parts = wire::parts(&bytes);
    let expected = decode(&bytes, &DecodeLimits::default()).expect("decodes").decode_sha256;
    let manifest = &mut parts[0].2;
    let place = manifest.windows(32).position(|window| window == expected.as_bytes()).expect("the hash");
    manifest[place] ^= 1;
    let error = decode(&wire::file((1, 0), &parts), &DecodeLimits::default()).expect_err("must be refused");
    assert!(matches!(error, DecodeError::DecodeDigest { actual, .. } if actual == expected));
}
