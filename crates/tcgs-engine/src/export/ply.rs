//! Plain Gaussians as `.ply`: binary little endian, 62 floats per Gaussian, before activation.
//!
//! Columns: `x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3`. Normals are zero. The coefficients above the constant one
//! are channel by channel: fifteen of red, fifteen of green, fifteen of blue. The rotation is w, x, y, z.

use thiserror::Error;

use crate::{
    domain::{GaussianScene, gaussians::SH_COEFFICIENTS},
    ply::{Header, HeaderError, Profile, Property, Scalar},
};

/// Coefficients of a channel above the constant one.
const REST: usize = SH_COEFFICIENTS - 1;

/// Columns of the file that this program writes.
const COLUMNS: usize = 62;

/// Logit that an infinite one is read as: an opacity of a millionth less than one, or more than zero.
const OPAQUE_LOGIT: f32 = 13.8;

/// What is wrong with a `.ply` file of Gaussians.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum PlyError {
    /// The header.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// A column of Gaussians that is not of floats.
    #[error("property '{0}' is not of type float")]
    NotFloat(String),
    /// A column that Gaussians need is not there.
    #[error("property '{0}' is missing")]
    MissingProperty(String),
    /// A number of coefficients that no degree has.
    #[error("{0} f_rest properties; spherical harmonics have 0, 9, 24 or 45")]
    RestCount(usize),
    /// The header's count and the bytes after it do not agree.
    #[error("{vertices} Gaussians take {needed} bytes, and {found} follow the header")]
    Length {
        /// The header's count.
        vertices: u64,
        /// Bytes needed.
        needed: u128,
        /// Bytes present.
        found: usize,
    },
    /// A value that is NaN or infinite; only an opacity may be that before the logistic.
    #[error("{property} of Gaussian {index} is not finite")]
    NotFinite {
        /// From 0.
        index: usize,
        /// The column.
        property: String,
    },
}

/// Bytes of the file of `count` Gaussians.
#[must_use]
pub fn ply_bytes(count: usize) -> u64 {
    header(count).len() as u64 + (COLUMNS * size_of::<f32>()) as u64 * count as u64
}

/// The file of a scene that [`GaussianScene::check`] finds sound.
#[must_use]
pub fn to_ply(scene: &GaussianScene) -> Vec<u8> {
    let mut bytes = header(scene.len()).into_bytes();
    bytes.reserve_exact(COLUMNS * size_of::<f32>() * scene.len());
    for index in 0..scene.len() {
        let [constant, rest @ ..] = &scene.sh[index];
        let by_channel = (0..3).flat_map(|channel| rest.iter().map(move |rgb| rgb[channel]));
        let row = scene.means[index]
            .into_iter()
            .chain([0.0; 3])
            .chain(*constant)
            .chain(by_channel)
            .chain([scene.opacity_logits[index]])
            .chain(scene.log_scales[index])
            .chain(scene.quats[index]);
        row.for_each(|value| bytes.extend(value.to_le_bytes()));
    }
    bytes
}

/// The names of the columns of `rest` coefficients per channel, as this program writes them.
fn names(rest: usize) -> Vec<String> {
    let numbered = |stem: &str, count: usize| -> Vec<String> {
        (0..count).map(|index| format!("{stem}_{index}")).collect()
    };
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned).into();
    names.extend(numbered("f_dc", 3));
    names.extend(numbered("f_rest", 3 * rest));
    names.push("opacity".to_owned());
    names.extend(numbered("scale", 3));
    names.extend(numbered("rot", 4));
    names
}

fn header(count: usize) -> String {
    let mut text = format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n");
    for name in names(REST) {
        text.push_str(&format!("property float {name}\n"));
    }
    text.push_str("end_header\n");
    text
}

