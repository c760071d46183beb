//! By how much the training views' error grows without a Gaussian.

use super::{
    Result, TrainError,
    model_trainer::{ModelTrainer, Step, Views, submit_with_room},
};
use crate::{domain::Frame, gpu::Device};

/// For each candidate Gaussian of `model`, whose candidates are the same in every view, by how much the mean absolute error of all
/// training views would change without it alone (METHOD.md §5). The error is the loss's: of renders through the photographs' color
/// corrections, if the run learns them, over the pixels that count.
///
/// # Errors
/// [`TrainError::Cancelled`] before the next view if the run is cancelled; errors of the device.
pub(super) fn removal_losses<M: ModelTrainer + ?Sized>(
    model: &mut M,
    device: &Device,
    step: &Step,
    views: &mut Views<'_>,
) -> Result<Vec<f64>> {
    let corrections = views.read_corrections()?;
    let Views { raster, frames, photographs, background, cancel, .. } = views;
    let mut losses = Vec::new();
    for (index, Frame { camera, mask, .. }) in frames.iter().enumerate() {
        if cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        submit_with_room(device, raster, |raster, recorder| {
            model.forward(recorder, camera, step)?;
            Ok(raster.forward(recorder, model.gaussians(), camera, background.rgb())?)
        })?;
        let gaussians = model.gaussians().clone();
        let out = model.gaussian_gradients()?;
        let mut recorder = device.recorder("error without Gaussians");
        let photograph = photographs.bring(&mut recorder, index)?;
        let correction = corrections.as_ref().map(|all| &all[index]);
        raster.removal_loss(&mut recorder, &gaussians, camera, &photograph, correction, &out)?;
        recorder.submit()?;
        let pixels = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
        let counted = mask.as_ref().map_or(pixels, |mask| mask.counted() as usize);
        let weight = 1.0 / (3.0 * counted.max(1) as f64 * frames.len() as f64);
        losses.resize(gaussians.capacity, 0.0);
        for (loss, [.., sum]) in
            losses.iter_mut().zip(device.read_range(&out.geometry, 0, gaussians.capacity)?)
        {
            *loss += weight * f64::from(sum);
        }
    }
    Ok(losses)
}
