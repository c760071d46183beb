//! Morton codes: three 21-bit coordinates interleaved, x lowest. Their order is the anchors' order in a file.

/// Bits per axis.
pub(super) const AXIS_BITS: u32 = 21;

/// Bits of the x axis in a code.
const X_MASK: u64 = 0x1249_2492_4924_9249;

/// The code of coordinates below 2^21.
pub(super) fn interleave(cell: [u32; 3]) -> u64 {
    spaced_bits(cell[0]) | spaced_bits(cell[1]) << 1 | spaced_bits(cell[2]) << 2
}

/// The coordinates of a code.
pub(super) fn deinterleave(code: u64) -> [u32; 3] {
    [0, 1, 2].map(|axis| gather(code >> axis))
}

fn spaced_bits(value: u32) -> u64 {
    let mut x = u64::from(value) & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & X_MASK
}

fn gather(code: u64) -> u32 {
    let mut x = code & X_MASK;
    x = (x | x >> 2) & 0x10c3_0c30_c30c_30c3;
    x = (x | x >> 4) & 0x100f_00f0_0f00_f00f;
    x = (x | x >> 8) & 0x001f_0000_ff00_00ff;
    x = (x | x >> 16) & 0x001f_0000_0000_ffff;
    (x | x >> 32) as u32 & 0x1f_ffff
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn codes_and_coordinates_agree(cell in prop::array::uniform3(0_u32..1 << AXIS_BITS)) {
            let code = interleave(cell);
            let slow = (0..63).fold(0_u64, |code, bit| {
                code | u64::from(cell[bit % 3] >> (bit / 3) & 1) << bit
            });
            prop_assert_eq!(code, slow);
            prop_assert_eq!(deinterleave(code), cell);
        }
    }

    #[test]
    fn the_widest_cube_fills_its_codes() {
        assert_eq!(interleave([(1 << AXIS_BITS) - 1; 3]), (1 << 63) - 1);
    }
}
