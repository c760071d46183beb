//! How long the submission of a step may take.

use crate::{
    domain::Camera,
    gpu::{Device, KernelVariant},
};

/// Milliseconds of a step on an H100 that one submission may take. Drivers reset a device after two seconds; a card a twentieth as fast
/// then has a tenth of that.
pub(super) const MAX_SUBMISSION_MS: f64 = 10.0;

/// Milliseconds of a step on an H100 for a Gaussian and for a pixel (docs/HARDWARE.md).
const MS_A_GAUSSIAN: f64 = 6e-6;
const MS_A_PIXEL: f64 = 1e-6;

/// Whether a step of `gaussians` Gaussians is submitted in parts, since a driver could take a slow card for a hung one. Software adapters
/// have no such limit.
pub(super) fn is_long(device: &Device, gaussians: usize, camera: &Camera) -> bool {
    let pixels = f64::from(camera.intrinsics.width) * f64::from(camera.intrinsics.height);
    let milliseconds = MS_A_GAUSSIAN * gaussians as f64 + MS_A_PIXEL * pixels;
    device.variant() == KernelVariant::Hardware && milliseconds > MAX_SUBMISSION_MS
}
