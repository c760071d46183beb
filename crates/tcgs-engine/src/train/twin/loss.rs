//! L1 and SSIM of two images and their gradient (METHOD.md §2.4). An image is one RGB triple a pixel, rows from the top.

use glam::{DVec3, USizeVec2};

/// Half the window's width.
const REACH: usize = 5;
const SIGMA: f64 = 1.5;
const C1: DVec3 = DVec3::splat(1e-4);
const C2: DVec3 = DVec3::splat(9e-4);

/// The window's means of x, y, x², y² and xy around a pixel; x is the render, y the photograph.
pub type Moments = [DVec3; 5];

/// The derivatives of SSIM by the window's means of x, x² and xy.
pub type SsimGradient = [DVec3; 3];

/// A pixel's share of SSIM, absolute and squared difference, each summed over the channels.
pub type Losses = [f64; 3];

/// The weight of a neighbour at this distance along one axis.
fn tap(distance: usize) -> f64 {
    let bell = |d: usize| (-((d * d) as f64) / (2.0 * SIGMA * SIGMA)).exp();
    let total = bell(0) + 2.0 * (1..=REACH).map(bell).sum::<f64>();
    bell(distance) / total
}

/// The zero-padded window along `axis` (0: rows).
fn blur<const N: usize>(size: USizeVec2, axis: usize, fields: &[[DVec3; N]]) -> Vec<[DVec3; N]> {
    let stride = [1, size.x][axis];
    (0..fields.len())
        .map(|pixel| {
            let at = [pixel % size.x, pixel / size.x][axis];
            let mut sums = [DVec3::ZERO; N];
            for other in at.saturating_sub(REACH)..=(at + REACH).min(size[axis] - 1) {
                let neighbour = &fields[pixel + other * stride - at * stride];
                for (sum, value) in sums.iter_mut().zip(neighbour) {
                    *sum += tap(at.abs_diff(other)) * *value;
                }
            }
            sums
        })
        .collect()
}

/// The first half of the window, along rows.
#[must_use]
pub fn ssim_rows(size: USizeVec2, render: &[DVec3], photograph: &[DVec3]) -> Vec<Moments> {
    let products: Vec<Moments> =
        render.iter().zip(photograph).map(|(x, y)| [*x, *y, x * x, y * y, x * y]).collect();
    blur(size, 0, &products)
}

/// The second half, along columns; of each pixel's derivatives of SSIM the first half of the window's adjoint, along columns
/// too; and each pixel's SSIM, summed over the channels. The window is symmetric and zero-padded: its own adjoint.
#[must_use]
pub fn ssim_columns(size: USizeVec2, rows: &[Moments]) -> (Vec<SsimGradient>, Vec<f64>) {
    let (derivatives, ssim): (Vec<_>, Vec<_>) = blur(size, 1, rows).into_iter().map(similarity).unzip();
    (blur(size, 1, &derivatives), ssim)
}

/// The derivatives of a pixel's SSIM, and its SSIM, summed over the channels.
fn similarity([x, y, xx, yy, xy]: Moments) -> (SsimGradient, f64) {
    let (a1, a2) = (2.0 * x * y + C1, 2.0 * (xy - x * y) + C2);
    let (b1, b2) = (x * x + y * y + C1, xx - x * x + yy - y * y + C2);
    let ssim = a1 * a2 / (b1 * b2);
    // Product rule and quotient rule over the four factors; the means of x² and xy are held.
    let by_mean = 2.0 * y * (a2 - a1) / (b1 * b2) - ssim * (2.0 * x / b1 - 2.0 * x / b2);
    ([by_mean, -ssim / b2, 2.0 * a1 / (b1 * b2)], ssim.element_sum())
}

/// The gradient of `l1_weight |x - y| - ssim_weight SSIM`, summed over all samples, by each sample of the render; and each
/// pixel's absolute and squared difference, summed over the channels.
#[must_use]
pub fn image_gradient(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    columns: &[SsimGradient],
    [l1_weight, ssim_weight]: [f64; 2],
) -> (Vec<DVec3>, Vec<[f64; 2]>) {
    let sign = |v: f64| if v == 0.0 { 0.0 } else { v.signum() };
    let pixels = blur(size, 0, columns).into_iter().zip(render).zip(photograph);
    pixels
        .map(|(([by_mean, by_square, by_product], x), y)| {
            let difference = x - y;
            let d_ssim = by_mean + 2.0 * x * by_square + y * by_product;
            let losses = [difference.abs().element_sum(), (difference * difference).element_sum()];
            (l1_weight * difference.map(sign) - ssim_weight * d_ssim, losses)
        })
        .unzip()
}

/// As the hardware divides the work: of each pixel the derivatives of SSIM, and its losses.
#[must_use]
pub fn ssim_tiles(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
) -> (Vec<SsimGradient>, Vec<Losses>) {
    let moments = blur(size, 1, &ssim_rows(size, render, photograph));
    let pixels = moments.into_iter().map(similarity).zip(render).zip(photograph);
    pixels
        .map(|(((derivatives, ssim), x), y)| {
            let difference = x - y;
            let losses = [ssim, difference.abs().element_sum(), (difference * difference).element_sum()];
            (derivatives, losses)
        })
        .unzip()
}

/// The gradient of [`image_gradient`] from the derivatives of [`ssim_tiles`].
#[must_use]
pub fn image_gradient_tiles(
    size: USizeVec2,
    render: &[DVec3],
    photograph: &[DVec3],
    derivatives: &[SsimGradient],
    weights: [f64; 2],
) -> Vec<DVec3> {
    image_gradient(size, render, photograph, &blur(size, 1, derivatives), weights).0
}

/// The sums over all pixels.
#[must_use]
pub fn sum_losses(losses: &[Losses]) -> Losses {
    losses.iter().fold([0.0; 3], |sums, pixel| [0, 1, 2].map(|part| sums[part] + pixel[part]))
}

/// Mean SSIM, mean absolute and mean squared difference over all samples, and the gradient of 0.8 L1 + 0.2 (1 - SSIM).
#[must_use]
pub fn image_loss(size: USizeVec2, render: &[DVec3], photograph: &[DVec3]) -> (Losses, Vec<DVec3>) {
    let samples = (3 * render.len()) as f64;
    let rows = ssim_rows(size, render, photograph);
    let (columns, ssim) = ssim_columns(size, &rows);
    let (gradient, differences) =
        image_gradient(size, render, photograph, &columns, [0.8 / samples, 0.2 / samples]);
    let losses: Vec<Losses> = ssim
        .iter()
        .zip(&differences)
        .map(|(ssim, [absolute, squared])| [*ssim, *absolute, *squared])
        .collect();
    (sum_losses(&losses).map(|sum| sum / samples), gradient)
}
