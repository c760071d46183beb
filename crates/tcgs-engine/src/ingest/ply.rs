//! Point clouds in PLY files, ASCII and binary of both byte orders.
//!
//! Only the `vertex` element is read: x, y, z and, where stated, colors under any of the names in [`COLOR_NAMES`]. Points without color
//! are mid-gray. The file is read as a stream, one vertex at a time. Channels of 8 bits are taken as they are; others may run to 1, 255
//! or 65535, which the largest of all vertices tells.

use std::io::{self, BufRead};

use super::{
    error::{IngestError, IngestErrorKind, Result},
    points::Points,
    tree::Tree,
};
use crate::ply::{Encoding, Header, Profile, Scalar};

/// Color of points in a file without colors.
const GRAY: u8 = 128;

/// Names of red, green and blue in the order of preference, in any case of letters.
const COLOR_NAMES: [[&str; 3]; 6] = [
    ["red", "green", "blue"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ["r", "g", "b"],
    ["color_red", "color_green", "color_blue"],
    ["scalar_red", "scalar_green", "scalar_blue"],
    HARMONICS,
];

/// The constant coefficients of spherical harmonics, as files of Gaussians name them.
const HARMONICS: [&str; 3] = ["f_dc_0", "f_dc_1", "f_dc_2"];

/// The constant spherical harmonic: colors are 0.5 more than it times the coefficient.
const Y_0: f32 = 0.282_094_8;

/// Longest number in ASCII; real ones have some twenty bytes.
const MAX_NUMBER_BYTES: usize = 400;

/// The points of a file of the dataset.
///
/// # Errors
/// As [`points`], and those of reading the file.
pub(super) fn read(tree: &Tree, file: &str) -> Result<Points, IngestError> {
    tree.parse(file, u64::MAX, |reader, length| {
        let mut cloud = tree.points();
        points(reader, length, &mut cloud)?;
        Ok(cloud)
    })
}

/// Reads the vertices.
///
/// # Errors
/// [`IngestErrorKind::Ply`] for a header that is not understood, more vertices than the file can hold, or values that are not finite;
/// [`IngestErrorKind::TooManyPoints`].
pub(super) fn points(reader: &mut dyn BufRead, length: u64, cloud: &mut Points) -> Result<()> {
    let header = Header::parse(&Header::read_bytes(reader)?, Profile::Points)
        .map_err(|error| refused(error.to_string()))?;
    let data = length.saturating_sub(header.length as u64);
    let column = |name: &str| header.properties.iter().position(|property| property.name == name);
    let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(column) else {
        return Err(refused("its vertices lack x, y or z"));
    };
    let colors = color_columns(&header);
    if colors.is_none() {
        cloud.without_colors();
    }

    // A number takes at least a digit and a separator in ASCII (the last may lack the separator).
    let record = match header.encoding {
        Encoding::Ascii => 2 * header.properties.len(),
        _ => header.stride,
    };
    let needed = u128::from(header.vertices) * record as u128;
    let left = u128::from(data) + u128::from(header.encoding == Encoding::Ascii);
    if needed > left {
        return Err(refused(format!(
            "it claims {} vertices, which need at least {needed} bytes; {data} are left",
            header.vertices
        )));
    }
    let count = header.vertices as usize;
    cloud.reserve(count)?;

    // Colors of the kept points whose scale is known only at the end.
    let scalar = colors.map(|[red, ..]| header.properties[red].scalar);
    let has_harmonics =
        colors.is_some_and(|[red, ..]| header.properties[red].name.eq_ignore_ascii_case(HARMONICS[0]));
    let has_scale = !has_harmonics && scalar.is_some_and(|scalar| !matches!(scalar, Scalar::U8 | Scalar::I8));
    let mut unscaled: Vec<[f32; 3]> = Vec::new();
    let mut add = |index: usize, row: &[f64]| {
        let position = [x, y, z].map(|column| row[column]);
        if position.iter().any(|value| !(*value as f32).is_finite()) {
            return Err(refused(format!("vertex {index} is not finite")));
        }
        let color = colors.map(|columns| columns.map(|column| row[column] as f32));
        if has_harmonics {
            let color = color.map(|color| color.map(|value| to_8_bits(0.5 + Y_0 * value, 255.0)));
            return cloud.push(position, color.unwrap_or([GRAY; 3]));
        }
        if has_scale && cloud.keeps() {
            unscaled.extend(color);
        }
        cloud.push(position, color.map_or([GRAY; 3], |color| color.map(|value| to_8_bits(value, 1.0))))
    };

    let mut row = vec![0.0; header.properties.len()];
    if header.encoding == Encoding::Ascii {
        let mut token = Vec::new();
        for index in 0..count {
            for (value, property) in row.iter_mut().zip(&header.properties) {
                if !next_token(reader, &mut token)? {
                    return Err(refused(format!("it ends in vertex {index} of {count}")));
                }
                let text = std::str::from_utf8(&token).map_err(|_| refused("its data is not text"))?;
                *value = text.parse().map_err(|_| {
                    refused(format!("{} of vertex {index} is '{text:.20}', not a number", property.name))
                })?;
            }
            add(index, &row)?;
        }
    } else {
        let mut bytes = vec![0; record];
        for index in 0..count {
            let read = reader.read_exact(&mut bytes);
            read.map_err(|_| refused(format!("it ends in vertex {index} of {count}")))?;
            for (value, property) in row.iter_mut().zip(&header.properties) {
                *value = property.scalar.read(&bytes[property.offset..], header.encoding);
            }
            add(index, &row)?;
        }
    }
    if let Some(scalar) = scalar.filter(|_| has_scale) {
        let factor = factor(scalar, unscaled.as_flattened());
        cloud.recolor(unscaled.iter().map(|color| color.map(|value| to_8_bits(value, factor))));
    }
    Ok(())
}

/// The columns of red, green and blue.
fn color_columns(header: &Header) -> Option<[usize; 3]> {
    let column =
        |name: &str| header.properties.iter().position(|property| property.name.eq_ignore_ascii_case(name));
    COLOR_NAMES.iter().find_map(|names| match names.map(column) {
        [Some(red), Some(green), Some(blue)] => Some([red, green, blue]),
        _ => None,
    })
}

/// Factor to 0 to 255 of channels of one type.
fn factor(scalar: Scalar, channels: &[f32]) -> f32 {
    // Channels of spherical harmonics and of high dynamic range are a little above 1.
    const OVERSHOOT: f32 = 2.0;
    let float = matches!(scalar, Scalar::F32 | Scalar::F64);
    // Integers cannot exceed their range; of floats a few do, and must not darken all others.
    let largest = if float { usual_largest(channels) } else { channels.iter().copied().fold(0.0, f32::max) };
    if float && largest <= OVERSHOOT {
        255.0
    } else if largest > 255.0 {
        1.0 / 257.0
    } else {
        1.0
    }
}

/// The value that one in a hundred of the finite ones exceeds.
fn usual_largest(channels: &[f32]) -> f32 {
    let mut finite: Vec<f32> = channels.iter().copied().filter(|value| value.is_finite()).collect();
    let Some(last) = finite.len().checked_sub(1) else { return 0.0 };
    let (_, value, _) = finite.select_nth_unstable_by(last - last / 100, f32::total_cmp);
    *value
}

fn to_8_bits(value: f32, factor: f32) -> u8 {
    (value * factor).round().clamp(0.0, 255.0) as u8
}

/// Reads what stands between the next white space, and says whether there was anything. Of a longer token than any number the
/// beginning is kept.
fn next_token(reader: &mut dyn BufRead, token: &mut Vec<u8>) -> Result<bool> {
    token.clear();
    loop {
        let bytes = match reader.fill_buf() {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            read => read?,
        };
        if bytes.is_empty() {
            return Ok(!token.is_empty());
        }
        let start = if token.is_empty() {
            bytes.iter().position(|byte| !byte.is_ascii_whitespace()).unwrap_or(bytes.len())
        } else {
            0
        };
        let word = &bytes[start..];
        let end = word.iter().position(u8::is_ascii_whitespace);
        let word = &word[..end.unwrap_or(word.len())];
        token.extend_from_slice(&word[..word.len().min(MAX_NUMBER_BYTES.saturating_sub(token.len()))]);
        let passed = start + word.len();
        reader.consume(passed);
        if end.is_some() {
            return Ok(true);
        }
    }
}

fn refused(message: impl Into<String>) -> IngestErrorKind {
    IngestErrorKind::Ply(message.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::PointCloud, ply::MAX_HEADER_BYTES};

    fn points(bytes: &[u8]) -> Result<PointCloud> {
        let mut points = Points::new(true, 100);
        super::points(&mut &*bytes, bytes.len() as u64, &mut points)?;
        Ok(points.into_cloud().expect("kept"))
    }

    fn file(format: &str, properties: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes =
            format!("ply\nformat {format} 1.0\ncomment c\nelement vertex 2\n{properties}end_header\n")
                .into_bytes();
        bytes.extend(data);
        bytes
    }

    const PLAIN: &str = "property float x\nproperty float y\nproperty float z\n\
                         property uchar red\nproperty uchar green\nproperty uchar blue\n";

    fn plain(big: bool) -> Vec<u8> {
        let mut data = Vec::new();
        for (position, color) in [([1.0_f32, 2.0, 3.0], [1, 2, 3]), ([-4.0, 5.5, 0.25], [255, 0, 7])] {
            for value in position {
                data.extend(if big { value.to_be_bytes() } else { value.to_le_bytes() });
            }
            data.extend(color);
        }
        file(if big { "binary_big_endian" } else { "binary_little_endian" }, PLAIN, &data)
    }

    fn expected() -> PointCloud {
        PointCloud {
            positions: vec![[1.0, 2.0, 3.0], [-4.0, 5.5, 0.25]],
            colors: vec![[1, 2, 3], [255, 0, 7]],
        }
    }

    #[test]
    fn all_encodings_hold_the_same_points() {
        assert_eq!(points(&plain(false)).expect("little endian"), expected());
        assert_eq!(points(&plain(true)).expect("big endian"), expected());
        let ascii = file("ascii", PLAIN, b"1 2 3 1 2 3\r\n-4 5.5 0.25 255 0 7");
        assert_eq!(points(&ascii).expect("ascii"), expected());
    }

    #[test]
    fn other_types_orders_and_missing_colors_are_understood() {
        let properties = "property double z\nproperty double x\nproperty short skipped\nproperty double y\n";
        let mut data = Vec::new();
        for [x, y, z] in [[1.0_f64, 2.0, 3.0], [-4.0, 5.5, 0.25]] {
            data.extend(z.to_le_bytes());
            data.extend(x.to_le_bytes());
            data.extend(7_i16.to_le_bytes());
            data.extend(y.to_le_bytes());
        }
        let cloud = points(&file("binary_little_endian", properties, &data)).expect("points");
        assert_eq!(cloud.positions, expected().positions);
        assert_eq!(cloud.colors, [[GRAY; 3]; 2]);
        let fractions = PLAIN.replace("uchar", "float");
        let cloud = points(&file("ascii", &fractions, b"0 0 0 1 0.5 0\n0 0 0 2 -1 0\n")).expect("points");
        assert_eq!(cloud.colors, [[255, 128, 0], [255, 0, 0]]);
    }

    #[test]
    fn colors_are_found_under_their_other_names() {
        let plain = file("ascii", PLAIN, b"1 2 3 10 20 30\n4 5 6 255 0 7\n");
        let expected = points(&plain).expect("points").colors;
        let text = String::from_utf8(plain).expect("text");
        for names in
            [["diffuse_red", "diffuse_green", "diffuse_blue"], ["r", "g", "b"], ["Red", "Green", "Blue"]]
        {
            let renamed =
                ["red", "green", "blue"].iter().zip(names).fold(text.clone(), |text, (from, to)| {
                    text.replace(&format!(" {from}\n"), &format!(" {to}\n"))
                });
            assert_ne!(renamed, text);
            assert_eq!(points(renamed.as_bytes()).expect("points").colors, expected, "{names:?}");
        }
        let harmonics = "property float x\nproperty float y\nproperty float z\nproperty float f_dc_0\n\
                         property float f_dc_1\nproperty float f_dc_2\n";
        let data = b"0 0 0 0 1.7724538 -1.7724538\n0 0 0 -9 9 0.5\n";
        let cloud = points(&file("ascii", harmonics, data)).expect("points");
        assert_eq!(cloud.colors, [[128, 255, 0], [0, 255, 163]]);
    }

    #[test]
    fn a_file_without_colors_says_so() {
        for (properties, has_colors) in
            [(PLAIN, true), (&PLAIN[..PLAIN.find("property uchar").expect("colors")], false)]
        {
            let bytes = file("ascii", properties, b"1 2 3 1 2 3 4 5 6 7 8 9\n");
            let mut cloud = Points::new(false, 100);
            super::points(&mut &*bytes, bytes.len() as u64, &mut cloud).expect("points");
            assert_eq!(cloud.has_colors(), has_colors);
        }
    }

    #[test]
    fn channels_that_run_to_255_or_65535_are_told_from_fractions() {
        let colors = |scalar: &str, data: &[u8]| {
            points(&file("ascii", &PLAIN.replace("uchar", scalar), data)).expect("points").colors
        };
        let large = b"0 0 0 32768 65535 257\n0 0 0 0 1000 128\n";
        for scalar in ["ushort", "uint", "float", "double"] {
            assert_eq!(colors(scalar, large), [[128, 255, 1], [0, 4, 0]], "{scalar}");
            assert_eq!(
                colors(scalar, b"0 0 0 255 7 3\n0 0 0 0 1 128\n"),
                [[255, 7, 3], [0, 1, 128]],
                "{scalar}"
            );
        }
    }

    #[test]
    fn a_few_bright_points_darken_no_others() {
        let fractions = PLAIN.replace("uchar", "float");
        let others = "0 0 0 0.5 0.25 1\n".repeat(99);
        for bright in ["3.5", "inf", "1e9"] {
            let data = format!("{others}0 0 0 {bright} 0.5 0\n");
            let text = String::from_utf8(file("ascii", &fractions, data.as_bytes())).expect("text");
            let cloud = points(text.replace("vertex 2", "vertex 100").as_bytes()).expect("points");
            assert_eq!((cloud.colors[0], cloud.colors[99]), ([128, 64, 255], [255, 128, 0]), "{bright}");
        }
    }

    #[test]
    fn no_prefix_is_accepted_and_none_panics() {
        for whole in [plain(false), file("ascii", PLAIN, b"1 2 3 1 2 3\n-4 5.5 0.25 255 0 7")] {
            for length in 0..whole.len() {
                assert!(points(&whole[..length]).is_err(), "{length} of {} bytes", whole.len());
            }
        }
    }

    #[test]
    fn unusable_files_are_refused_with_the_reason() {
        let claimed = String::from_utf8(file("ascii", PLAIN, b"1 2 3 1 2 3")).expect("text");
        for (bytes, reason) in [
            (b"PLY\n".to_vec(), "start with"),
            (file("ascii", "property list uchar int x\n", b""), "type 'list'"),
            (file("ascii", "property quad x\n", b""), "unsupported type 'quad'"),
            (
                b"ply\nformat ascii 1.0\ncomment \xff\nelement vertex 0\nend_header\n".to_vec(),
                "header line 3",
            ),
            (file("ascii", "property float x\nproperty float y\n", b"1 2 3 4"), "lack x, y or z"),
            (file("utf9", PLAIN, b""), "'utf9 1.0' is not supported"),
            (file("ascii", PLAIN, b"1 2 nan 1 2 3 0 0 0 0 0 0"), "vertex 0 is not finite"),
            (file("ascii", PLAIN, b"1 2 1e300 1 2 3 0 0 0 0 0 0"), "vertex 0 is not finite"),
            (file("ascii", PLAIN, b"1 2 three 1 2 3 0 0 0 0 0 0"), "'three'"),
            (claimed.replace("vertex 2", "vertex 18446744073709551615").into_bytes(), "claims"),
            (claimed.replace("vertex 2", "vertex -1").into_bytes(), "line 4 is not understood"),
        ] {
            let error = points(&bytes).expect_err(reason).to_string();
            assert!(error.contains(reason), "'{error}' should say '{reason}'");
        }
    }

    #[test]
    fn numbers_and_headers_without_an_end_are_not_gathered() {
        let long = "1".repeat(100_000);
        let error = points(&file("ascii", PLAIN, format!("{long}x 2 3 1 2 3 0 0 0 0 0 0").as_bytes()));
        assert!(error.expect_err("not finite").to_string().contains("not finite"));
        let endless = [&b"ply\ncomment "[..], &vec![b'a'; 2 * MAX_HEADER_BYTES]].concat();
        assert!(points(&endless).expect_err("no end").to_string().contains("no end_header"));
        let many = format!("ply\n{}", "property float x\n".repeat(MAX_HEADER_BYTES));
        assert!(points(many.as_bytes()).expect_err("no end").to_string().contains("no end_header"));
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_bytes_never_panic(
            format in proptest::sample::select(vec!["ascii", "binary_little_endian", "binary_big_endian"]),
            data in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..200),
        ) {
            let _outcome = points(&file(format, PLAIN, &data));
            let _outcome = points(&data);
        }

        #[test]
        fn arbitrary_headers_never_panic(text in "(ply\n)?([a-z_ 0-9.\n]{0,40}|element vertex [0-9]{1,20}\n|property [a-z]{3,6} [xyz]\n|end_header\n){0,8}") {
            let _outcome = points(text.as_bytes());
        }
    }
}
