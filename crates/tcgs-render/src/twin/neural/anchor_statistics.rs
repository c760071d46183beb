//! The statistics that a view adds.

use glam::DVec2;

use crate::{
    Projection,
    twin::{Gaussian, SplatGradient},
};

/// Adds one view to an anchor's row of statistics (METHOD.md §2.6): K sums of screen-gradient norms in half-image units,
/// K counts of views, the sum of positive opacities, visits. `tiles` is what each Gaussian touches; 0 is culled. With masks, a view
/// without gradient is not counted.
pub fn anchor_statistics(
    projection: &Projection,
    gaussians: &[Option<Gaussian>],
    d_splats: &[SplatGradient],
    tiles: &[u32],
    masked: bool,
    statistics: &mut [f64],
) {
    let offsets = gaussians.len();
    for (k, gaussian) in gaussians.iter().enumerate() {
        let Some(gaussian) = gaussian else { continue };
        statistics[2 * offsets] += gaussian.opacity;
        if tiles[k] > 0 && !(masked && d_splats[k].center == DVec2::ZERO) {
            statistics[k] += (d_splats[k].center * 0.5 * projection.size.as_dvec2()).length();
            statistics[offsets + k] += 1.0;
        }
    }
    statistics[2 * offsets + 1] += 1.0;
}
