//! Round trips, hand-made bytes, and invalid files.

use std::io::{Read as _, Write as _};

use flate2::{Compression, read::GzDecoder, write::GzEncoder};
use proptest::prelude::*;

use super::*;
use crate::domain::{GaussianScene, NearPlane, SceneFrame};

/// Bytes of the header up to version 3.
const HEADER: usize = 16;

const VERSIONS: [SpzVersion; 2] = [SpzVersion::V3, SpzVersion::V4];

/// The scene in version 3.
fn to_spz3(scene: &GaussianScene) -> Result<Packed, SpzError> {
    to_spz(scene, SpzVersion::V3)
}

/// The scene in version 4.
fn to_spz4(scene: &GaussianScene) -> Vec<u8> {
    to_spz(scene, SpzVersion::V4).expect("packs").bytes
}

#[test]
fn harmonics_change_sign_with_the_axes() {
    let signs = flip_harmonics();
    for seed in 0..20 {
        let angle = f64::from(seed);
        let d = DVec3::new(angle.sin(), (2.0 * angle).cos(), (3.0 * angle).sin() + 0.1).normalize();
        let turned = harmonics::basis(DVec3::new(d.x, -d.y, -d.z));
        for ((value, sign), turned) in harmonics::basis(d).into_iter().zip(signs).zip(turned) {
            assert!((value * f64::from(sign) - turned).abs() < 1e-12);
        }
    }
    assert!(harmonics::basis(DVec3::new(0.48, 0.36, 0.8)).iter().all(|value| value.abs() > 1e-3));
}

fn gunzip(bytes: &[u8]) -> Vec<u8> {
    let mut payload = Vec::new();
    GzDecoder::new(bytes).read_to_end(&mut payload).expect("gzip");
    payload
}

fn gzip(payload: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(payload).expect("memory");
    encoder.finish().expect("memory")
}

/// Any scene that the format holds without clamping.
fn scenes() -> impl Strategy<Value = GaussianScene> {
    let gaussian = (
        prop::array::uniform3(-500.0_f32..500.0),
        prop::array::uniform3(-9.0_f32..5.0),
        prop::array::uniform4(-1.0_f32..1.0),
        -5.0_f32..5.0,
        prop::array::uniform16(prop::array::uniform3(-0.9_f32..0.9)),
    );
    (0_u8..=3, prop::collection::vec(gaussian, 0..8)).prop_map(|(degree, rows)| {
        let mut scene = GaussianScene { degree, ..GaussianScene::default() };
        for (mean, log_scale, quat, opacity, mut sh) in rows {
            sh[harmonics::functions(degree)..].fill([0.0; 3]);
            scene.means.push(mean);
            scene.log_scales.push(log_scale);
            scene.quats.push(if quat.iter().all(|v| v.abs() < 0.1) { [1.0, 0.0, 0.0, 0.0] } else { quat });
            scene.opacity_logits.push(opacity);
            scene.sh.push(sh);
        }
        scene
    })
}

fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

