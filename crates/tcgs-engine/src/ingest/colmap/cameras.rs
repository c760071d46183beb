//! The camera models of COLMAP: their numbers, names and parameters, and the lens each describes.

use super::super::{
    distortion::{Distortion, Polynomial},
    error::{IngestErrorKind, Result},
    lens::{Focal, Lens},
    projection::Projection,
};

/// Models by the number that binary files use, with their numbers of parameters. Those without are known but not read.
const MODELS: [(&str, Option<usize>); 18] = [
    ("SIMPLE_PINHOLE", Some(3)),
    ("PINHOLE", Some(4)),
    ("SIMPLE_RADIAL", Some(4)),
    ("RADIAL", Some(5)),
    ("OPENCV", Some(8)),
    ("OPENCV_FISHEYE", Some(8)),
    ("FULL_OPENCV", Some(12)),
    ("FOV", Some(5)),
    ("SIMPLE_RADIAL_FISHEYE", Some(4)),
    ("RADIAL_FISHEYE", Some(5)),
    ("THIN_PRISM_FISHEYE", Some(12)),
    ("RAD_TAN_THIN_PRISM_FISHEYE", Some(16)),
    ("SIMPLE_DIVISION", Some(4)),
    ("DIVISION", Some(5)),
    ("SIMPLE_FISHEYE", Some(3)),
    ("FISHEYE", Some(4)),
    ("EUCM", Some(6)),
    ("EQUIRECTANGULAR", None),
];

/// Fewest parameters of any model.
pub(super) const MIN_PARAMETERS: usize = 3;

/// A row of the cameras table.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct CameraRecord {
    pub(super) id: u32,
    /// As COLMAP names it.
    pub(super) model: &'static str,
    pub(super) width: u64,
    pub(super) height: u64,
    pub(super) parameters: Vec<f64>,
}

/// Name and parameter count of a model by its number in binary files.
///
/// # Errors
/// [`IngestErrorKind::CameraModel`] for unknown and unsupported models.
pub(super) fn model_by_number(camera: u32, number: i32) -> Result<(&'static str, usize)> {
    match usize::try_from(number).ok().and_then(|number| MODELS.get(number)) {
        Some((name, Some(parameters))) => Ok((name, *parameters)),
        Some((name, None)) => Err(unsupported(camera, (*name).to_owned())),
        None => Err(unsupported(camera, format!("number {number}"))),
    }
}

/// As [`model_by_number`], by the name that text files use.
///
/// # Errors
/// [`IngestErrorKind::CameraModel`].
pub(super) fn model_by_name(camera: u32, name: &str) -> Result<(&'static str, usize)> {
    MODELS
        .iter()
        .find_map(|(known, parameters)| Some((*known, (*parameters)?)).filter(|_| *known == name))
        .ok_or_else(|| unsupported(camera, name.chars().take(40).collect()))
}

fn unsupported(camera: u32, model: String) -> IngestErrorKind {
    if model == "EQUIRECTANGULAR" {
        return IngestErrorKind::Panorama { place: place(camera), model };
    }
    IngestErrorKind::CameraModel { place: place(camera), model }
}

fn place(camera: u32) -> String {
    format!("camera {camera}")
}

impl CameraRecord {
    /// The lens that the record describes.
    ///
    /// # Errors
    /// [`IngestErrorKind::Record`], [`IngestErrorKind::NonFiniteDistortion`] or [`IngestErrorKind::Camera`].
    pub(super) fn lens(&self) -> Result<Lens> {
        let place = place(self.id);
        let (f, c, distortion) = model(self.model, &self.parameters).ok_or_else(|| {
            let message = format!("{} does not have {} parameters", self.model, self.parameters.len());
            IngestErrorKind::Record { place: place.clone(), message }
        })?;
        let (Ok(width), Ok(height)) = (u32::try_from(self.width), u32::try_from(self.height)) else {
            let message = format!("the image size {}x{} is not possible", self.width, self.height);
            return Err(IngestErrorKind::Record { place, message });
        };
        let lens = Lens {
            focal: Focal::Pixels { x: f[0], y: f[1] },
            principal: c.map(Some),
            size: Some((width, height)),
            distortion,
        };
        if !lens.distortion.is_finite() {
            return Err(IngestErrorKind::NonFiniteDistortion { place });
        }
        lens.check().map_err(|source| IngestErrorKind::Camera { place, source })?;
        Ok(lens)
    }
}

