//! Finds the offsets that are invisible in all training views.

use super::{Result, TrainError, model_trainer::Views};
use crate::{
    gpu::Device,
    model::AnchorRows,
    render::{DeviceAnchors, NeuralGaussians},
};

/// Anchors whose opacities are evaluated in one submission: some milliseconds of a fast GPU.
const ANCHORS_A_SUBMISSION: usize = 1 << 18;

/// Views times anchors that one submission evaluates.
fn views_a_submission(anchors: usize) -> usize {
    (ANCHORS_A_SUBMISSION / anchors.max(1)).clamp(1, 32)
}

/// Masks the offsets of `anchors`, rendered as `device_anchors`, whose opacity is too small to reach a pixel in every one of
/// `views`. Anchors outside all views keep no offset.
///
/// # Errors
/// [`TrainError::Cancelled`] before the next view if the run is cancelled; errors of the device.
pub(super) fn prune_invisible(
    device: &Device,
    neural: &mut NeuralGaussians,
    device_anchors: &DeviceAnchors,
    anchors: &mut AnchorRows,
    views: &Views<'_>,
) -> Result<()> {
    let shown = device.upload("visible offsets", &vec![0_u32; anchors.len()])?;
    for frames in views.frames.chunks(views_a_submission(anchors.len())) {
        if views.cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        let mut recorder = device.recorder("visible offsets");
        for frame in frames {
            neural.visible_offsets(&mut recorder, device_anchors, &frame.camera, &shown)?;
        }
        recorder.submit()?;
    }
    for (mask, shown) in anchors.masks.iter_mut().zip(device.read(&shown)?) {
        *mask &= shown;
    }
    Ok(())
}
