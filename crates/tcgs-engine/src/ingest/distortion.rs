//! Removes lens distortion: a distorted photograph in, a pinhole photograph with the same focal lengths out.
//!
//! The output pixel at `p` shows the input at `distort(p)`, so no inverse is needed. Where that lies outside of the photograph there is
//! nothing to show; such borders are cropped, never filled, and the principal point moves with the crop.

use super::{
    error::{IngestErrorKind, Result},
    projection::Projection,
    sampling::bilinear,
};
use crate::domain::{Image, Intrinsics};

/// Least part of the width and of the height that must remain after cropping.
const MIN_REMAINING: f64 = 0.5;

/// Steps in which the radius is searched for the fold of the distortion polynomial.
const FOLD_STEPS: u32 = 4096;

/// Directions in which the fold of a [`Projection`] is searched, and steps in each.
const FOLD_DIRECTIONS: u32 = 16;
const PROJECTION_FOLD_STEPS: u32 = 512;

/// How a lens distorts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Distortion {
    /// By a polynomial, or not at all.
    Polynomial(Polynomial),
    /// By another camera model.
    Projection(Projection),
}

/// Radial and tangential coefficients in the convention of OpenCV and COLMAP.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Polynomial {
    /// k1..k4, factors of r², r⁴, r⁶ and r⁸.
    pub(super) radial: [f64; 4],
    /// p1 and p2.
    pub(super) tangential: [f64; 2],
}

/// The part of an undistorted image that is kept, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Crop {
    /// First column.
    pub(super) left: u32,
    /// First row.
    pub(super) top: u32,
    /// Columns.
    pub(super) width: u32,
    /// Rows.
    pub(super) height: u32,
}

impl Crop {
    /// The intrinsics of the cropped image.
    pub(super) fn of(&self, k: Intrinsics) -> Intrinsics {
        Intrinsics {
            cx: k.cx - f64::from(self.left),
            cy: k.cy - f64::from(self.top),
            width: self.width,
            height: self.height,
            ..k
        }
    }
}

impl Polynomial {
    /// The distorted position of a point on the plane at depth 1.
    fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, k3, k4] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// The square of the smallest radius, up to `largest`, where the distorted radius stops growing. Beyond it the polynomial
    /// folds back and describes no lens.
    fn fold(&self, largest: f64) -> f64 {
        let [k1, k2, k3, k4] = self.radial;
        (1..=FOLD_STEPS)
            .map(|step| largest * f64::from(step) / f64::from(FOLD_STEPS))
            .find(|r2| 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * (7.0 * k3 + r2 * 9.0 * k4))) <= 0.0)
            .unwrap_or(f64::INFINITY)
    }
}

impl Default for Distortion {
    fn default() -> Self {
        Self::Polynomial(Polynomial::default())
    }
}

impl Distortion {
    /// Whether there is none.
    pub(super) fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Whether every coefficient is finite.
    pub(super) fn is_finite(&self) -> bool {
        match self {
            Self::Polynomial(Polynomial { radial, tangential }) => {
                radial.iter().chain(tangential).all(|value| value.is_finite())
            }
            Self::Projection(projection) => projection.is_finite(),
        }
    }

