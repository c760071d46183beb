//! The statistics of the growth of plain Gaussians.

use glam::DVec2;

use crate::Projection;

/// Adds one view to a Gaussian's row of statistics: sum of screen-gradient norms in half-image units, count of views,
/// largest radius in pixels. `center` is the gradient by the projected center; a Gaussian of no `tiles` is culled. With masks,
/// a view without gradient is not counted.
pub fn gaussian_statistics(
    projection: &Projection,
    center: DVec2,
    tiles: u32,
    radius: f64,
    masked: bool,
    row: &mut [f64; 3],
) {
    if tiles > 0 && !(masked && center == DVec2::ZERO) {
        row[0] += (center * 0.5 * projection.size.as_dvec2()).length();
        row[1] += 1.0;
        row[2] = row[2].max(radius);
    }
}
