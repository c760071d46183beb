//! The window of SSIM.

use glam::{DVec3, USizeVec2};

/// Half the window's width.
const REACH: usize = 5;
const SIGMA: f64 = 1.5;

/// The weight of a neighbor at this distance along one axis.
fn tap(distance: usize) -> f64 {
    let bell = |d: usize| (-((d * d) as f64) / (2.0 * SIGMA * SIGMA)).exp();
    let total = bell(0) + 2.0 * (1..=REACH).map(bell).sum::<f64>();
    bell(distance) / total
}

/// The zero-padded window along `axis` (0: rows).
pub(super) fn blur<const N: usize>(size: USizeVec2, axis: usize, fields: &[[DVec3; N]]) -> Vec<[DVec3; N]> {
    let stride = [1, size.x][axis];
    (0..fields.len())
        .map(|pixel| {
            let at = [pixel % size.x, pixel / size.x][axis];
            let mut sums = [DVec3::ZERO; N];
            for other in at.saturating_sub(REACH)..=(at + REACH).min(size[axis] - 1) {
                let neighbor = &fields[pixel + other * stride - at * stride];
                for (sum, value) in sums.iter_mut().zip(neighbor) {
                    *sum += tap(at.abs_diff(other)) * *value;
                }
            }
            sums
        })
        .collect()
}
