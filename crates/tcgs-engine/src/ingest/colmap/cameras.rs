//! The camera models of COLMAP: their numbers, names and parameters, and the lens each describes.

use super::super::{
    distortion::Distortion,
    error::{IngestErrorKind, Result},
    lens::{Focal, Lens},
};

/// Models by the number that binary files use. Those without a parameter count are known but not supported.
const MODELS: [(&str, Option<usize>); 12] = [
    ("SIMPLE_PINHOLE", Some(3)),
    ("PINHOLE", Some(4)),
    ("SIMPLE_RADIAL", Some(4)),
    ("RADIAL", Some(5)),
    ("OPENCV", Some(8)),
    ("OPENCV_FISHEYE", None),
    ("FULL_OPENCV", Some(12)),
    ("FOV", None),
    ("SIMPLE_RADIAL_FISHEYE", None),
    ("RADIAL_FISHEYE", None),
    ("THIN_PRISM_FISHEYE", None),
    ("RAD_TAN_THIN_PRISM_FISHEYE", None),
];

/// Fewest parameters of any supported model.
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
        let (f, c, [k1, k2, k3], tangential) = match (self.model, self.parameters.as_slice()) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], [0.0; 3], [0.0; 2]),
            ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], [0.0; 3], [0.0; 2]),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], [k, 0.0, 0.0], [0.0; 2]),
            ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], [k1, k2, 0.0], [0.0; 2]),
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], [k1, k2, 0.0], [p1, p2]),
            ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                // k4, k5 and k6 are the polynomial that the radial one is divided by.
                let denominator = [k4, k5, k6];
                if denominator.iter().any(|k| !k.is_finite()) {
                    return Err(IngestErrorKind::NonFiniteDistortion { place });
                }
                if denominator != [0.0; 3] {
                    return Err(unsupported(self.id, "FULL_OPENCV with k4, k5 or k6".to_owned()));
                }
                ([fx, fy], [cx, cy], [k1, k2, k3], [p1, p2])
            }
            (model, parameters) => {
                let message = format!("{model} does not have {} parameters", parameters.len());
                return Err(IngestErrorKind::Record { place, message });
            }
        };
        let (Ok(width), Ok(height)) = (u32::try_from(self.width), u32::try_from(self.height)) else {
            let message = format!("the image size {}x{} is not possible", self.width, self.height);
            return Err(IngestErrorKind::Record { place, message });
        };
        let lens = Lens {
            focal: Focal::Pixels { x: f[0], y: f[1] },
            principal: c.map(Some),
            size: Some((width, height)),
            distortion: Distortion { radial: [k1, k2, k3, 0.0], tangential },
        };
        if !lens.distortion.is_finite() {
            return Err(IngestErrorKind::NonFiniteDistortion { place });
        }
        lens.check().map_err(|source| IngestErrorKind::Camera { place, source })?;
        Ok(lens)
    }
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
                distortion: Distortion { radial: [radial[0], radial[1], 0.0, 0.0], tangential },
            };
            assert_eq!(record(model, &parameters).lens().expect(model), expected);
        }
    }

    #[test]
    fn numbers_are_those_of_colmap_and_other_models_are_named() {
        for (number, name) in
            ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"].iter().enumerate()
        {
            assert_eq!(model_by_number(3, number as i32).expect("supported").0, *name);
        }
        for (number, name) in [(5, "OPENCV_FISHEYE"), (7, "FOV"), (99, "number 99"), (-1, "number -1")] {
            let error = model_by_number(3, number).expect_err(name).to_string();
            assert!(error.starts_with(&format!("camera 3: camera model {name} is not supported")), "{error}");
        }
        assert!(model_by_name(3, "OPENCV_FISHEYE").is_err() && model_by_name(3, "pinhole").is_err());
    }

    #[test]
    fn full_opencv_is_its_simpler_camera_where_nothing_is_divided() {
        assert_eq!(model_by_name(3, "FULL_OPENCV").expect("a model"), ("FULL_OPENCV", 12));
        assert_eq!(model_by_number(3, 6).expect("a model"), ("FULL_OPENCV", 12));
        let opencv = [9.0, 8.0, 1.0, 2.0, 0.1, 0.2, 0.3, 0.4];
        let full = |extra: [f64; 4]| record("FULL_OPENCV", &[&opencv[..], &extra].concat()).lens();
        assert_eq!(full([0.0; 4]).expect("a lens"), record("OPENCV", &opencv).lens().expect("a lens"));
        assert_eq!(full([0.5, 0.0, 0.0, 0.0]).expect("a lens").distortion.radial, [0.1, 0.2, 0.5, 0.0]);
        for extra in [[0.0, 0.1, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 0.1]] {
            let error = full(extra).expect_err("a division").to_string();
            assert!(error.contains("FULL_OPENCV with k4, k5 or k6 is not supported"), "{error}");
        }
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
