//! SSIM of a pixel, and its derivatives.

use glam::DVec3;

const C1: DVec3 = DVec3::splat(1e-4);
const C2: DVec3 = DVec3::splat(9e-4);

/// The window's means of x, y, x², y² and xy around a pixel; x is the render, y the photograph.
pub type Moments = [DVec3; 5];

/// The derivatives of SSIM by the window's means of x, x² and xy.
pub type SsimGradient = [DVec3; 3];

/// The derivatives of a pixel's SSIM, and its SSIM, summed over the channels.
pub(super) fn similarity([x, y, xx, yy, xy]: Moments) -> (SsimGradient, f64) {
    let (a1, a2) = (2.0 * x * y + C1, 2.0 * (xy - x * y) + C2);
    let (b1, b2) = (x * x + y * y + C1, xx - x * x + yy - y * y + C2);
    let ssim = a1 * a2 / (b1 * b2);
    // Product rule and quotient rule over the four factors; the means of x² and xy are held.
    let by_mean = 2.0 * y * (a2 - a1) / (b1 * b2) - ssim * (2.0 * x / b1 - 2.0 * x / b2);
    ([by_mean, -ssim / b2, 2.0 * a1 / (b1 * b2)], ssim.element_sum())
}
