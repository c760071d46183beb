//! Networks as decoded.

/// Weights that share a scale as a file gives them back; the same f32 operations as the codec's, which is what they are
/// held to. Biases are finer and their scale is a whole f32.
#[must_use]
pub fn round_rows(values: &[f32], levels: u16, is_bias: bool) -> Vec<f32> {
    let levels = f32::from(levels);
    let exact = values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs())) / levels;
    let upper_half = (exact.to_bits().saturating_add(0xffff) >> 16).min(0x7f7f) << 16;
    let scale = if is_bias { exact } else { f32::from_bits(upper_half) };
    let rounded = |value: &f32| {
        if scale == 0.0 { 0.0 } else { (value / scale).round_ties_even().clamp(-levels, levels) * scale }
    };
    values.iter().map(rounded).collect()
}