proptest! {
    #[test]
    fn what_is_read_again_is_what_was_written_up_to_its_rounding(scene in scenes()) {
        let packed = to_spz3(&scene).expect("packs");
        prop_assert_eq!((packed.gaussians, packed.left_out, packed.clamped), (scene.len(), 0, 0));
        let back = from_spz(&packed.bytes).expect("reads");
        back.check().expect("sound");
        prop_assert_eq!(&from_spz(&to_spz4(&scene)).expect("reads"), &back, "both versions hold the same integers");
        prop_assert_eq!((back.len(), back.degree), (scene.len(), scene.degree));
        let close = |a: &[f32], b: &[f32], bound: f32| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= bound);
        let half_unit = 0.5001 * (-f32::from(packed.fractional_bits)).exp2();
        for index in 0..scene.len() {
            // A position's own rounding as f32 counts too.
            prop_assert!(close(&scene.means[index], &back.means[index], half_unit + 4e-5));
            prop_assert!(close(&scene.log_scales[index], &back.log_scales[index], 0.03126));
            let (before, after) = (opacity(scene.opacity_logits[index]), opacity(back.opacity_logits[index]));
            prop_assert!((before - after).abs() < 0.6 / 255.0);
            let length = scene.quats[index].iter().map(|v| v * v).sum::<f32>().sqrt();
            let same: f32 = scene.quats[index].iter().zip(back.quats[index]).map(|(a, b)| a * b).sum();
            prop_assert!(same.abs() / length > 0.999_99, "{:?} became {:?}", scene.quats[index], back.quats[index]);
            for (function, (before, after)) in scene.sh[index].iter().zip(back.sh[index]).enumerate() {
                let bound = [0.0132, 0.0313, 0.0626, 0.0626][usize::from(harmonics::degree_of(function))];
                prop_assert!(close(before, &after, bound), "{function}: {before:?} became {after:?}");
            }
        }
        // Nothing is rounded twice.
        let again = to_spz3(&back).expect("packs");
        if again.fractional_bits == packed.fractional_bits {
            let (first, second) = (gunzip(&packed.bytes), gunzip(&again.bytes));
            let rotations = HEADER + 16 * scene.len()..HEADER + 20 * scene.len();
            prop_assert_eq!(&first[..rotations.start], &second[..rotations.start]);
            prop_assert_eq!(&first[rotations.end..], &second[rotations.end..]);
        }
    }

    #[test]
    fn spoiled_files_are_refused_or_read_and_never_panic(
        scene in scenes(),
        at in any::<prop::sample::Index>(),
        byte in any::<u8>(),
    ) {
        let mut payload = gunzip(&to_spz3(&scene).expect("packs").bytes);
        let place = at.index(payload.len());
        payload[place] = byte;
        let spoiled = VERSIONS.map(|version| {
            let mut spoiled = to_spz(&scene, version).expect("packs").bytes;
            let place = at.index(spoiled.len());
            spoiled[place] = byte;
            spoiled
        });
        let [three, four] = spoiled;
        for bytes in [gzip(&payload), three, four] {
            if let Ok(scene) = from_spz(&bytes) {
                scene.check().expect("what is read is sound");
            }
        }
    }

    #[test]
    fn any_bytes_are_refused_or_read_and_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..64)) {
        let _ = from_spz(&bytes);
        let _ = from_spz(&gzip(&bytes));
        let _ = from_spz(&gzip(&[&MAGIC[..], &[3, 0, 0, 0], &bytes].concat()));
        let _ = from_spz(&[&MAGIC[..], &[4, 0, 0, 0], &bytes].concat());
    }
}

/// A quarter turn about z, at (1, 2, -3).
fn one() -> GaussianScene {
    let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
    sh[0] = [1.0, 0.0, -1.0];
    sh[1] = [0.5, -0.5, 0.0];
    sh[3] = [0.5, -0.5, 0.0];
    GaussianScene {
        means: vec![[1.0, 2.0, -3.0]],
        log_scales: vec![[-2.0, 0.0, 5.0]],
        quats: vec![[0.5_f32.sqrt(), 0.0, 0.0, 0.5_f32.sqrt()]],
        opacity_logits: vec![0.0],
        sh: vec![sh],
        degree: 1,
        near: NearPlane::DEFAULT,
        frame: SceneFrame::WORLD,
    }
}

#[test]
fn the_bytes_are_those_of_the_format() {
    let packed = to_spz3(&one()).expect("packs");
    let mut expected = b"NGSP\x03\0\0\0\x01\0\0\0\x01\x0c\0\0".to_vec();
    // 1, -2 and 3 in units of 2^-12.
    expected.extend([0x00, 0x10, 0x00, 0x00, 0xe0, 0xff, 0x00, 0x30, 0x00]);
    expected.push(128);
    expected.extend([166, 128, 89]);
    expected.extend([128, 160, 240]);
    // z is turned over, and with w it is the largest: index 2. It is negative, so the signs of x, y and w turn over.
    expected.extend((2_u32 << 30 | 0x200 << 20 | 0x200 << 10 | 0x3ff).to_le_bytes());
    // Odd in y and z together: the first two functions; the third keeps its sign.
    expected.extend([64, 192, 128, 128, 128, 128, 192, 64, 128]);
    assert_eq!(gunzip(&packed.bytes), expected);
    assert_eq!(packed.clamped, 0);
}

#[test]
fn a_file_of_version_2_is_read() {
    let mut payload = b"NGSP\x02\0\0\0\x01\0\0\0\0\x08\0\0".to_vec();
    payload.extend([0x00, 0x01, 0x00, 0x00, 0xff, 0xff, 0x80, 0x00, 0x00]);
    payload.extend([255, 128, 128, 128, 160, 160, 160]);
    payload.extend([255, 128, 128]);
    let scene = from_spz(&gzip(&payload)).expect("a scene");
    scene.check().expect("sound");
    assert_eq!(scene.means, [[1.0, 1.0, -0.5]]);
    assert_eq!(scene.log_scales, [[0.0; 3]]);
    assert!(scene.opacity_logits[0] > 5.0);
    let [w, x, y, z] = scene.quats[0];
    assert!(x == 1.0 && [w, y, z].iter().all(|value| value.abs() < 0.01), "{:?}", scene.quats);
}

