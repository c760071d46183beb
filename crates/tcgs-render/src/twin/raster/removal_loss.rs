//! The change of a view's absolute error without a Gaussian (METHOD.md §5), for each slot.

use glam::{DMat3, DVec3, DVec4};

use super::contribution::{Contribution, pixel};
use crate::{
    Projection,
    twin::{Cutoffs, Rendering},
};

/// By how much the sum of `|render - photograph|` over channels and pixels would change without the Gaussian of each slot. `photograph`
/// has red, green, blue and a weight a pixel: 1 where the pixel counts, else 0. With a correction, the render is `A c + b` of its colors c;
/// each of the three rows is a row of A and then the component of b.
#[must_use]
pub fn removal_loss(
    projection: &Projection,
    rendering: &Rendering,
    photograph: &[[f64; 4]],
    correction: Option<&[DVec4; 3]>,
    cutoffs: Cutoffs,
) -> Vec<f64> {
    let [red, green, blue] = *correction.unwrap_or(&[DVec4::X, DVec4::Y, DVec4::Z]);
    let linear = DMat3::from_cols(red.truncate(), green.truncate(), blue.truncate()).transpose();
    let constant = DVec3::new(red.w, green.w, blue.w);
    let Rendering { splats, lists, frame } = rendering;
    let mut slots = vec![0.0; lists.slots.len()];
    for (i, [wanted @ .., weight]) in photograph.iter().enumerate() {
        let (center, range) = pixel(projection, lists, i);
        let [r, g, b, _] = frame.image[i];
        let mut behind = DVec3::new(r, g, b);
        let error = linear * behind + constant - DVec3::from(*wanted);
        let mut transmittance = 1.0;
        for slot in lists.slots[range].iter().take(frame.last[i] as usize) {
            let Some(splat) = &splats[lists.slot_ids[*slot as usize] as usize] else { continue };
            let Some(contribution) = Contribution::new(splat, center, cutoffs) else {
                continue;
            };
            let alpha = contribution.alpha();
            let own = alpha * transmittance * splat.color;
            behind = (behind - own).max(DVec3::ZERO);
            let without = error + linear * (behind * (alpha / (1.0 - alpha)) - own);
            slots[*slot as usize] += weight * (without.abs() - error.abs()).element_sum();
            transmittance *= 1.0 - alpha;
        }
    }
    slots
}
