//! How much of each Gaussian is visible in a view: the transmittance in front of it.
//!
//! Training never supervises a network's outputs for views in which the Gaussian is hidden, so those outputs must not count. A grid of
//! at most 128 cells a side stands in for the image, and a disc of its mean size for each Gaussian: coarse, but enough to tell the front of
//! a wall from its back, in milliseconds a view. The order is by depth, then by index, so the result is deterministic.

use glam::DVec3;

use super::views::BakeView;

/// Cells along the longer side of the grid.
const CELLS: f64 = 128.0;

/// A Gaussian covers a square of this many standard deviations to each side.
const COVERED: f64 = 1.5;

/// Most cells to each side of its middle that a Gaussian darkens: enough for all but those before the lens.
const MAX_CELLS: i64 = 16;

/// Cells from the image beyond which it does not matter how far.
const FAR: f64 = 1e6;

/// A Gaussian as a disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::export) struct Disc {
    pub(in crate::export) mean: DVec3,
    /// Standard deviation in world units.
    pub(in crate::export) sigma: f64,
}

/// Shares of light, 0 to 1, in which `bake_view` shows the discs of the given opacities; zero behind the near plane.
pub(in crate::export) fn shares(
    bake_view: &BakeView,
    discs: &[Disc],
    opacities: &[f32],
    near: f64,
) -> Vec<f32> {
    let (width, height) = bake_view.size();
    let cell = (width.max(height) / CELLS).max(1.0);
    let (columns, rows) = ((width / cell).ceil().max(1.0) as i64, (height / cell).ceil().max(1.0) as i64);
    let mut order: Vec<(f64, usize, f64, f64, f64)> = discs
        .iter()
        .enumerate()
        .filter_map(|(index, disc)| {
            let (x, y, depth, scale) = bake_view.project(disc.mean, near)?;
            Some((depth, index, x / cell, y / cell, scale * disc.sigma / cell))
        })
        .collect();
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut light = vec![1.0_f32; (columns * rows) as usize];
    let mut shares = vec![0.0; discs.len()];
    for (_, index, x, y, sigma) in order {
        let reach = COVERED * sigma;
        let cells = |middle: f64, count: i64| {
            // Far outside is as good as anywhere outside.
            let middle = middle.clamp(-FAR, FAR);
            let own = middle.floor() as i64;
            let first = ((middle - reach).floor() as i64).clamp(own - MAX_CELLS, own);
            let last = ((middle + reach).floor() as i64).clamp(own, own + MAX_CELLS);
            (own.clamp(0, count - 1), first, last)
        };
        let (column, left, right) = cells(x, columns);
        let (row, top, bottom) = cells(y, rows);
        shares[index] = light[(row * columns + column) as usize];
        let covered = ((right - left + 1) * (bottom - top + 1)) as f64;
        let filled = (std::f64::consts::TAU * sigma * sigma / covered).min(1.0);
        let passed = 1.0 - opacities[index] * filled as f32;
        if passed < 1.0 {
            for row in top.max(0)..=bottom.min(rows - 1) {
                for column in left.max(0)..=right.min(columns - 1) {
                    light[(row * columns + column) as usize] *= passed;
                }
            }
        }
    }
    shares
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Camera, Intrinsics, Pose};

    fn bake_view() -> BakeView {
        let k = Intrinsics::from_horizontal_fov(1.0, 64, 64).expect("intrinsics");
        let pose = Pose::look_at(DVec3::new(0.0, 0.0, -4.0), DVec3::ZERO, DVec3::Y).expect("a pose");
        BakeView::of(&Camera::new(k, pose).expect("a camera"))
    }

    fn disc(x: f64, z: f64) -> Disc {
        Disc { mean: DVec3::new(x, 0.0, z), sigma: 0.2 }
    }

    #[test]
    fn what_is_behind_is_shown_less_and_what_is_beside_or_before_is_not() {
        let discs = [disc(0.0, 1.0), disc(0.0, 0.0), disc(2.0, 1.0), disc(0.0, -1.0), disc(0.0, -9.0)];
        let shares = shares(&bake_view(), &discs, &[1.0, 0.5, 1.0, 0.0, 1.0], 0.2);
        assert_eq!(shares[3], 1.0, "in front");
        assert_eq!(shares[1], 1.0, "behind what is transparent");
        assert!((0.4..0.8).contains(&shares[0]), "behind a half: {}", shares[0]);
        assert_eq!(shares[2], 1.0, "beside");
        assert_eq!(shares[4], 0.0, "behind the camera");
    }

    #[test]
    fn what_lies_outside_the_image_darkens_nothing_in_it() {
        let discs = [disc(60.0, -1.0), disc(2.1, 0.0)];
        assert_eq!(shares(&bake_view(), &discs, &[1.0, 1.0], 0.2)[1], 1.0);
    }

    #[test]
    fn sizes_and_places_without_measure_are_no_fault() {
        for (sigma, x) in [(1e30, 0.0), (0.0, 0.0), (f64::INFINITY, 1e30), (f64::NAN, -1e30)] {
            let strange = Disc { mean: DVec3::new(x, 0.0, 0.0), sigma };
            let found = shares(&bake_view(), &[strange, disc(0.0, 1.0)], &[1.0, 1.0], 0.2);
            assert!(found.iter().all(|share| (0.0..=1.0).contains(share)), "{found:?}");
        }
    }
}
