//! Views in f64 on the CPU, and how far the f32 renderer is from them.

use serde::{Deserialize, Serialize};

use crate::{
    domain::{Background, Camera, Scene},
    model::{AnchorRows, GaussianRows, NetworkLayout, gaussian_rows::BANDS},
    render::{
        Projection, RasterSettings, RenderError,
        twin::{
            Cutoffs, Gaussian, forward,
            neural::{Anchors, neural_forward},
            plain::{PlainRow, shade_gaussians},
        },
    },
};

/// The colors of a view, 0 to 1 without rounding and without bounds, row by row.
///
/// Everything from the scene's f32 parameters on is f64: networks, spherical harmonics, projection, order and blending.
///
/// # Errors
/// [`RenderError::Scene`] for networks of unknown widths.
pub fn reference_view(
    scene: &Scene,
    camera: &Camera,
    background: Background,
    cutoffs: Cutoffs,
) -> Result<Vec<[f64; 3]>, RenderError> {
    let settings = RasterSettings { near: scene.near().depth(), ..RasterSettings::default() };
    let projection = Projection::new(&scene.frame().camera_from_world(camera), &settings);
    let gaussians = gaussians(scene, &projection)?;
    let rendering = forward(&projection, &gaussians, background.rgb().map(f64::from).into(), cutoffs);
    Ok(rendering.frame.image.into_iter().map(|[red, green, blue, _]| [red, green, blue]).collect())
}

/// The Gaussians of a view.
fn gaussians(scene: &Scene, projection: &Projection) -> Result<Vec<Gaussian>, RenderError> {
    match scene {
        Scene::Anchors(scene) => {
            let rows = AnchorRows::from_scene(scene);
            let layout = NetworkLayout::new(rows.shape);
            let networks = layout.from_networks(&scene.networks).map_err(RenderError::Scene)?;
            let anchors = Anchors::new(&rows, &networks, scene.scene_scale);
            Ok(neural_forward(projection, &anchors).gaussians.into_iter().flatten().collect())
        }
        Scene::Gaussians(scene) => {
            let rows = GaussianRows::from_scene(scene);
            let shade =
                |index| shade_gaussians(projection, &plain_row(&rows, index), u32::from(scene.degree));
            Ok((0..rows.len()).filter_map(shade).collect())
        }
    }
}

/// One Gaussian's parameters in f64.
fn plain_row(rows: &GaussianRows, index: usize) -> PlainRow {
    let mut row = PlainRow::ZERO;
    let width = row.base.len();
    for (value, given) in row.base.iter_mut().zip(&rows.base[index * width..][..width]) {
        *value = f64::from(*given);
    }
    let mut coefficients = row.sh.iter_mut();
    for (band, width) in rows.bands.iter().zip(BANDS) {
        for given in band[index * width..][..width].chunks_exact(3) {
            if let Some(coefficient) = coefficients.next() {
                *coefficient = [given[0], given[1], given[2]].map(f64::from).into();
            }
        }
    }
    row
}

/// How far colors are from their reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ColorError {
    /// Root of the mean squared difference, of colors from 0 to 1.
    pub rmse: f64,
    /// The largest difference.
    pub max: f64,
}

impl ColorError {
    /// The differences of the f32 colors of a view, transmittance behind them, from the reference; `None` if they are not of one size.
    #[must_use]
    pub fn of(pixels: &[[f32; 4]], reference: &[[f64; 3]]) -> Option<Self> {
        if pixels.len() != reference.len() || pixels.is_empty() {
            return None;
        }
        let each = pixels.iter().zip(reference).flat_map(|(pixel, reference)| {
            pixel.iter().zip(reference).map(|(value, exact)| (f64::from(*value) - exact).abs())
        });
        let (sum, max) = each.fold((0.0, 0.0_f64), |(sum, max), error| (sum + error * error, max.max(error)));
        Some(Self { rmse: (sum / (3 * pixels.len()) as f64).sqrt(), max })
    }

    /// The same in dB, at most 200.
    #[must_use]
    pub fn psnr(&self) -> f64 {
        -20.0 * self.rmse.max(1e-10).log10()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_worked_by_hand() {
        let reference = [[0.5, 0.5, 0.5], [1.0, 0.0, 0.25]];
        let pixels = [[0.5, 0.5, 0.5, 0.0], [1.0, 0.5, 0.25, 0.7]];
        let error = ColorError::of(&pixels, &reference).expect("one size");
        assert_eq!(error.max, 0.5);
        assert!((error.rmse - (0.25_f64 / 6.0).sqrt()).abs() < 1e-15);
        assert_eq!(ColorError::of(&pixels[..1], &reference), None);
        assert!((ColorError { rmse: 0.01, max: 0.1 }.psnr() - 40.0).abs() < 1e-9);
    }
}