/// Focal lengths, principal point and distortion of a model; `None` for another number of parameters than it has.
fn model(name: &str, parameters: &[f64]) -> Option<([f64; 2], [f64; 2], Distortion)> {
    let polynomial =
        |k1, k2, k3, tangential| Distortion::Polynomial(Polynomial { radial: [k1, k2, k3, 0.0], tangential });
    let one = ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"];
    let has_one = one.contains(&name) || matches!(name, "SIMPLE_DIVISION" | "SIMPLE_FISHEYE");
    let (f, c, rest) = match parameters {
        [f, cx, cy, rest @ ..] if has_one => ([*f; 2], [*cx, *cy], rest),
        [fx, fy, cx, cy, rest @ ..] if !has_one => ([*fx, *fy], [*cx, *cy], rest),
        _ => return None,
    };
    let fisheye = |radial| Distortion::Projection(Projection::Fisheye { radial });
    let distortion = match (name, rest) {
        ("SIMPLE_PINHOLE" | "PINHOLE", []) => polynomial(0.0, 0.0, 0.0, [0.0; 2]),
        ("SIMPLE_RADIAL", &[k]) => polynomial(k, 0.0, 0.0, [0.0; 2]),
        ("RADIAL", &[k1, k2]) => polynomial(k1, k2, 0.0, [0.0; 2]),
        ("OPENCV", &[k1, k2, p1, p2]) => polynomial(k1, k2, 0.0, [p1, p2]),
        // Nothing is divided.
        ("FULL_OPENCV", &[k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) => polynomial(k1, k2, k3, [p1, p2]),
        ("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6]) => Distortion::Projection(Projection::Rational {
            radial: [k1, k2, k3, k4, k5, k6],
            tangential: [p1, p2],
        }),
        ("FOV", &[omega]) => Distortion::Projection(Projection::Fov { omega }),
        ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => fisheye([k1, k2, k3, k4]),
        ("SIMPLE_FISHEYE" | "FISHEYE", []) => fisheye([0.0; 4]),
        ("SIMPLE_RADIAL_FISHEYE", &[k]) => fisheye([k, 0.0, 0.0, 0.0]),
        ("RADIAL_FISHEYE", &[k1, k2]) => fisheye([k1, k2, 0.0, 0.0]),
        ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, sx1, sy1]) => {
            Distortion::Projection(Projection::ThinPrismFisheye {
                radial: [k1, k2, k3, k4],
                tangential: [p1, p2],
                prism: [sx1, sy1],
            })
        }
        ("RAD_TAN_THIN_PRISM_FISHEYE", &[k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
            Distortion::Projection(Projection::RadTanThinPrismFisheye {
                radial: [k0, k1, k2, k3, k4, k5],
                tangential: [p0, p1],
                prism: [s0, s1, s2, s3],
            })
        }
        ("SIMPLE_DIVISION" | "DIVISION", &[k]) => Distortion::Projection(Projection::Division { k }),
        ("EUCM", &[alpha, beta]) => Distortion::Projection(Projection::EnhancedUnified { alpha, beta }),
        _ => return None,
    };
    Some((f, c, distortion))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(model: &'static str, parameters: &[f64]) -> CameraRecord {
        CameraRecord { id: 3, model, width: 64, height: 48, parameters: parameters.to_vec() }
    }

    #[test]
    fn parameters_are_in_the_order_of_each_model() {
        for (model, parameters, focal, radial, tangential) in [
            ("SIMPLE_PINHOLE", vec![9.0, 1.0, 2.0], [9.0, 9.0], [0.0; 2], [0.0; 2]),
            ("PINHOLE", vec![9.0, 8.0, 1.0, 2.0], [9.0, 8.0], [0.0; 2], [0.0; 2]),
            ("SIMPLE_RADIAL", vec![9.0, 1.0, 2.0, 0.1], [9.0, 9.0], [0.1, 0.0], [0.0; 2]),
            ("RADIAL", vec![9.0, 1.0, 2.0, 0.1, 0.2], [9.0, 9.0], [0.1, 0.2], [0.0; 2]),
            ("OPENCV", vec![9.0, 8.0, 1.0, 2.0, 0.1, 0.2, 0.3, 0.4], [9.0, 8.0], [0.1, 0.2], [0.3, 0.4]),
        ] {
            assert_eq!(model_by_name(3, model).expect(model), (model, parameters.len()));
            let expected = Lens {
                focal: Focal::Pixels { x: focal[0], y: focal[1] },
                principal: [Some(1.0), Some(2.0)],
                size: Some((64, 48)),
                distortion: Distortion::Polynomial(Polynomial {
                    radial: [radial[0], radial[1], 0.0, 0.0],
                    tangential,
                }),
            };
            assert_eq!(record(model, &parameters).lens().expect(model), expected);
        }
    }

    #[test]
    fn models_are_those_of_colmap_and_others_are_named() {
        for (number, (name, parameters)) in MODELS.iter().enumerate() {
            let Some(parameters) = parameters else { continue };
            assert_eq!(model_by_number(3, number as i32).expect("a model"), (*name, *parameters));
            assert_eq!(model_by_name(3, name).expect("a model"), (*name, *parameters));
            assert!(model(name, &vec![0.1; *parameters]).is_some(), "{name}");
            for other in [parameters - 1, parameters + 1] {
                assert!(model(name, &vec![0.1; other]).is_none(), "{name} with {other}");
            }
        }
        for (number, name) in [(18, "number 18"), (99, "number 99"), (-1, "number -1")] {
            let error = model_by_number(3, number).expect_err(name).to_string();
            assert!(error.starts_with(&format!("camera 3: camera model {name} is not supported")), "{error}");
        }
        assert!(model_by_name(3, "pinhole").is_err());
        for error in [
            model_by_number(3, 17).expect_err("a sphere"),
            model_by_name(3, "EQUIRECTANGULAR").expect_err("a sphere"),
        ] {
            assert!(error.to_string().contains("camera 3: EQUIRECTANGULAR pictures show"), "{error}");
        }
    }

    /// What pycolmap projects, by `tests/oracles/cameras.py`.
    #[test]
    fn projections_are_those_of_pycolmap() {
        #[derive(serde::Deserialize)]
        struct Oracle {
            size: [u64; 2],
            points: Vec<[f64; 3]>,
            cameras: Vec<OracleCamera>,
        }
        #[derive(serde::Deserialize)]
        struct OracleCamera {
            model: String,
            number: i32,
            parameters: Vec<f64>,
            pixels: Vec<[f64; 2]>,
        }
        let oracle: Oracle =
            serde_json::from_str(include_str!("../../../../../tests/oracles/cameras.json")).expect("JSON");
        assert_eq!(oracle.cameras.len(), MODELS.len() - 1);
        for OracleCamera { model, number, parameters, pixels } in oracle.cameras {
            let (model, count) = model_by_name(1, &model).expect("a model");
            assert_eq!(
                (model_by_number(1, number).expect("a model"), parameters.len()),
                ((model, count), count)
            );
            let [width, height] = oracle.size;
            let lens = CameraRecord { id: 1, model, width, height, parameters }.lens().expect(model);
            let k = lens.intrinsics((width as u32, height as u32)).expect(model);
            for ([x, y, z], [u, v]) in oracle.points.iter().zip(pixels) {
                let [a, b] = lens.distortion.distort([x / z, y / z]);
                let distance = (k.fx * a + k.cx - u).hypot(k.fy * b + k.cy - v);
                assert!(distance < 1e-4, "{model}: {distance} pixels at {x}, {y}, {z}");
            }
        }
    }

    #[test]
    fn full_opencv_is_its_simpler_camera_where_nothing_is_divided() {
        let opencv = [9.0, 8.0, 1.0, 2.0, 0.1, 0.2, 0.3, 0.4];
        let full = |extra: [f64; 4]| record("FULL_OPENCV", &[&opencv[..], &extra].concat()).lens();
        assert_eq!(full([0.0; 4]).expect("a lens"), record("OPENCV", &opencv).lens().expect("a lens"));
        let cubic = Polynomial { radial: [0.1, 0.2, 0.5, 0.0], tangential: [0.3, 0.4] };
        assert_eq!(full([0.5, 0.0, 0.0, 0.0]).expect("a lens").distortion, Distortion::Polynomial(cubic));
        assert!(matches!(full([0.0, 0.1, 0.0, 0.0]).expect("a lens").distortion, Distortion::Projection(_)));
        assert!(matches!(full([0.0, f64::NAN, 0.0, 0.0]), Err(IngestErrorKind::NonFiniteDistortion { .. })));
    }

    #[test]
    fn poison_parameters_are_refused() {
        for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for at in 0..8 {
                let mut parameters = [9.0, 8.0, 1.0, 2.0, 0.1, 0.2, 0.3, 0.4];
                parameters[at] = poison;
                assert!(record("OPENCV", &parameters).lens().is_err(), "{poison} at {at}");
            }
        }
        assert!(record("PINHOLE", &[0.0, 1.0, 1.0, 1.0]).lens().is_err(), "zero focal length");
        assert!(record("PINHOLE", &[1.0, 1.0, 1.0]).lens().is_err(), "too few parameters");
        let huge = CameraRecord { width: u64::MAX, ..record("SIMPLE_PINHOLE", &[9.0, 1.0, 2.0]) };
        assert!(huge.lens().is_err());
        let empty = CameraRecord { width: 0, ..record("SIMPLE_PINHOLE", &[9.0, 1.0, 2.0]) };
        assert!(empty.lens().is_err());
    }
}
