//! Blending front to back (METHOD.md §3.2, pixel centers at +0.5).

use glam::DVec3;

use super::{
    TileLists,
    contribution::{Contribution, pixel},
};
use crate::{
    Projection,
    twin::{Cutoffs, Splat},
};

/// The blended image with what the backward pass needs.
#[derive(Debug, Clone, Default)]
pub struct BlendedImage {
    /// Color over the background, and the transmittance left; row by row.
    pub image: Vec<[f64; 4]>,
    /// One more than the index in the tile's list of the last Gaussian that each pixel blended.
    pub last: Vec<u32>,
}

/// The image of the splats over `background`.
#[must_use]
pub fn raster_forward(
    projection: &Projection,
    splats: &[Option<Splat>],
    lists: &TileLists,
    background: DVec3,
    cutoffs: Cutoffs,
) -> BlendedImage {
    let mut frame = BlendedImage::default();
    for i in 0..projection.size.element_product() as usize {
        let (center, range) = pixel(projection, lists, i);
        let mut color = DVec3::ZERO;
        let mut transmittance = 1.0;
        let mut last = 0;
        for (slot, place) in lists.slots[range].iter().zip(1..) {
            let Some(splat) = &splats[lists.slot_ids[*slot as usize] as usize] else { continue };
            let Some(contribution) = Contribution::new(splat, center, cutoffs) else { continue };
            let next = transmittance * (1.0 - contribution.alpha());
            if next <= cutoffs.transmittance {
                break;
            }
            color += contribution.alpha() * transmittance * splat.color;
            transmittance = next;
            last = place;
        }
        color += transmittance * background;
        frame.image.push([color.x, color.y, color.z, transmittance]);
        frame.last.push(last);
    }
    frame
}