/// Reads a file of Gaussians: any order of properties, coefficients of any degree from 0 to 3, further properties of any
/// number type left out. The scene's degree is the highest with a coefficient that is not zero.
///
/// # Errors
/// [`PlyError`], one variant for each thing that can be wrong.
pub fn from_ply(bytes: &[u8]) -> Result<GaussianScene, PlyError> {
    let head = Header::parse(bytes, Profile::Gaussians)?;
    let data = &bytes[head.length..];
    let needed = u128::from(head.vertices) * head.stride as u128;
    if needed != data.len() as u128 || head.stride == 0 {
        return Err(PlyError::Length { vertices: head.vertices, needed, found: data.len() });
    }
    let rest = rest_per_channel(&head)?;
    let columns = names(rest)
        .into_iter()
        .filter(|name| !["nx", "ny", "nz"].contains(&name.as_str()))
        .map(|name| column(&head, name))
        .collect::<Result<Vec<Column>, PlyError>>()?;
    let count = head.vertices as usize;
    let mut scene = GaussianScene {
        means: Vec::with_capacity(count),
        log_scales: Vec::with_capacity(count),
        quats: Vec::with_capacity(count),
        opacity_logits: Vec::with_capacity(count),
        sh: Vec::with_capacity(count),
        ..GaussianScene::default()
    };
    let mut highest = 0;
    let mut row = vec![0.0; columns.len()];
    for (index, record) in data.chunks_exact(head.stride).enumerate() {
        for (value, column) in row.iter_mut().zip(&columns) {
            let raw = &record[column.offset..column.offset + size_of::<f32>()];
            *value = f32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]]);
            // Converters write the logits of opacities 0 and 1, which are infinite.
            if column.name == "opacity" && value.is_infinite() {
                *value = OPAQUE_LOGIT.copysign(*value);
            }
            if !value.is_finite() {
                return Err(PlyError::NotFinite { index, property: column.name.clone() });
            }
        }
        let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
        sh[0] = three(&row, 3);
        let last = 6 + 3 * rest;
        for (at, value) in row[6..last].iter().enumerate() {
            let (channel, coefficient) = (at / rest, at % rest + 1);
            sh[coefficient][channel] = *value;
            if *value != 0.0 {
                highest = highest.max(coefficient);
            }
        }
        scene.means.push(three(&row, 0));
        scene.sh.push(sh);
        scene.opacity_logits.push(row[last]);
        scene.log_scales.push(three(&row, last + 1));
        scene.quats.push(std::array::from_fn(|k| row[last + 4 + k]));
    }
    // Coefficients 1 to 3 are of degree one, 4 to 8 of degree two, the rest of degree three.
    scene.degree = highest.isqrt() as u8;
    Ok(scene)
}

fn three(row: &[f32], first: usize) -> [f32; 3] {
    std::array::from_fn(|k| row[first + k])
}

/// A column of floats that Gaussians are made of.
struct Column {
    name: String,
    offset: usize,
}

/// Coefficients of a channel above the constant one.
fn rest_per_channel(header: &Header) -> Result<usize, PlyError> {
    let found = header.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    match found {
        0 | 9 | 24 | 45 => Ok(found / 3),
        _ => Err(PlyError::RestCount(found)),
    }
}