#[test]
fn what_is_not_read_is_named() {
    let payload = gunzip(&to_spz3(&one()).expect("packs").bytes);
    let error = |at: usize, value: u8| {
        let mut changed = payload.clone();
        changed[at] = value;
        from_spz(&gzip(&changed)).expect_err("refused")
    };
    assert_eq!(error(0, b'X'), SpzError::NotSpz);
    assert_eq!(error(4, 1), SpzError::Version(1));
    assert_eq!(error(4, 9), SpzError::Version(9));
    assert_eq!(error(12, 4), SpzError::Degree(4));
    assert_eq!(error(13, 24), SpzError::FractionalBits(24));
    assert_eq!(error(14, 2), SpzError::Extensions(2));
    assert_eq!(error(8, 2), SpzError::Length { count: 2, needed: 58, found: 29 });
    assert_eq!(error(8, 0), SpzError::Length { count: 0, needed: 0, found: 1 });
    // A count of sixteen million in a file of a hundred bytes costs no memory.
    assert!(matches!(error(11, 1), SpzError::Length { count: 0x0100_0001, .. }));
    assert_eq!(error(4, 4), SpzError::Container(4));
    assert_eq!(from_spz(b"NGSP\x05\0\0\0more"), Err(SpzError::Version(5)));
    assert_eq!(from_spz(b"NGSP\x04\0\0\0more"), Err(SpzError::Cut));
    assert!(matches!(from_spz(b"nothing of the kind"), Err(SpzError::Gzip(_))));
    let whole = to_spz3(&one()).expect("packs").bytes;
    for length in 0..whole.len() {
        from_spz(&whole[..length]).expect_err("half a file");
    }
}

#[test]
fn version_4_has_a_plain_header_a_table_and_a_frame_for_each_array() {
    let bytes = to_spz4(&one());
    let mut expected = b"NGSP\x04\0\0\0\x01\0\0\0\x01\x0c\0\x06\x20\0\0\0".to_vec();
    expected.resize(32, 0);
    assert_eq!(bytes[..32], expected);
    let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let table: Vec<(u64, u64)> = (0..6).map(|array| (word(32 + 16 * array), word(40 + 16 * array))).collect();
    assert_eq!(table.iter().map(|entry| entry.1).collect::<Vec<u64>>(), [9, 1, 3, 3, 4, 9]);
    assert_eq!(bytes.len() as u64, 32 + 6 * 16 + table.iter().map(|entry| entry.0).sum::<u64>());
    assert!(packed_lengths(&bytes).expect("a table").iter().eq(table.iter().map(|entry| &entry.0)));
    let mut begin = 32 + 6 * 16;
    let mut payload = Vec::new();
    for (packed, _) in &table {
        let frame = &bytes[begin..][..*packed as usize];
        assert_eq!(frame[..4], [0x28, 0xb5, 0x2f, 0xfd], "a zstd frame");
        assert_eq!(frame[4] & 4, 4, "with a checksum");
        payload.extend(zstd::stream::decode_all(frame).expect("a frame"));
        begin += *packed as usize;
    }
    assert_eq!(payload, gunzip(&to_spz3(&one()).expect("packs").bytes)[HEADER..]);

    let flat = GaussianScene { degree: 0, sh: vec![[[0.0; 3]; SH_COEFFICIENTS]], ..one() };
    assert_eq!(to_spz4(&flat)[15], 5, "degree 0 has no harmonics");
    assert_eq!(from_spz(&to_spz4(&flat)).expect("reads").len(), 1);
    let empty = GaussianScene { degree: 3, ..GaussianScene::default() };
    assert_eq!(from_spz(&to_spz4(&empty)).expect("reads").len(), 0);
    // Another writer lists no array that has no bytes.
    let mut bare = to_spz4(&empty)[..32].to_vec();
    bare[15] = 0;
    assert_eq!(from_spz(&bare).expect("reads").len(), 0);
}

#[test]
fn extensions_of_version_4_are_skipped_unless_they_change_the_axes() {
    let plain = to_spz4(&one());
    let with = |records: &[u8]| {
        let mut bytes = [&plain[..32], records, &plain[32..]].concat();
        bytes[14] |= 2;
        bytes[16..20].copy_from_slice(&(32 + records.len() as u32).to_le_bytes());
        from_spz(&bytes)
    };
    let record = |kind: u32, content: &[u8]| {
        [&kind.to_le_bytes()[..], &(content.len() as u32).to_le_bytes(), content].concat()
    };
    let axes = |value: u32| record(0xadbe_0003, &value.to_le_bytes());
    let expected = from_spz(&plain);
    for records in [Vec::new(), axes(4), axes(0), [record(0xadbe_0002, &[0; 12]), axes(4)].concat()] {
        assert_eq!(with(&records), expected);
    }
    assert_eq!(with(&axes(6)), Err(SpzError::CoordinateSystem(6)));
    for cut in [&axes(4)[..11], &axes(4)[..5], &record(0xadbe_0003, &[4])[..]] {
        assert_eq!(with(cut), Err(SpzError::Cut));
    }
}