    /// The distorted position of a point on the plane at depth 1; not finite if a lens does not see it.
    pub(super) fn distort(&self, point: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Polynomial(polynomial) => polynomial.distort(point),
            Self::Projection(projection) => projection.project(point),
        }
    }

    /// The square of the smallest radius, up to `largest`, from which on the model folds back and describes no lens.
    fn fold(&self, largest: f64) -> f64 {
        match self {
            Self::Polynomial(polynomial) => polynomial.fold(largest),
            Self::Projection(projection) => fold_of(projection, largest),
        }
    }

    /// The rectangle that undistortion keeps: fully covered by the photograph, grown from the principal point
    /// in the image's proportions as far as possible, then to each side as far as possible.
    ///
    /// # Errors
    /// [`IngestErrorKind::DistortionTooStrong`] if less than half of a side would remain.
    pub(super) fn covered(&self, k: &Intrinsics) -> Result<Crop> {
        let (width, height) = (k.width, k.height);
        if self.is_none() {
            return Ok(Crop { left: 0, top: 0, width, height });
        }
        let region = Region { distortion: self, k, fold: self.fold(largest_radius2(k)) };
        let start = |principal: f64, side: u32| (principal.floor().max(0.0) as u32).min(side - 1);
        let (x, y) = (start(k.cx, width), start(k.cy, height));
        // Edges as [left, top, right, bottom], the last two exclusive.
        let seed = [x, y, x + 1, y + 1];
        let full = [0, 0, width, height];
        let mut edges = seed;
        let steps = width.max(height);
        let towards = |step: u32| -> [u32; 4] {
            std::array::from_fn(|edge| {
                let (from, to) = (i64::from(seed[edge]), i64::from(full[edge]));
                (from + (to - from) * i64::from(step) / i64::from(steps)) as u32
            })
        };
        if region.covers(seed) {
            edges = towards(largest_true(0, steps, |step| region.covers(towards(step))));
            for edge in 0..4 {
                let (from, to) = (edges[edge], full[edge]);
                let with = |moved: u32| {
                    let mut edges = edges;
                    edges[edge] = if to < from { from - moved } else { from + moved };
                    edges
                };
                edges = with(largest_true(0, from.abs_diff(to), |moved| region.covers(with(moved))));
            }
        }
        let crop =
            Crop { left: edges[0], top: edges[1], width: edges[2] - edges[0], height: edges[3] - edges[1] };
        let remains = |part: u32, whole: u32| f64::from(part) >= MIN_REMAINING * f64::from(whole);
        if remains(crop.width, width) && remains(crop.height, height) {
            Ok(crop)
        } else {
            Err(IngestErrorKind::DistortionTooStrong)
        }
    }

    /// Whether the lens saw a point of the pinhole image, given in pixels.
    pub(super) fn visibility<'a>(&'a self, k: &'a Intrinsics) -> impl Fn([f64; 2]) -> bool + 'a {
        let fold = self.fold(largest_radius2(k));
        move |[x, y]| {
            let [x, y] = [(x - k.cx) / k.fx, (y - k.cy) / k.fy];
            let [u, v] = self.distort([x, y]);
            x * x + y * y < fold
                && (0.0..=f64::from(k.width)).contains(&(k.fx * u + k.cx))
                && (0.0..=f64::from(k.height)).contains(&(k.fy * v + k.cy))
        }
    }

    /// The pinhole image inside `crop` from a photograph with intrinsics `k`.
    pub(super) fn undistort(&self, image: &Image, k: &Intrinsics, crop: Crop) -> Image {
        if self.is_none() {
            return image.clone();
        }
        let mut samples =
            Vec::with_capacity(crop.width as usize * crop.height as usize * usize::from(image.channels()));
        for row in crop.top..crop.top + crop.height {
            for column in crop.left..crop.left + crop.width {
                let [x, y] = source(self, k, column, row);
                bilinear(image, x, y, &mut samples);
            }
        }
        Image::new(crop.width, crop.height, image.channels(), samples)
            .expect("one sample a channel was written for each pixel of a non-empty crop of an image")
    }
}

/// As [`Polynomial::fold`], from the sign of the projection's Jacobian along rays from the axis.
fn fold_of(projection: &Projection, largest: f64) -> f64 {
    const STEP: f64 = 1e-6;
    let keeps_sides = |[x, y]: [f64; 2]| {
        let difference = |a: [f64; 2], b: [f64; 2]| [a[0] - b[0], a[1] - b[1]];
        let [xx, xy] = difference(projection.project([x + STEP, y]), projection.project([x - STEP, y]));
        let [yx, yy] = difference(projection.project([x, y + STEP]), projection.project([x, y - STEP]));
        xx * yy - xy * yx > 0.0 && xx + yy > 0.0
    };
    let ray = |radius: f64| {
        let angles = (0..FOLD_DIRECTIONS)
            .map(|index| std::f64::consts::TAU * f64::from(index) / f64::from(FOLD_DIRECTIONS));
        angles.map(move |angle| [radius * angle.cos(), radius * angle.sin()])
    };
    (1..=PROJECTION_FOLD_STEPS)
        .map(|step| largest.sqrt() * f64::from(step) / f64::from(PROJECTION_FOLD_STEPS))
        .find(|radius| !ray(*radius).all(keeps_sides))
        .map_or(f64::INFINITY, |radius| radius * radius)
}

