//! Blending front to back (METHOD.md §3.2, pixel centres at +0.5).

use glam::{DVec2, DVec3};

use super::{ALPHA_MAX, Cutoffs, Projection, Splat, TileLists};
use crate::TILE;

/// The blended image with what the backward pass needs.
#[derive(Debug, Clone, Default)]
pub struct BlendedImage {
    /// Colour over the background, and the transmittance left; row by row.
    pub image: Vec<[f64; 4]>,
    /// One more than the index in the tile's list of the last Gaussian that each pixel blended.
    pub last: Vec<u32>,
}

/// The contribution of a splat to a pixel.
pub(super) struct Contribution {
    /// From the pixel's centre to the splat's.
    pub(super) offset: DVec2,
    /// exp(-power).
    pub(super) falloff: f64,
    /// Opacity before the clamp.
    pub(super) raw: f64,
}

impl Contribution {
    /// `None` where the splat is skipped.
    pub(super) fn new(splat: &Splat, pixel: DVec2, cutoffs: Cutoffs) -> Option<Self> {
        let offset = splat.center - pixel;
        let DVec3 { x: a, y: b, z: c } = splat.conic;
        let power = 0.5 * (a * offset.x * offset.x + c * offset.y * offset.y) + b * offset.x * offset.y;
        let falloff = (-power).exp();
        let raw = splat.opacity * falloff;
        (power >= 0.0 && raw.min(ALPHA_MAX) >= cutoffs.alpha).then_some(Self { offset, falloff, raw })
    }

    pub(super) fn alpha(&self) -> f64 {
        self.raw.min(ALPHA_MAX)
    }
}

/// The centre of a pixel and the list of its tile.
pub(super) fn pixel(projection: &Projection, lists: &TileLists, i: usize) -> (DVec2, std::ops::Range<usize>) {
    let (x, y) = (i as u32 % projection.size.x, i as u32 / projection.size.x);
    let [begin, end] = lists.ranges[(y / TILE * projection.tiles().x + x / TILE) as usize];
    (DVec2::new(f64::from(x), f64::from(y)) + 0.5, begin as usize..end as usize)
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
