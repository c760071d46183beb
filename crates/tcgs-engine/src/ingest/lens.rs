//! A camera as the dataset states it, before its image is read, and the pinhole intrinsics that follow from it.

use super::{
    distortion::Distortion,
    error::{IngestErrorKind, Result},
};
use crate::domain::{CameraError, Intrinsics};

/// Largest difference in pixels between a stored side and the evenly scaled stated side that rounding explains.
const ROUNDING: f64 = 1.0;

/// Focal length, as stated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Focal {
    /// In pixels of the stated size.
    Pixels {
        /// Horizontal.
        x: f64,
        /// Vertical.
        y: f64,
    },
    /// As fields of view in radians.
    FieldOfView {
        /// Horizontal.
        x: f64,
        /// Vertical; square pixels without it.
        y: Option<f64>,
    },
}

/// A stated camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lens {
    /// Focal length.
    pub(super) focal: Focal,
    /// Principal point in pixels of the stated size; the center if not stated.
    pub(super) principal: [Option<f64>; 2],
    /// Image size; that of the stored image if not stated.
    pub(super) size: Option<(u32, u32)>,
    /// Lens distortion.
    pub(super) distortion: Distortion,
}

impl Lens {
    /// Pinhole intrinsics, distortion aside, for a stored image of `actual` size.
    ///
    /// An image that is an evenly scaled-down copy of the stated size gets scaled intrinsics.
    ///
    /// # Errors
    /// [`IngestErrorKind::ImageSize`] or [`IngestErrorKind::ImageRotated`] for a size that does not fit, [`IngestErrorKind::Camera`] for values
    /// that describe no camera.
    pub(super) fn intrinsics(&self, actual: (u32, u32)) -> Result<Intrinsics> {
        let stated = self.size.unwrap_or(actual);
        if !self.fits(actual) {
            return Err(if actual == (stated.1, stated.0) {
                IngestErrorKind::ImageRotated { actual, stated }
            } else {
                IngestErrorKind::ImageSize { actual, stated }
            });
        }
        let (width, height) = (f64::from(stated.0), f64::from(stated.1));
        let (fx, fy) = match self.focal {
            Focal::Pixels { x, y } => (x, y),
            Focal::FieldOfView { x, y } => {
                let fx = focal_of(x, width);
                (fx, y.map_or(fx, |y| focal_of(y, height)))
            }
        };
        let [cx, cy] = self.principal;
        let full = Intrinsics {
            fx,
            fy,
            cx: cx.unwrap_or(width / 2.0),
            cy: cy.unwrap_or(height / 2.0),
            width: actual.0,
            height: actual.1,
        };
        // Scaling by exactly 1 keeps every bit, so the usual case needs no branch.
        let intrinsics = resized(full, stated, actual)
            .validated()
            .map_err(|source| IngestErrorKind::Camera { place: "its camera".to_owned(), source })?;
        plausible(intrinsics)
    }

    /// Whether an image of this size is what the camera states, or an evenly scaled-down copy of it. Any size fits a camera without one.
    pub(super) fn fits(&self, actual: (u32, u32)) -> bool {
        self.size.is_none_or(|stated| fits(actual, stated))
    }

    /// Checks everything that does not depend on the image.
    ///
    /// # Errors
    /// What is wrong with the focal length, the principal point or the size.
    pub(super) fn check(&self) -> Result<(), CameraError> {
        let size = self.size.unwrap_or((1, 1));
        if size.0 == 0 || size.1 == 0 {
            return Err(CameraError::ImageSize { width: size.0, height: size.1 });
        }
        let (fx, fy) = match self.focal {
            Focal::Pixels { x, y } => (x, y),
            Focal::FieldOfView { x, y } => (focal_of(x, 1.0), focal_of(y.unwrap_or(x), 1.0)),
        };
        let [cx, cy] = self.principal.map(|value| value.unwrap_or(0.0));
        Intrinsics { fx, fy, cx, cy, width: 1, height: 1 }.validated().map(|_| ())
    }
}

/// Checks that focal lengths and principal point are of the order of the image.
fn plausible(k: Intrinsics) -> Result<Intrinsics> {
    let sides = [f64::from(k.width), f64::from(k.height)];
    for (what, values, shares, range) in [
        ("the focal length", [k.fx, k.fy], 1e-2..=1e4, "0.01 to 10000 times the side of the image"),
        ("the principal point", [k.cx, k.cy], -10.0..=10.0, "within 10 times the side of the image"),
    ] {
        for (value, side) in values.into_iter().zip(sides) {
            if !shares.contains(&(value / side)) {
                return Err(IngestErrorKind::Implausible { what, value, range });
            }
        }
    }
    Ok(k)
}

/// Intrinsics of an image resized from `from` to `to` pixels: pixel coordinates scale with the sides.
pub(super) fn resized(intrinsics: Intrinsics, from: (u32, u32), to: (u32, u32)) -> Intrinsics {
    let (x, y) = (f64::from(to.0) / f64::from(from.0), f64::from(to.1) / f64::from(from.1));
    Intrinsics {
        fx: intrinsics.fx * x,
        fy: intrinsics.fy * y,
        cx: intrinsics.cx * x,
        cy: intrinsics.cy * y,
        width: to.0,
        height: to.1,
    }
}

