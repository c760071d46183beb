//! Morton codes: three 21-bit coordinates interleaved, x lowest. Their order is the anchors' order in a file.

/// Bits per axis.
pub(super) const AXIS_BITS: u32 = 21;

/// Bits of the x axis in a code.
const X_MASK: u64 = 0x1249_2492_4924_9249;

/// The code of coordinates below 2^21.
pub(super) fn interleave(cell: [u32; 3]) -> u64 {
    spread(cell[0]) | spread(cell[1]) << 1 | spread(cell[2]) << 2
}

/// The coordinates of a code.
pub(super) fn deinterleave(code: u64) -> [u32; 3] {
    [0, 1, 2].map(|axis| gather(code >> axis))
}

/// The code one step along `axis`, or none at the border of a cube with `bits` bits an axis.
pub(super) fn neighbour(code: u64, axis: usize, forward: bool, bits: u32) -> Option<u64> {
    let mask = (X_MASK << axis) & ((1_u64 << (3 * bits)) - 1);
    let here = code & mask;
    let moved = if forward {
        if here == mask {
            return None;
        }
        (here | !mask).wrapping_add(1) & mask
    } else {
        if here == 0 {
            return None;
        }
        (here - 1) & mask
    };
    Some(moved | (code & !mask))
}

fn spread(value: u32) -> u64 {
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

        #[test]
        fn neighbours_are_one_step_away(cell in prop::array::uniform3(0_u32..16), axis in 0_usize..3, forward: bool) {
            let step = if forward { cell[axis].checked_add(1).filter(|c| *c < 16) } else { cell[axis].checked_sub(1) };
            let expected = step.map(|moved| {
                let mut next = cell;
                next[axis] = moved;
                interleave(next)
            });
            prop_assert_eq!(neighbour(interleave(cell), axis, forward, 4), expected);
        }
    }

    #[test]
    fn the_widest_cube_has_borders_too() {
        let corner = interleave([(1 << AXIS_BITS) - 1; 3]);
        assert_eq!(corner, (1 << 63) - 1);
        assert!((0..3).all(|axis| neighbour(corner, axis, true, AXIS_BITS).is_none()));
        assert!((0..3).all(|axis| neighbour(0, axis, false, AXIS_BITS).is_none()));
    }
}
