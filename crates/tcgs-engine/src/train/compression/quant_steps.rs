//! The quantization steps of anchors across growth and pruning.

use std::collections::HashMap;

use crate::domain::context_model::STEP_OCTAVES;

/// The steps `[N][3]` of the anchors at `cells`: anchors that were among `before` keep theirs, new ones have `initial`.
pub(super) fn carry_quant_steps(
    before: &[[i32; 3]],
    steps: &[f32],
    initial: [f32; 3],
    cells: &[[i32; 3]],
) -> Vec<f32> {
    let known: HashMap<&[i32; 3], &[f32; 3]> = before.iter().zip(steps.as_chunks().0).collect();
    cells.iter().flat_map(|cell| known.get(cell).map_or(initial, |steps| **steps)).collect()
}

/// The geometric mean of the steps of each group; the initial steps of new anchors.
pub(super) fn mean_quant_steps(steps: &[f32]) -> [f32; 3] {
    let anchors = steps.as_chunks::<3>().0;
    std::array::from_fn(|group| {
        let logs = anchors.iter().map(|steps| f64::from(steps[group]).ln());
        (logs.sum::<f64>() / anchors.len().max(1) as f64).exp() as f32
    })
}

/// Octaves from the `base` steps to `steps`, in the range of step adjustments.
pub(super) fn adjustments_of(steps: [f32; 3], base: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|group| {
        let octaves = (steps[group] / base[group]).log2();
        if octaves.is_finite() { octaves.clamp(-STEP_OCTAVES, STEP_OCTAVES) } else { 0.0 }
    })
}

/// The adjustment in octaves that, applied to every anchor, has the same mean squared error as these steps `[N][3]`.
pub(super) fn static_adjustments(steps: &[f32], base: [f32; 3], limit: f32) -> [f32; 3] {
    let anchors = steps.as_chunks::<3>().0;
    std::array::from_fn(|group| {
        let squares = anchors.iter().map(|steps| (f64::from(steps[group]) / f64::from(base[group])).powi(2));
        let mean = squares.sum::<f64>() / anchors.len().max(1) as f64;
        if mean > 0.0 { (0.5 * mean.log2() as f32).clamp(-limit, limit) } else { 0.0 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn anchors_that_stay_keep_their_steps_wherever_they_now_are() {
        let before = [[0, 0, 0], [1, 0, 0], [2, 0, 0]];
        let steps = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        let after = carry_quant_steps(&before, &steps, [0.1, 0.2, 0.3], &[[2, 0, 0], [5, 5, 5], [0, 0, 0]]);
        assert_eq!(after, [7.0, 8.0, 9.0, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]);
    }

    #[test]
    fn adjustments_are_octaves_within_their_range() {
        assert_eq!(adjustments_of([1.0, 0.1, 1e9], [0.25, 0.4, 1.0]), [2.0, -2.0, STEP_OCTAVES]);
        assert_eq!(adjustments_of([0.0, f32::NAN, 1.0], [1.0; 3]), [0.0; 3]);
    }

    #[test]
    fn the_usual_step_and_the_adjustment_of_equal_error_are_means_of_their_kind() {
        let steps = [1.0, 0.5, 2.0, 4.0, 0.5, 2.0];
        let usual = mean_quant_steps(&steps);
        assert!(usual.iter().zip([2.0, 0.5, 2.0]).all(|(found, expected)| (found - expected).abs() < 1e-6));
        let found = static_adjustments(&steps, [1.0, 1.0, 1.0], 3.5);
        let expected = [0.5 * 8.5_f32.log2(), -1.0, 1.0];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        assert_eq!(static_adjustments(&[1e6, 1.0, 1.0], [1.0; 3], 3.5), [3.5, 0.0, 0.0]);
        assert_eq!(static_adjustments(&[], [1.0; 3], 3.5), [0.0; 3]);
    }
}
