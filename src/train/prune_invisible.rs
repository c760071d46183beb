//! Finds the offsets that are invisible in all training views.

use super::TrainError;
use crate::{
    domain::{CancelFlag, Frame},
    gpu::Device,
    model::AnchorRows,
    render::{DeviceAnchors, NeuralGaussians},
};

/// An opacity below this never reaches a pixel (METHOD.md §3.2).
const MIN_OPACITY: f32 = 1.0 / 255.0;

/// Masks the offsets of `anchors`, rendered as `device_anchors`, whose opacity is too small to reach a pixel in every view of
/// `frames`. Anchors outside all views keep no offset.
///
/// # Errors
/// [`TrainError::Cancelled`] before the next view if the run is cancelled; errors of the device.
pub(super) fn prune_invisible(
    device: &Device,
    neural: &mut NeuralGaussians,
    device_anchors: &DeviceAnchors,
    anchors: &mut AnchorRows,
    frames: &[&Frame],
    cancel: &CancelFlag,
) -> Result<(), TrainError> {
    let offsets = anchors.shape.offsets;
    let mut used = vec![0_u32; anchors.len()];
    for frame in frames {
        if cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        let mut recorder = device.recorder("offsets in use");
        neural.forward(&mut recorder, device_anchors, &frame.camera, 0.0)?;
        recorder.submit()?;
        let (list, opacities) = neural.visible_opacities()?;
        for (anchor, opacities) in list.iter().zip(opacities.chunks_exact(offsets)) {
            for (offset, opacity) in opacities.iter().enumerate() {
                used[*anchor as usize] |= u32::from(*opacity >= MIN_OPACITY) << offset;
            }
        }
    }
    for (mask, used) in anchors.masks.iter_mut().zip(&used) {
        *mask &= used;
    }
    Ok(())
}