/// Where in the photograph (pixel coordinates) the center of an undistorted pixel comes from.
fn source(distortion: &Distortion, k: &Intrinsics, column: u32, row: u32) -> [f64; 2] {
    let [x, y] = distortion.distort(plane_point(k, column, row));
    [k.fx * x + k.cx, k.fy * y + k.cy]
}

fn plane_point(k: &Intrinsics, column: u32, row: u32) -> [f64; 2] {
    [(f64::from(column) + 0.5 - k.cx) / k.fx, (f64::from(row) + 0.5 - k.cy) / k.fy]
}

fn largest_radius2(k: &Intrinsics) -> f64 {
    let far = |principal: f64, side: u32, focal: f64| {
        principal.abs().max((f64::from(side) - principal).abs()) / focal
    };
    far(k.cx, k.width, k.fx).powi(2) + far(k.cy, k.height, k.fy).powi(2)
}

struct Region<'a> {
    distortion: &'a Distortion,
    k: &'a Intrinsics,
    fold: f64,
}

impl Region<'_> {
    /// Whether every pixel on the rim of the rectangle is covered; the covered region has no holes.
    fn covers(&self, [left, top, right, bottom]: [u32; 4]) -> bool {
        (left..right).all(|x| self.has(x, top) && self.has(x, bottom - 1))
            && (top..bottom).all(|y| self.has(left, y) && self.has(right - 1, y))
    }

    fn has(&self, column: u32, row: u32) -> bool {
        let [x, y] = plane_point(self.k, column, row);
        let [u, v] = source(self.distortion, self.k, column, row);
        x * x + y * y < self.fold
            && (0.0..=f64::from(self.k.width)).contains(&u)
            && (0.0..=f64::from(self.k.height)).contains(&v)
    }
}

