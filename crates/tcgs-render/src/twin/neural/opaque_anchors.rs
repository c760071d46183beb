//! The anchors that make Gaussians.

/// Whether a visible anchor makes a Gaussian, by the opacities' outputs: some offset is opaque and its mask on.
#[must_use]
pub fn opaque_anchors(mask: u32, outputs: &[f64]) -> bool {
    outputs.iter().enumerate().any(|(k, output)| (mask >> k) & 1 == 1 && output.is_finite() && *output > 0.0)
}
