//! The window of SSIM along rows.

use glam::{DVec3, USizeVec2};

use super::{Moments, window::blur};

/// The first half of the window, along rows.
#[must_use]
pub fn ssim_rows(size: USizeVec2, render: &[DVec3], photograph: &[DVec3]) -> Vec<Moments> {
    let products: Vec<Moments> =
        render.iter().zip(photograph).map(|(x, y)| [*x, *y, x * x, y * y, x * y]).collect();
    blur(size, 0, &products)
}