/// The largest value in `low..=high` that `holds`, where it holds at `low` and, once it fails, fails beyond.
fn largest_true(mut low: u32, mut high: u32, holds: impl Fn(u32) -> bool) -> u32 {
    if holds(high) {
        return high;
    }
    while high - low > 1 {
        let middle = low + (high - low) / 2;
        if holds(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 90.0, fy: 95.0, cx: 66.0, cy: 45.0, width: 128, height: 96 };

    fn distortion(radial: [f64; 4], tangential: [f64; 2]) -> Distortion {
        Distortion::Polynomial(Polynomial { radial, tangential })
    }

    /// A smooth scene as a function of the direction of view.
    fn scene([x, y]: [f64; 2]) -> [f64; 3] {
        [
            128.0 + 100.0 * (6.0 * x).sin(),
            128.0 + 100.0 * (5.0 * y).cos(),
            128.0 + 90.0 * (4.0 * (x + y)).sin(),
        ]
    }

    /// The photograph that a lens takes of the scene: each pixel shows the direction whose distortion is there.
    fn photograph(lens: &Distortion) -> Image {
        let mut samples = Vec::new();
        for row in 0..K.height {
            for column in 0..K.width {
                let target = plane_point(&K, column, row);
                let mut direction = target;
                for _ in 0..50 {
                    let [x, y] = lens.distort(direction);
                    direction = [direction[0] + target[0] - x, direction[1] + target[1] - y];
                }
                samples.extend(scene(direction).map(|value| value.round() as u8));
            }
        }
        Image::new(K.width, K.height, 3, samples).expect("an image")
    }

    #[test]
    fn undistorted_photographs_show_the_pinhole_scene() {
        for lens in [
            distortion([-0.14, 0.0, 0.0, 0.0], [0.0; 2]),
            distortion([0.058, -0.08, 0.0, 0.0], [-0.00098, 0.00016]),
            distortion([0.12, 0.02, 0.01, 0.002], [0.004, -0.003]),
        ] {
            let crop = lens.covered(&K).expect("a moderate lens");
            let image = lens.undistort(&photograph(&lens), &K, crop);
            let cropped = crop.of(K);
            assert_eq!((image.width(), image.height()), (cropped.width, cropped.height));
            let mut worst: f64 = 0.0;
            for row in 0..image.height() {
                for column in 0..image.width() {
                    let expected = scene(plane_point(&cropped, column, row));
                    let at = (row as usize * image.width() as usize + column as usize) * 3;
                    for (actual, expected) in image.samples()[at..at + 3].iter().zip(expected) {
                        worst = worst.max((f64::from(*actual) - expected).abs());
                    }
                }
            }
            // Rounding twice and interpolating a pattern of about 90 pixels a period come to less than 2 of 255;
            // a sign error in any term is worth 10 and more.
            assert!(worst < 2.5, "{lens:?}: {worst}");
        }
    }

    fn projections() -> [Distortion; 9] {
        [
            Projection::Rational { radial: [0.3, -0.05, 0.01, 0.35, 0.02, 0.0], tangential: [0.003, -0.002] },
            Projection::Fov { omega: 0.9 },
            Projection::Fov { omega: 0.0 },
            Projection::Fisheye { radial: [0.0; 4] },
            Projection::Fisheye { radial: [-0.03, 0.012, -0.004, 0.0008] },
            Projection::ThinPrismFisheye {
                radial: [-0.03, 0.012, 0.0, 0.0],
                tangential: [0.002, -0.001],
                prism: [0.0015, -0.0012],
            },
            Projection::RadTanThinPrismFisheye {
                radial: [-0.03, 0.012, 0.0, 0.0, 0.0, 0.0],
                tangential: [0.002, -0.001],
                prism: [0.0015, -0.0003, -0.0012, 0.0002],
            },
            Projection::Division { k: -0.2 },
            Projection::EnhancedUnified { alpha: 0.6, beta: 1.1 },
        ]
        .map(Distortion::Projection)
    }

    #[test]
    fn undistorted_photographs_of_every_model_show_the_pinhole_scene() {
        for lens in projections() {
            let crop = lens.covered(&K).expect("a usual lens");
            let lost = 1.0 - f64::from(crop.width * crop.height) / f64::from(K.width * K.height);
            assert!(lost < 0.05, "{lens:?} loses {lost}");
            let image = lens.undistort(&photograph(&lens), &K, crop);
            let cropped = crop.of(K);
            for row in 0..image.height() {
                for column in 0..image.width() {
                    let expected = scene(plane_point(&cropped, column, row));
                    let at = (row as usize * image.width() as usize + column as usize) * 3;
                    for (actual, expected) in image.samples()[at..at + 3].iter().zip(expected) {
                        let difference = (f64::from(*actual) - expected).abs();
                        assert!(difference < 4.0, "{lens:?} ({column}, {row}): {difference}");
                    }
                }
            }
        }
    }

    #[test]
    fn models_of_no_lens_are_refused() {
        let lenses = [
            Projection::Rational { radial: [0.0, 0.0, 0.0, -30.0, 0.0, 0.0], tangential: [0.0; 2] },
            Projection::Rational { radial: [0.0; 6], tangential: [1e6, 0.0] },
            Projection::Fov { omega: 4.0 },
            Projection::Fov { omega: -1e300 },
            Projection::Fisheye { radial: [-9.0, 0.0, 0.0, 0.0] },
            Projection::Fisheye { radial: [1e308; 4] },
            Projection::ThinPrismFisheye { radial: [0.0; 4], tangential: [0.0; 2], prism: [1e9, -1e9] },
            Projection::RadTanThinPrismFisheye {
                radial: [-1e300; 6],
                tangential: [1e300; 2],
                prism: [1e300; 4],
            },
            Projection::Division { k: 1e9 },
            Projection::EnhancedUnified { alpha: 0.5, beta: -9.0 },
            Projection::EnhancedUnified { alpha: -1e300, beta: 1e300 },
        ];
        for projection in lenses {
            let lens = Distortion::Projection(projection);
            assert!(matches!(lens.covered(&K), Err(IngestErrorKind::DistortionTooStrong)), "{lens:?}");
        }
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_models_never_panic(
            kind in 0..7,
            p in proptest::array::uniform12(proptest::prelude::any::<f64>()),
        ) {
            let [a, b, c, d, e, f, g, h, i, j, k, l] = p;
            let projection = match kind {
                0 => Projection::Rational { radial: [a, b, c, d, e, f], tangential: [g, h] },
                1 => Projection::Fov { omega: a },
                2 => Projection::Fisheye { radial: [a, b, c, d] },
                3 => Projection::ThinPrismFisheye { radial: [a, b, c, d], tangential: [e, f], prism: [g, h] },
                4 => Projection::Division { k: a },
                5 => Projection::EnhancedUnified { alpha: a, beta: b },
                _ => Projection::RadTanThinPrismFisheye {
                    radial: [a, b, c, d, e, f],
                    tangential: [g, h],
                    prism: [i, j, k, l],
                },
            };
            let lens = Distortion::Projection(projection);
            if let Ok(crop) = lens.covered(&K) {
                let image = Image::new(K.width, K.height, 3, vec![7; (K.width * K.height * 3) as usize]);
                let _pixels = lens.undistort(&image.expect("an image"), &K, crop);
            }
        }
    }

    #[test]
    fn what_is_kept_is_covered_and_cannot_grow() {
        for lens in [
            distortion([0.2, 0.0, 0.0, 0.0], [0.0; 2]),
            distortion([0.058, -0.08, 0.0, 0.0], [-0.01, 0.016]),
            distortion([0.0; 4], [0.02, 0.02]),
        ] {
            let crop = lens.covered(&K).expect("a moderate lens");
            let (right, bottom) = (crop.left + crop.width, crop.top + crop.height);
            let region = Region { distortion: &lens, k: &K, fold: f64::INFINITY };
            for row in crop.top..bottom {
                for column in crop.left..right {
                    assert!(region.has(column, row), "{lens:?} ({column}, {row})");
                }
            }
            let grown = [
                (crop.left > 0).then(|| [crop.left - 1, crop.top, right, bottom]),
                (crop.top > 0).then(|| [crop.left, crop.top - 1, right, bottom]),
                (right < K.width).then_some([crop.left, crop.top, right + 1, bottom]),
                (bottom < K.height).then_some([crop.left, crop.top, right, bottom + 1]),
            ];
            for edges in grown.into_iter().flatten() {
                assert!(!region.covers(edges), "{lens:?}: {crop:?} could grow to {edges:?}");
            }
        }
    }

    #[test]
    fn barrel_distortion_keeps_the_whole_image_and_none_changes_nothing() {
        let whole = Crop { left: 0, top: 0, width: K.width, height: K.height };
        assert_eq!(distortion([-0.1, 0.0, 0.0, 0.0], [0.0; 2]).covered(&K).expect("a lens"), whole);
        let none = Distortion::default();
        assert_eq!(none.covered(&K).expect("no lens"), whole);
        let image = photograph(&none);
        assert_eq!(none.undistort(&image, &K, whole), image);
    }

    #[test]
    fn lenses_that_fold_or_leave_the_image_are_refused() {
        for lens in [
            distortion([-3.0, 0.0, 0.0, 0.0], [0.0; 2]),
            distortion([50.0, 0.0, 0.0, 0.0], [0.0; 2]),
            distortion([0.0; 4], [1e6, 0.0]),
            distortion([1e300, 1e300, 1e300, 1e300], [1e300, -1e300]),
        ] {
            assert!(matches!(lens.covered(&K), Err(IngestErrorKind::DistortionTooStrong)), "{lens:?}");
        }
        let far_off = Intrinsics { cx: -1e6, ..K };
        assert!(distortion([0.1, 0.0, 0.0, 0.0], [0.0; 2]).covered(&far_off).is_err());
    }
}
