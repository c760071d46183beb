//! Which pixels of an undistorted photograph the lens saw, where a crop to them would lose too much.
//!
//! The five models of earlier versions are always cropped, so that their runs keep their bits.

use super::{
    distortion::{Crop, Distortion},
    error::{IngestErrorKind, Result},
};
use crate::domain::{Intrinsics, PixelMask};

/// The largest part of a photograph that a crop may lose.
const MAX_LOST: f64 = 0.05;

/// The smallest part of the pixels that must be valid.
const MIN_VALID: f64 = 0.25;

/// Columns and rows of pixels that are looked at to learn how many are valid.
const SAMPLES: u32 = 64;

/// How many source pixels on each side of one the filter for downscaling takes into account, at a scale of 1.
const FILTER_SUPPORT: f64 = 2.0;

/// What undistortion keeps of a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Kept {
    /// The rectangle.
    pub(super) crop: Crop,
    /// Whether it has pixels that the lens did not see.
    pub(super) is_masked: bool,
}

/// The rectangle that the lens saw, or the whole with a mask if that loses more than a twentieth.
///
/// # Errors
/// [`IngestErrorKind::DistortionTooStrong`] if too little remains either way.
pub(super) fn kept(distortion: &Distortion, k: &Intrinsics) -> Result<Kept> {
    let cropped = distortion.covered(k).map(|crop| Kept { crop, is_masked: false });
    if matches!(distortion, Distortion::Polynomial(_)) {
        return cropped;
    }
    let pixels = |width: u32, height: u32| f64::from(width) * f64::from(height);
    let whole = Crop { left: 0, top: 0, width: k.width, height: k.height };
    match cropped {
        Ok(Kept { crop, .. })
            if pixels(crop.width, crop.height) >= (1.0 - MAX_LOST) * pixels(k.width, k.height) =>
        {
            cropped
        }
        _ if valid_part(distortion, k) >= MIN_VALID => Ok(Kept { crop: whole, is_masked: true }),
        _ => Err(IngestErrorKind::DistortionTooStrong),
    }
}

fn valid_part(distortion: &Distortion, k: &Intrinsics) -> f64 {
    let sees = distortion.visibility(k);
    let at = |index: u32, side: u32| (f64::from(index) + 0.5) / f64::from(SAMPLES) * f64::from(side);
    let samples = (0..SAMPLES * SAMPLES).map(|index| (index % SAMPLES, index / SAMPLES));
    let valid = samples.filter(|(x, y)| sees([at(*x, k.width), at(*y, k.height)])).count();
    valid as f64 / f64::from(SAMPLES * SAMPLES)
}

/// The pixels, of a photograph undistorted whole and then downscaled to `size`, to which only seen ones contribute.
pub(super) fn valid_pixels(
    distortion: &Distortion,
    k: &Intrinsics,
    (width, height): (u32, u32),
) -> PixelMask {
    let sees = distortion.visibility(k);
    let scale = [f64::from(k.width) / f64::from(width), f64::from(k.height) / f64::from(height)];
    let is_downscaled = width != k.width;
    PixelMask::from_fn(width, height, |column, row| {
        let center = [(f64::from(column) + 0.5) * scale[0], (f64::from(row) + 0.5) * scale[1]];
        if !is_downscaled {
            return sees(center);
        }
        let reach = scale.map(|scale| FILTER_SUPPORT * scale);
        [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [0.0, 0.0]].into_iter().all(|[x, y]| {
            let side = |at: f64, side: u32| at.clamp(0.5, f64::from(side) - 0.5);
            sees([side(center[0] + x * reach[0], k.width), side(center[1] + y * reach[1], k.height)])
        })
    })
}

#[cfg(test)]
mod tests {
    use super::{
        super::{distortion::Polynomial, projection::Projection},
        *,
    };

    const K: Intrinsics = Intrinsics { fx: 60.0, fy: 60.0, cx: 64.0, cy: 48.0, width: 128, height: 96 };

    /// A lens that magnifies its rim.
    fn pincushion(k1: f64) -> Distortion {
        Distortion::Projection(Projection::Rational {
            radial: [k1, 0.0, 0.0, 0.0, 0.0, 1e-9],
            tangential: [0.0; 2],
        })
    }

    #[test]
    fn a_crop_that_loses_little_is_one_and_else_there_is_a_mask() {
        let slight = kept(&pincushion(0.01), &K).expect("a lens");
        assert!(!slight.is_masked && slight.crop.width < K.width, "{slight:?}");
        let strong = kept(&pincushion(0.2), &K).expect("a lens");
        assert_eq!(strong, Kept { crop: Crop { left: 0, top: 0, width: 128, height: 96 }, is_masked: true });
        let polynomial =
            Distortion::Polynomial(Polynomial { radial: [0.2, 0.0, 0.0, 0.0], tangential: [0.0; 2] });
        let cropped = kept(&polynomial, &K).expect("a lens");
        assert_eq!(cropped, Kept { crop: polynomial.covered(&K).expect("a lens"), is_masked: false });
        assert!(matches!(kept(&pincushion(100.0), &K), Err(IngestErrorKind::DistortionTooStrong)));
    }

    #[test]
    fn valid_pixels_are_those_that_the_lens_saw() {
        let lens = pincushion(0.2);
        let whole = valid_pixels(&lens, &K, (128, 96));
        let sees = |x: u32, y: u32| {
            let [u, v] =
                lens.distort([(f64::from(x) + 0.5 - 64.0) / 60.0, (f64::from(y) + 0.5 - 48.0) / 60.0]);
            (u * 60.0).abs() <= 64.0 && (v * 60.0).abs() <= 48.0
        };
        for y in 0..96 {
            for x in 0..128 {
                assert_eq!(whole.counts((y * 128 + x) as usize), sees(x, y), "({x}, {y})");
            }
        }
        assert!(whole.counted() > whole.pixels() / 4 && whole.counted() < whole.pixels());
        let half = valid_pixels(&lens, &K, (64, 48));
        for y in 0..48 {
            for x in 0..64 {
                let all = (0..4).all(|index| sees(2 * x + index % 2, 2 * y + index / 2));
                assert!(all || !half.counts((y * 64 + x) as usize), "({x}, {y})");
            }
        }
        assert!(4 * half.counted() <= whole.counted() && 6 * half.counted() > whole.counted());
    }
}
