//! Finds the offsets that no training view ever shows, so that nothing more is spent on them.

use super::TrainError;
use crate::{
    domain::{CancelFlag, Frame},
    gpu::Device,
    model::AnchorRows,
    render::{DeviceAnchors, NeuralGaussians},
};

/// An opacity below this never reaches a pixel (METHOD.md §3.2).
const MIN_OPACITY: f32 = 1.0 / 255.0;

/// Switches off the offsets of `anchors` whose opacity stays below what a pixel takes in every view of `frames`, as `device` has
/// them. Anchors that no view shows at all keep none.
///
/// # Errors
/// [`TrainError::Cancelled`] before the next view once a stop was asked for; faults of the device.
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