#[test]
fn a_spoiled_file_of_version_4_is_refused_with_its_fault() {
    let whole = to_spz4(&one());
    let error = |at: usize, value: u8| {
        let mut changed = whole.clone();
        changed[at] = value;
        from_spz(&changed).expect_err("refused")
    };
    assert_eq!(error(4, 3), SpzError::Container(3));
    assert_eq!(error(4, 5), SpzError::Version(5));
    assert_eq!(error(12, 4), SpzError::Degree(4));
    assert_eq!(error(13, 24), SpzError::FractionalBits(24));
    assert_eq!(error(15, 5), SpzError::Table);
    assert_eq!(error(16, 31), SpzError::Table);
    assert_eq!(error(19, 1), SpzError::Cut);
    assert_eq!(error(8, 2), SpzError::Length { count: 2, needed: 18, found: 9 });
    assert!(matches!(error(12, 2), SpzError::Length { .. }));
    // The last byte is of a checksum.
    let last = whole.len() - 1;
    assert!(matches!(error(last, whole[last] ^ 1), SpzError::Zstd(_)));
    for length in 0..whole.len() {
        from_spz(&whole[..length]).expect_err("half a file");
    }
    let longer = [&whole[..], b"x"].concat();
    assert_eq!(from_spz(&longer), Err(SpzError::Table));
    // A table may claim any length: it is checked against the most that a frame of its bytes can hold, then against the content.
    let mut huge = whole.clone();
    let count = 0x0fff_ffff_u32;
    huge[8..12].copy_from_slice(&count.to_le_bytes());
    for (array, stride) in [9, 1, 3, 3, 4, 9_u64].into_iter().enumerate() {
        huge[40 + 16 * array..][..8].copy_from_slice(&(stride * u64::from(count)).to_le_bytes());
    }
    assert!(matches!(from_spz(&huge), Err(SpzError::Length { count: 0x0fff_ffff, .. })));
    let mut more = whole.clone();
    more[8] = 2;
    for (array, stride) in [9, 1, 3, 3, 4, 9_u8].into_iter().enumerate() {
        more[40 + 16 * array] = 2 * stride;
    }
    assert_eq!(from_spz(&more), Err(SpzError::Length { count: 2, needed: 18, found: 9 }));
}

#[test]
fn invisible_gaussians_are_left_out_and_opaque_ones_stay_finite_for_others() {
    let mut scene = one();
    for logit in [-20.0, 20.0] {
        scene.means.push([0.0; 3]);
        scene.log_scales.push([0.0; 3]);
        scene.quats.push([1.0, 0.0, 0.0, 0.0]);
        scene.opacity_logits.push(logit);
        scene.sh.push([[0.0; 3]; SH_COEFFICIENTS]);
    }
    let packed = to_spz3(&scene).expect("packs");
    assert_eq!((packed.gaussians, packed.left_out), (2, 1));
    assert_eq!(gunzip(&packed.bytes)[HEADER + 18..][..2], [128, 254]);
}

#[test]
fn positions_are_as_fine_as_sizes_ask_and_as_coarse_as_distances() {
    let bits = |mean: f32, log_scale: f32| {
        let scene =
            GaussianScene { means: vec![[mean, 0.0, 0.0]], log_scales: vec![[log_scale; 3]], ..one() };
        to_spz3(&scene).map(|packed| packed.fractional_bits)
    };
    assert_eq!(bits(1.0, 0.0), Ok(12));
    // Sixteen units to a size of e^-8: 2^16.
    assert_eq!(bits(1.0, -8.0), Ok(16));
    assert_eq!(bits(1.0, -20.0), Ok(22), "one must still fit");
    assert_eq!(bits(2048.0, 0.0), Ok(11));
    assert_eq!(bits(8_388_607.0, 0.0), Ok(0));
    assert_eq!(bits(-9e6, 0.0), Err(SpzError::TooFar { index: 0, coordinate: 9_000_000 }));
}

#[test]
fn values_out_of_range_are_held_and_counted() {
    let mut scene = one();
    scene.log_scales[0] = [-30.0, 9.0, 0.0];
    scene.sh[0][2] = [-7.0, 7.0, 0.0];
    let packed = to_spz3(&scene).expect("packs");
    assert_eq!(packed.clamped, 4);
    let back = from_spz(&packed.bytes).expect("reads");
    assert_eq!(back.log_scales[0], [-10.0, 5.9375, 0.0]);
    assert!((back.sh[0][2][1].abs() - 1.0).abs() < 0.01);
}
