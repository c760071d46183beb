//! The packing of offset masks.

/// One anchor's binary mask: bit k is set where logit k is above `level`.
#[must_use]
pub fn mask_bits(logits: &[f32], level: f32) -> u32 {
    logits.iter().zip(0..).fold(0, |bits, (logit, k)| bits | (u32::from(*logit > level) << k))
}
