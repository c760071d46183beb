//! How much pictures depend on features.
//!
//! A gradient of random signs as the image's, taken back to an anchor's feature, is a random vector whose products average to those
//! of the picture's derivatives by the feature's channels. The picture is what the loss compares with the photograph: the render through
//! its color correction, where pixels count.

use super::{
    Result, TrainError,
    feature_basis::add_products,
    model_trainer::{Views, submit_with_room},
};
use crate::{
    eval::{TrainView, signs},
    gpu::Device,
    render::{AnchorGradients, DeviceAnchors, NeuralGaussians},
};

/// Views that are measured; each gives one product for every anchor that it shows.
const VIEWS: usize = 8;

/// Behind everything, so that covering it counts, whatever the set's background is.
const GRAY: [f32; 3] = [0.5; 3];

/// The products of a picture's derivatives by two channels, `[F][F]`, summed over the anchors of views that are spread evenly over
/// `views`. Overwrites `gradients`.
///
/// # Errors
/// [`TrainError::Cancelled`] before the next view if the run is cancelled; errors of the device.
pub(super) fn feature_sensitivity(
    device: &Device,
    neural: &mut NeuralGaussians,
    anchors: &DeviceAnchors,
    gradients: &AnchorGradients,
    views: &mut Views<'_>,
) -> Result<Vec<f64>> {
    let corrections = views.read_corrections()?;
    let Views { raster, frames, cancel, .. } = views;
    let shape = anchors.shape;
    let mut sums = vec![0.0; shape.features * shape.features];
    let views = VIEWS.min(frames.len());
    for view in 0..views {
        if cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        let index = (2 * view + 1) * frames.len() / (2 * views);
        let frame = &frames[index];
        let camera = &frame.camera;
        submit_with_room(device, raster, |raster, recorder| {
            neural.forward(recorder, anchors, camera, 0.0)?;
            Ok(raster.forward(recorder, neural.gaussians(), camera, GRAY)?)
        })?;
        let pixels = (camera.intrinsics.width * camera.intrinsics.height) as usize;
        let mut d_image = signs(view as u32, pixels);
        let correction = corrections.as_ref().map(|all| all[index].into());
        TrainView { frame, correction }.gradient_by_render(&mut d_image);
        let d_image = device.upload("random signs", &d_image)?;
        let gaussians = neural.gaussians().clone();
        let by_gaussians = neural.gaussian_gradients()?.clone();
        let mut recorder = device.recorder("random signs taken back");
        raster.backward(&mut recorder, &gaussians, camera, &d_image, &by_gaussians)?;
        neural.backward(&mut recorder, anchors, gradients)?;
        recorder.submit()?;
        for row in device.read(&gradients.rows)?.chunks_exact(shape.row()) {
            let feature: Vec<f64> = row[..shape.features].iter().map(|value| f64::from(*value)).collect();
            // Anchors that the view does not show have zeros.
            if feature.iter().all(|value| value.is_finite()) && feature.iter().any(|value| *value != 0.0) {
                add_products(&mut sums, &feature, 1.0);
            }
        }
    }
    Ok(sums)
}
