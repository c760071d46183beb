//! Random signs for the pixels of a view: a function of the number of the probe and the pixel alone.

/// One of -1 and 1 for red, green and blue of each of `pixels`, as the gradient of an image; nothing for its alpha.
pub fn signs(probe: u32, pixels: usize) -> Vec<[f32; 4]> {
    (0..pixels as u64)
        .map(|pixel| {
            let bits = mixed(u64::from(probe) << 40 | pixel);
            let sign = |bit: u32| if bits >> (61 + bit) & 1 == 1 { 1.0 } else { -1.0 };
            [sign(0), sign(1), sign(2), 0.0]
        })
        .collect()
}

/// SplitMix64: every bit of the result depends on every bit of `value`.
fn mixed(value: u64) -> u64 {
    let mut bits = value.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ bits >> 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_are_balanced_and_do_not_go_together() {
        let (a, b) = (signs(0, 30_000), signs(1, 30_000));
        let mean = |values: Vec<f32>| values.iter().sum::<f32>().abs() / values.len() as f32;
        for channel in 0..3 {
            let of = |signs: &[[f32; 4]]| signs.iter().map(|pixel| pixel[channel]).collect::<Vec<_>>();
            let (one, other) = (of(&a), of(&b));
            assert!(one.iter().all(|sign| sign.abs() == 1.0));
            assert!(mean(one.clone()) < 0.02);
            assert!(mean(one.iter().zip(&other).map(|(x, y)| x * y).collect()) < 0.02, "views");
            assert!(mean(one.iter().zip(&one[1..]).map(|(x, y)| x * y).collect()) < 0.02, "pixels");
            let next: Vec<f32> = a.iter().map(|pixel| pixel[(channel + 1) % 3]).collect();
            assert!(mean(one.iter().zip(&next).map(|(x, y)| x * y).collect()) < 0.02, "channels");
        }
        assert!(a.iter().all(|pixel| pixel[3] == 0.0));
        assert_eq!(a, signs(0, 30_000));
    }
}
