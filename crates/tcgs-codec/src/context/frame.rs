//! Contracted coordinates of anchors, from the middle of the scene to infinity: [-2, 2], in 2^-16.
//!
//! The box of a [`ContextFrame`] keeps its shape up to distance 1 from the middle; beyond, distance d becomes 2 - 1 / d
//! (the paper's contraction), so that far anchors share the rim of a plane and near ones its middle.

use rayon::prelude::*;

use crate::domain::ContextFrame;

/// One, in the units of coordinates.
const ONE: i64 = 1 << 16;

/// Distances from the middle are clamped to this many halves.
const MAX_RELATIVE: i64 = 1 << 26;

/// Largest magnitude of a coordinate: 2 in 2^-16.
pub const COORDINATE_LIMIT: i32 = 1 << 17;

/// Of a hundred anchors, those that the box leaves out at either end of an axis.
const LEFT_OUT: usize = 5;

/// The box that holds the middle nine tenths of the anchors on each axis.
///
/// Quantiles and not the extremes: a scan of a room has stray anchors a hundred rooms away, and a box around those would
/// squeeze the room into one texel. The middle of the two quantiles and not the median: it gives the smallest box that
/// holds them, also where anchors crowd on one side. Without any anchor, the unit box at the origin.
#[must_use]
pub fn robust_frame(cells: &[[i32; 3]]) -> ContextFrame {
    let mut frame = ContextFrame { center: [0; 3], half: [1; 3] };
    let Some(last) = cells.len().checked_sub(1) else { return frame };
    // By parts, as the product of a count and a percentage might not fit.
    let left_out = last / 100 * LEFT_OUT + last % 100 * LEFT_OUT / 100;
    for axis in 0..3 {
        let mut values: Vec<i32> = cells.iter().map(|cell| cell[axis]).collect();
        let low = *values.select_nth_unstable(left_out).1;
        let high = *values.select_nth_unstable(last - left_out).1;
        let center = low.midpoint(high);
        frame.center[axis] = center;
        // `midpoint` rounds towards zero: the farther of the two ends decides.
        frame.half[axis] = high.abs_diff(center).max(low.abs_diff(center)).max(1);
    }
    frame
}

/// Contracted coordinates of cells: x, y, z in 2^-16, at most [`COORDINATE_LIMIT`] in magnitude. A half of zero counts as
/// one.
#[must_use]
pub fn coordinates(frame: &ContextFrame, cells: &[[i32; 3]]) -> Vec<[i32; 3]> {
    cells.par_iter().map(|cell| contract(relative(frame, *cell))).collect()
}

/// (cell - center) / half in 2^-16, at most [`MAX_RELATIVE`] in magnitude.
fn relative(frame: &ContextFrame, cell: [i32; 3]) -> [i64; 3] {
    std::array::from_fn(|axis| {
        let distance = i64::from(cell[axis]) - i64::from(frame.center[axis]);
        // |distance| < 2^32, so the product is below 2^48.
        let relative = distance * ONE / i64::from(frame.half[axis].max(1));
        relative.clamp(-MAX_RELATIVE, MAX_RELATIVE)
    })
}