fn column(header: &Header, name: String) -> Result<Column, PlyError> {
    match header.property(&name) {
        Some(Property { scalar: Scalar::F32, offset, .. }) => Ok(Column { name, offset: *offset }),
        Some(_) => Err(PlyError::NotFloat(name)),
        None => Err(PlyError::MissingProperty(name)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Any sound scene of up to seven Gaussians, of the lowest degree that says it all.
    fn scenes() -> impl Strategy<Value = GaussianScene> {
        let number = -1e6_f32..1e6;
        let gaussian = (
            prop::array::uniform3(number.clone()),
            prop::array::uniform3(number.clone()),
            prop::array::uniform4(number.clone()),
            number.clone(),
            prop::array::uniform16(prop::array::uniform3(number)),
        );
        (0_u8..=3, prop::collection::vec(gaussian, 0..8)).prop_map(|(degree, rows)| {
            let mut scene = GaussianScene {
                degree: if rows.is_empty() { 0 } else { degree },
                ..GaussianScene::default()
            };
            for (mean, log_scale, quat, opacity, mut sh) in rows {
                let used = (usize::from(degree) + 1).pow(2);
                sh[used..].fill([0.0; 3]);
                // The last one in use is not zero.
                sh[used - 1][1] = 0.5;
                scene.means.push(mean);
                scene.log_scales.push(log_scale);
                scene.quats.push(quat);
                scene.opacity_logits.push(opacity);
                scene.sh.push(sh);
            }
            scene
        })
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_again(scene in scenes()) {
            let bytes = to_ply(&scene);
            prop_assert_eq!(bytes.len() as u64, ply_bytes(scene.len()));
            prop_assert_eq!(from_ply(&bytes).expect("a scene"), scene);
        }

        #[test]
        fn spoiled_files_are_refused_or_read_and_never_panic(
            scene in scenes(),
            at in any::<prop::sample::Index>(),
            byte in any::<u8>(),
        ) {
            let mut bytes = to_ply(&scene);
            let at = at.index(bytes.len());
            bytes[at] = byte;
            if let Ok(read) = from_ply(&bytes) {
                read.check().expect("what is read is sound");
            }
        }
    }

    fn scene() -> GaussianScene {
        let sh = std::array::from_fn(|k| [0, 1, 2].map(|channel| (10 * k + channel) as f32));
        GaussianScene {
            means: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            log_scales: vec![[-1.0, -2.0, -3.0]; 2],
            quats: vec![[0.5, 0.1, 0.2, 0.3]; 2],
            opacity_logits: vec![0.25, -0.25],
            sh: vec![sh; 2],
            degree: 3,
            ..GaussianScene::default()
        }
    }

    /// A file with the given columns and one row: each value is a hundred plus its column.
    fn file(properties: &[(&str, String)]) -> Vec<u8> {
        let mut text = "ply\nformat binary_little_endian 1.0\ncomment c\nelement vertex 1\n".to_owned();
        let mut data = Vec::new();
        for (at, (kind, name)) in properties.iter().enumerate() {
            text.push_str(&format!("property {kind} {name}\n"));
            match *kind {
                "double" => data.extend((100.0 + at as f64).to_le_bytes()),
                "uchar" => data.push(100 + at as u8),
                _ => data.extend((100.0 + at as f32).to_le_bytes()),
            }
        }
        text.push_str("end_header\n");
        [text.into_bytes(), data].concat()
    }

    fn floats(names: &[String]) -> Vec<(&'static str, String)> {
        names.iter().map(|name| ("float", name.clone())).collect()
    }

    #[test]
    fn columns_stand_where_other_programs_look_for_them() {
        let bytes = to_ply(&scene());
        let text = header(2);
        assert!(
            text.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n")
        );
        assert_eq!(text.matches("property float ").count(), 62);
        assert_eq!(bytes.len(), text.len() + 2 * 62 * 4);
        let row: Vec<f32> = bytes[text.len()..text.len() + 248]
            .chunks_exact(4)
            .map(|raw| f32::from_le_bytes(raw.try_into().expect("four")))
            .collect();
        assert_eq!(row[..9], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]);
        // Fifteen of red, then of green, then of blue.
        assert_eq!([row[9], row[10], row[23], row[24], row[53]], [10.0, 20.0, 150.0, 11.0, 152.0]);
        assert_eq!(row[54..], [0.25, -1.0, -2.0, -3.0, 0.5, 0.1, 0.2, 0.3]);
    }

    #[test]
    fn other_orders_further_properties_and_lower_degrees_are_read() {
        let mut properties = floats(&names(3));
        properties.retain(|(_, name)| !name.starts_with('n'));
        properties.reverse();
        properties.insert(0, ("uchar", "red".to_owned()));
        properties.insert(3, ("double", "weight".to_owned()));
        let read = from_ply(&file(&properties)).expect("a scene");
        let value = |name: &str| {
            100.0 + properties.iter().position(|(_, found)| found == name).expect("a column") as f32
        };
        assert_eq!(read.means, [["x", "y", "z"].map(value)]);
        assert_eq!(read.quats, [["rot_0", "rot_1", "rot_2", "rot_3"].map(value)]);
        assert_eq!(read.opacity_logits, [value("opacity")]);
        assert_eq!(read.degree, 1);
        assert_eq!(read.sh[0][1], ["f_rest_0", "f_rest_3", "f_rest_6"].map(value));
        assert_eq!(read.sh[0][4], [0.0; 3]);
        let flat = from_ply(&file(&floats(&names(0)))).expect("no f_rest at all");
        assert_eq!((flat.degree, flat.sh[0][1]), (0, [0.0; 3]));
    }

    #[test]
    fn no_prefix_is_accepted_and_neither_are_bytes_to_spare() {
        let whole = to_ply(&scene());
        for length in 0..whole.len() {
            assert!(from_ply(&whole[..length]).is_err(), "{length} of {} bytes", whole.len());
        }
        let longer = [&whole[..], &[0]].concat();
        assert!(matches!(from_ply(&longer), Err(PlyError::Length { vertices: 2, .. })));
    }

    #[test]
    fn every_fault_is_named() {
        let changed = |from: &str, to: &str| {
            let whole = to_ply(&scene());
            let text = header(2).replacen(from, to, 1);
            from_ply(&[text.into_bytes(), whole[header(2).len()..].to_vec()].concat()).expect_err(to)
        };
        assert_eq!(changed("ply", "PLY"), HeaderError::NotPly.into());
        assert_eq!(changed("end_header\n", "comment"), HeaderError::Unterminated.into());
        assert_eq!(
            changed("binary_little_endian", "ascii"),
            HeaderError::Encoding("ascii 1.0".to_owned()).into()
        );
        assert_eq!(changed("format binary_little_endian 1.0\n", ""), HeaderError::Missing("format").into());
        assert_eq!(changed("vertex 2", "chunk 2"), HeaderError::Element("chunk".to_owned()).into());
        assert!(matches!(
            changed("vertex 2", "vertex -2"),
            PlyError::Header(HeaderError::Line { number: 3, .. })
        ));
        assert!(matches!(
            changed("property float x", "preposition x"),
            PlyError::Header(HeaderError::Line { number: 4, .. })
        ));
        let huge = "vertex 18446744073709551615";
        assert!(matches!(changed("vertex 2", huge), PlyError::Length { found: 496, .. }));
        assert_eq!(changed("float y", "float x"), HeaderError::Twice("x".to_owned()).into());
        assert_eq!(changed("float opacity", "float opaque"), PlyError::MissingProperty("opacity".to_owned()));
        assert_eq!(changed("float f_rest_44", "float other"), PlyError::RestCount(44));
        assert_eq!(changed("float f_rest_44", "float f_rest_45"), {
            PlyError::MissingProperty("f_rest_44".to_owned())
        });
        assert_eq!(changed("float x", "int x"), PlyError::NotFloat("x".to_owned()));
        for (kind, found) in [("quad", "quad"), ("list uchar int", "list")] {
            let error = HeaderError::PropertyType { name: "x".to_owned(), kind: found.to_owned() };
            assert_eq!(changed("float x", &format!("{kind} x")), error.into());
        }
        let mut spoiled = to_ply(&scene());
        let last = spoiled.len() - 4;
        spoiled[last..].copy_from_slice(&f32::NAN.to_le_bytes());
        let error = PlyError::NotFinite { index: 1, property: "rot_3".to_owned() };
        assert_eq!(from_ply(&spoiled), Err(error));
    }

    #[test]
    fn opacities_of_nought_and_one_are_read_as_logits_that_are_finite() {
        for (logit, opacity) in [(f32::INFINITY, 1.0), (f32::NEG_INFINITY, 0.0)] {
            let opaque = GaussianScene { opacity_logits: vec![logit, 0.5], ..scene() };
            let read = from_ply(&to_ply(&opaque)).expect("a scene");
            read.check().expect("finite");
            let found = 1.0 / (1.0 + (-read.opacity_logits[0]).exp());
            assert!((found - opacity).abs() < 1e-5, "{found}");
        }
        let spoiled = GaussianScene { opacity_logits: vec![f32::NAN, 0.5], ..scene() };
        let error = PlyError::NotFinite { index: 0, property: "opacity".to_owned() };
        assert_eq!(from_ply(&to_ply(&spoiled)), Err(error));
    }

    #[test]
    fn packed_files_of_other_programs_are_refused_as_what_they_are() {
        // The header of compressed files, as SuperSplat and splat-transform write it.
        let header = "ply\nformat binary_little_endian 1.0\ncomment Generated by SuperSplat 2.2.3\nelement chunk 1\n\
        property float min_x\nproperty float max_x\nelement vertex 1\nproperty uint packed_position\nend_header\n";
        let bytes = [header.as_bytes(), &[0; 12]].concat();
        assert_eq!(from_ply(&bytes), Err(HeaderError::Element("chunk".to_owned()).into()));
    }
}
