//! Initial values of plain Gaussians.

use rand::{Rng, RngExt};

use super::{InitError, neighbors::neighbor_distances};
use crate::model::{
    GaussianRows,
    gaussian_rows::{COLOR, LOG_SCALE, OPACITY, QUAT, SH_CONSTANT},
};

/// Initial opacity of a Gaussian (METHOD.md §5).
const FIRST_OPACITY: f32 = 0.1;
/// Smallest initial value of a color channel: one clamped at zero has no gradient and would stay black.
const MIN_COLOR: f32 = 1.0 / 255.0;
/// Smallest neighbor distance for an initial size: the root of the published 1e-7 (METHOD.md §5).
const MIN_SPACING: f32 = 3.162_277_7e-4;

/// Gaussians from points: isotropic, of the size of the distance to their three nearest neighbors, of opacity 0.1, in
/// the points' sRGB colors, or gray with a trace of noise where there are none, as published. Of more than `max_gaussians`
/// points that many are taken, evenly by their place in the list.
///
/// # Errors
/// [`InitError`] for an empty or non-finite point set.
pub fn initial_gaussians(
    points: &[[f32; 3]],
    colors: &[[u8; 3]],
    max_gaussians: usize,
    rng: &mut impl Rng,
) -> Result<GaussianRows, InitError> {
    if points.is_empty() {
        return Err(InitError::NoPoints);
    }
    if let Some(index) = points.iter().position(|point| point.iter().any(|v| !v.is_finite())) {
        return Err(InitError::NonFinite(index));
    }
    let count = points.len().min(max_gaussians.max(1));
    let taken = |index: usize| (index as u128 * points.len() as u128 / count as u128) as usize;
    let positions: Vec<[f32; 3]> = (0..count).map(|index| points[taken(index)]).collect();
    let colored = colors.len() == points.len();
    let mut rows = GaussianRows::zero(positions.len());
    let distances = neighbor_distances(&positions);
    for (index, (position, distance)) in positions.iter().zip(distances).enumerate() {
        let color: [f32; 3] = if colored {
            colors[taken(index)].map(|value| ((f32::from(value) / 255.0).max(MIN_COLOR) - 0.5) / SH_CONSTANT)
        } else {
            std::array::from_fn(|_| rng.random::<f32>() / 255.0)
        };
        let row = rows.base_mut(index);
        row[..LOG_SCALE].copy_from_slice(position);
        row[LOG_SCALE..QUAT].fill(distance.max(MIN_SPACING).ln());
        row[QUAT] = 1.0;
        row[OPACITY] = logit(FIRST_OPACITY);
        row[COLOR..].copy_from_slice(&color);
    }
    Ok(rows)
}

/// The value whose logistic is `probability`.
#[must_use]
pub fn logit(probability: f32) -> f32 {
    (probability / (1.0 - probability)).ln()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;

    fn begin(points: &[[f32; 3]], colors: &[[u8; 3]], max: usize) -> Result<GaussianRows, InitError> {
        initial_gaussians(points, colors, max, &mut Pcg64::seed_from_u64(1))
    }

    fn grid() -> Vec<[f32; 3]> {
        (0..1000).map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32]).collect()
    }

    #[test]
    fn gaussians_begin_as_balls_that_fill_the_spacing_in_the_colors_of_their_points() {
        // Black is lifted by one: what is held at zero does not learn.
        let colors: Vec<[u8; 3]> = (0..1000).map(|i| [(i % 256) as u8, 0, 255]).collect();
        let rows = begin(&grid(), &colors, 1000).expect("rows");
        assert_eq!((rows.len(), rows.bands.each_ref().map(Vec::len)), (1000, [9_000, 15_000, 21_000]));
        for (index, point) in grid().iter().enumerate() {
            let row = rows.base(index);
            assert_eq!(row[..3], *point);
            // Three neighbors at distance one.
            assert!(row[LOG_SCALE..QUAT].iter().all(|log| log.abs() < 1e-6), "{row:?}");
            assert_eq!(row[QUAT..OPACITY], [1.0, 0.0, 0.0, 0.0]);
            assert!((1.0 / (1.0 + (-row[OPACITY]).exp()) - 0.1).abs() < 1e-6);
            let color = [0, 1, 2].map(|c| row[COLOR + c] * SH_CONSTANT + 0.5);
            for (found, expected) in color.iter().zip(colors[index]) {
                assert!((found - f32::from(expected.max(1)) / 255.0).abs() < 1e-6);
            }
            assert!(rows.coefficients(index).iter().all(|v| *v == 0.0));
        }
    }

    #[test]
    fn points_without_colors_begin_gray_and_too_many_points_are_thinned() {
        let rows = begin(&grid(), &[], 300).expect("rows");
        assert_eq!(rows.len(), 300, "as many as there may be");
        let reds: Vec<f32> = (0..300).map(|i| rows.base(i)[COLOR] * SH_CONSTANT + 0.5).collect();
        assert!(reds.iter().all(|red| (0.5..0.502).contains(red)));
        assert!(reds.windows(2).any(|pair| pair[0] != pair[1]), "no two alike for good");
        assert_eq!((&rows.base(1)[..3], &rows.base(299)[..3]), (&grid()[3][..], &grid()[996][..]));
    }

    #[test]
    fn coinciding_points_and_a_lone_one_have_a_finite_size_and_unusable_ones_are_named() {
        for points in [vec![[1.0, 2.0, 3.0]], vec![[1.0, 2.0, 3.0]; 9]] {
            let rows = begin(&points, &[], 100).expect("rows");
            assert!(rows.base.iter().all(|v| v.is_finite()));
        }
        assert_eq!(begin(&[], &[], 9), Err(InitError::NoPoints));
        assert_eq!(begin(&[[0.0; 3], [f32::NAN, 0.0, 0.0]], &[], 9), Err(InitError::NonFinite(1)));
    }
}