/// The contraction of TC-GS (3) (METHOD.md §4.3): the identity within distance 1, (2 - 1 / n) u / n at distance n beyond.
fn contract(u: [i64; 3]) -> [i32; 3] {
    // Each square is at most 2^52, so the sum is below 2^54.
    let square: i64 = u.iter().map(|x| x * x).sum();
    let n = square.unsigned_abs().isqrt() as i64;
    let limit = i64::from(COORDINATE_LIMIT);
    if n <= ONE {
        return u.map(|x| x.clamp(-limit, limit) as i32);
    }
    // n < 2^27, so the numerator is below 2^44; r is below 2^17, and the products below are at most 2^43.
    let r = (2 * n - ONE) * ONE / n;
    u.map(|x| (x * r / n).clamp(-limit, limit) as i32)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The documented formula in 128 bits, where nothing can overflow.
    fn reference(frame: &ContextFrame, cell: [i32; 3]) -> [i32; 3] {
        let u: [i128; 3] = std::array::from_fn(|axis| {
            let distance = i128::from(cell[axis]) - i128::from(frame.center[axis]);
            ((distance << 16) / i128::from(frame.half[axis])).clamp(-(1 << 26), 1 << 26)
        });
        let square: i128 = u.iter().map(|x| x * x).sum();
        let mut n = libm::sqrt(square as f64) as i128;
        while n * n > square {
            n -= 1;
        }
        while (n + 1) * (n + 1) <= square {
            n += 1;
        }
        if n <= 1 << 16 {
            return u.map(|x| x as i32);
        }
        let r = ((2 * n - (1 << 16)) << 16) / n;
        u.map(|x| (x * r / n).clamp(-(1 << 17), 1 << 17) as i32)
    }

    /// The paper's contraction in f64.
    fn exact(frame: &ContextFrame, cell: [i32; 3]) -> [f64; 3] {
        let u: [f64; 3] = std::array::from_fn(|axis| {
            let distance = f64::from(cell[axis]) - f64::from(frame.center[axis]);
            (distance / f64::from(frame.half[axis])).clamp(-1024.0, 1024.0)
        });
        let n = libm::sqrt(u.iter().map(|x| x * x).sum());
        if n <= 1.0 { u } else { u.map(|x| (2.0 - 1.0 / n) * x / n) }
    }

    fn extreme() -> impl Strategy<Value = i32> {
        prop_oneof![any::<i32>(), Just(i32::MIN), Just(i32::MAX), -300..300_i32, Just(0)]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        #[test]
        fn coordinates_are_the_documented_integers_and_near_the_papers(
            cell in prop::array::uniform3(extreme()),
            center in prop::array::uniform3(extreme()),
            half in prop::array::uniform3(prop_oneof![1..=u32::MAX, 1..400_u32, Just(1), Just(u32::MAX)]),
        ) {
            let frame = ContextFrame { center, half };
            let [actual] = coordinates(&frame, &[cell])[..] else { panic!("one cell, one coordinate") };
            prop_assert_eq!(actual, reference(&frame, cell));
            prop_assert!(actual.iter().all(|v| v.abs() <= COORDINATE_LIMIT));
            for (v, exact) in actual.iter().zip(exact(&frame, cell)) {
                let v = f64::from(*v) / 65536.0;
                // Truncations of u, n, r and v: a few units of 2^-16.
                prop_assert!((v - exact).abs() <= 8.0 / 65536.0, "{} for {}", v, exact);
            }
        }
    }

    #[test]
    fn the_frame_holds_nine_tenths_and_ignores_strays() {
        let mut cells: Vec<[i32; 3]> = (0..=1000).map(|x| [x - 200, 3 * x, 7]).collect();
        let frame = ContextFrame { center: [300, 1500, 7], half: [450, 1350, 1] };
        assert_eq!(robust_frame(&cells), frame);
        cells[1000] = [i32::MAX, i32::MAX, 7];
        cells[0] = [i32::MIN, i32::MIN, 7];
        assert_eq!(robust_frame(&cells), frame);
        cells.reverse();
        assert_eq!(robust_frame(&cells), frame, "the order does not matter");
    }

    #[test]
    fn small_and_extreme_clouds_have_a_frame() {
        assert_eq!(robust_frame(&[]), ContextFrame { center: [0; 3], half: [1; 3] });
        assert_eq!(robust_frame(&[[-5, 0, 9]]), ContextFrame { center: [-5, 0, 9], half: [1; 3] });
        let frame = robust_frame(&[[i32::MIN; 3], [i32::MAX; 3]]);
        assert!(frame.half.iter().all(|half| *half >= 1 << 31), "{frame:?}");
        let corners = coordinates(&frame, &[[i32::MIN; 3], [i32::MAX; 3]]);
        // The corner of the box, at distance sqrt(3): (2 - 1 / sqrt(3)) / sqrt(3) of 2^16.
        assert!(corners.iter().flatten().all(|v| (53_827..=53_829).contains(&v.abs())), "{corners:?}");
        for pair in [[[3, 0, 0], [4, 0, 0]], [[-4, 0, 0], [-3, 0, 0]]] {
            let frame = robust_frame(&pair);
            let inside = |cell: [i32; 3]| cell[0].abs_diff(frame.center[0]) <= frame.half[0];
            assert!(pair.into_iter().all(inside), "{frame:?}");
        }
    }
}
