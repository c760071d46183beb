//! Colors in 8 bits.

/// Red, green and blue of a pixel as levels from 0 to 255, halves rounded up.
#[must_use]
pub fn pack_image(pixel: [f64; 3]) -> [u8; 3] {
    pixel.map(|value| (255.0 * value.clamp(0.0, 1.0)).round() as u8)
}
