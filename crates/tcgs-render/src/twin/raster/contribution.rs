//! The contribution of a splat to a pixel, and where the splats of a pixel are.

use glam::{DVec2, DVec3};

use super::TileLists;
use crate::{
    Projection, TILE,
    twin::{ALPHA_MAX, Cutoffs, Splat},
};

/// The contribution of a splat to a pixel.
pub(super) struct Contribution {
    /// From the pixel's center to the splat's.
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

/// The center of a pixel and the list of its tile.
pub(super) fn pixel(projection: &Projection, lists: &TileLists, i: usize) -> (DVec2, std::ops::Range<usize>) {
    let (x, y) = (i as u32 % projection.size.x, i as u32 / projection.size.x);
    let [begin, end] = lists.ranges[(y / TILE * projection.tiles().x + x / TILE) as usize];
    (DVec2::new(f64::from(x), f64::from(y)) + 0.5, begin as usize..end as usize)
}
