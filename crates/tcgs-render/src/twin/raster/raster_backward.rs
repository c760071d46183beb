//! Gradients of blending (METHOD.md §3.3), one for each slot.

use glam::{DVec2, DVec3};

use super::contribution::{Contribution, pixel};
use crate::{
    Projection,
    twin::{ALPHA_MAX, Cutoffs, Rendering, SplatGradient},
};

/// The gradient of each slot from those by the image (red, green, blue, alpha).
#[must_use]
pub fn raster_backward(
    projection: &Projection,
    rendering: &Rendering,
    d_image: &[[f64; 4]],
    cutoffs: Cutoffs,
) -> Vec<SplatGradient> {
    let Rendering { splats, lists, frame } = rendering;
    let mut slots = vec![SplatGradient::default(); lists.slots.len()];
    for (i, v) in d_image.iter().enumerate() {
        let (center, range) = pixel(projection, lists, i);
        let (d_color, d_alpha) = (DVec3::new(v[0], v[1], v[2]), v[3]);
        let [r, g, b, left] = frame.image[i];
        let mut remainder = d_color.dot(DVec3::new(r, g, b)) + d_alpha * (1.0 - left);
        let mut transmittance = 1.0;
        for slot in lists.slots[range].iter().take(frame.last[i] as usize) {
            let Some(splat) = &splats[lists.slot_ids[*slot as usize] as usize] else { continue };
            let Some(contribution) = Contribution::new(splat, center, cutoffs) else {
                continue;
            };
            let alpha = contribution.alpha();
            let weight = alpha * transmittance;
            let value = d_color.dot(splat.color) + d_alpha;
            remainder -= weight * value;
            let slope = transmittance * value - remainder / (1.0 - alpha);
            transmittance *= 1.0 - alpha;
            let d_raw = if contribution.raw > ALPHA_MAX { 0.0 } else { slope };
            let d_power = -contribution.raw * d_raw;
            let d = contribution.offset;
            let sums = &mut slots[*slot as usize];
            sums.color += weight * d_color;
            sums.opacity += contribution.falloff * d_raw;
            sums.conic += d_power * DVec3::new(0.5 * d.x * d.x, d.x * d.y, 0.5 * d.y * d.y);
            sums.center += d_power
                * DVec2::new(
                    splat.conic.x * d.x + splat.conic.y * d.y,
                    splat.conic.y * d.x + splat.conic.z * d.y,
                );
        }
    }
    slots
}