/// Focal length for a field of view across `side` pixels; 0, which no camera has, outside of (0, pi).
fn focal_of(fov: f64, side: f64) -> f64 {
    if fov > 0.0 && fov < std::f64::consts::PI { side / (2.0 * (fov / 2.0).tan()) } else { 0.0 }
}

/// Whether one scale brings both stated sides to the actual ones, each of which was rounded to whole pixels.
fn fits(actual: (u32, u32), stated: (u32, u32)) -> bool {
    let scales = |actual: u32, stated: u32| {
        [-ROUNDING, ROUNDING].map(|rounding| (f64::from(actual) + rounding) / f64::from(stated))
    };
    let (across, down) = (scales(actual.0, stated.0), scales(actual.1, stated.1));
    let smaller = actual.0 < stated.0 && actual.1 <= stated.1;
    actual == stated || (smaller && across[0] <= down[1] && down[0] <= across[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lens(size: (u32, u32)) -> Lens {
        Lens {
            focal: Focal::Pixels { x: 800.0, y: 820.0 },
            principal: [Some(410.0), None],
            size: Some(size),
            distortion: Distortion::default(),
        }
    }

    #[test]
    fn an_evenly_smaller_image_scales_the_intrinsics_and_any_other_size_is_refused() {
        let half = lens((800, 600)).intrinsics((400, 300)).expect("half size");
        assert_eq!(half, Intrinsics { fx: 400.0, fy: 410.0, cx: 205.0, cy: 150.0, width: 400, height: 300 });
        let same = lens((800, 600)).intrinsics((800, 600)).expect("same size");
        assert_eq!((same.fx, same.cx, same.cy), (800.0, 410.0, 300.0));
        assert!(lens((1001, 667)).intrinsics((250, 166)).is_ok(), "a quarter, rounded down");
        // The rounded width is half a pixel too small, which is more than a pixel of the height.
        assert!(lens((3286, 4945)).intrinsics((822, 1236)).is_ok(), "an upright quarter, rounded");
        assert!(lens((3286, 4945)).intrinsics((822, 1230)).is_err());
        for actual in [(400, 290), (1600, 1200), (799, 600), (800, 599), (400, 600)] {
            let error = lens((800, 600)).intrinsics(actual);
            // One pixel is within rounding only when the width shrank too.
            if actual == (799, 600) {
                assert!(error.is_ok());
            } else {
                assert!(matches!(error, Err(IngestErrorKind::ImageSize { .. })), "{actual:?}: {error:?}");
            }
        }
        assert!(matches!(lens((800, 600)).intrinsics((600, 800)), Err(IngestErrorKind::ImageRotated { .. })));
    }

    #[test]
    fn fields_of_view_come_to_focal_lengths() {
        let right_angle = std::f64::consts::FRAC_PI_2;
        let mut lens =
            Lens { focal: Focal::FieldOfView { x: right_angle, y: None }, size: None, ..lens((1, 1)) };
        lens.principal = [None, None];
        let k = lens.intrinsics((200, 100)).expect("a camera");
        assert!((k.fx - 100.0).abs() < 1e-9 && k.fx == k.fy);
        assert_eq!((k.cx, k.cy), (100.0, 50.0));
        lens.focal = Focal::FieldOfView { x: right_angle, y: Some(right_angle) };
        assert!((lens.intrinsics((200, 100)).expect("a camera").fy - 50.0).abs() < 1e-9);
    }

    #[test]
    fn poison_values_describe_no_camera() {
        for poison in [0.0, -1.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for focal in [
                Focal::Pixels { x: poison, y: 1.0 },
                Focal::Pixels { x: 1.0, y: poison },
                Focal::FieldOfView { x: poison, y: None },
                Focal::FieldOfView { x: 1.0, y: Some(poison) },
            ] {
                assert!(Lens { focal, ..lens((8, 8)) }.check().is_err(), "{focal:?}");
                assert!(Lens { focal, ..lens((8, 8)) }.intrinsics((8, 8)).is_err(), "{focal:?}");
            }
        }
        for poison in [f64::MIN_POSITIVE, 1e-300, 1e300] {
            assert!(
                Lens { focal: Focal::Pixels { x: poison, y: 8.0 }, ..lens((8, 8)) }
                    .intrinsics((8, 8))
                    .is_err()
            );
            assert!(
                Lens { focal: Focal::Pixels { x: 8.0, y: poison }, ..lens((8, 8)) }
                    .intrinsics((8, 8))
                    .is_err()
            );
        }
        for poison in [-1e300, 1e300] {
            let error =
                Lens { principal: [Some(4.0), Some(poison)], ..lens((800, 800)) }.intrinsics((800, 800));
            assert!(matches!(error, Err(IngestErrorKind::Implausible { .. })), "{error:?}");
        }
        assert!(Lens { principal: [Some(f64::NAN), None], ..lens((8, 8)) }.check().is_err());
        assert!(lens((0, 8)).check().is_err());
    }
}
