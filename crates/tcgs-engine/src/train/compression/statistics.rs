//! Mean and standard deviation of each channel of the attributes, as for static tables.
//!
//! Invariant: the values are finite and the deviations not negative, even for rows that are not finite.

use crate::{domain::anchors::SCALINGS_PER_ANCHOR, model::AnchorRows, train::context::GroupStatistics};

/// Share of a channel's values trimmed at either end to measure the width of the others.
const TRIMMED_SHARE: f64 = 0.02;

/// Values are clamped to this many widths from the mean: one anchor as large as the scene must not dominate the deviation, yet
/// tails have to count.
const MAX_WIDTHS: f64 = 10.0;

/// The statistics of features, linear scalings and unmasked offsets, in steps of `base` (scalings' in world units).
pub(super) fn group_statistics(anchors: &AnchorRows, base: [f32; 3]) -> [GroupStatistics; 3] {
    let shape = anchors.shape;
    let values = |column: usize| (0..anchors.len()).map(move |anchor| anchors.row(anchor)[column]);
    let features = (0..shape.features).map(|column| of(values(column), base[0]));
    let scalings = (0..SCALINGS_PER_ANCHOR)
        .map(|channel| of(values(shape.scaling_column() + channel).map(f32::exp), base[1]));
    let offsets = (0..3 * shape.offsets).map(|channel| {
        let kept = values(shape.offset_column() + channel).zip(&anchors.masks);
        of(kept.filter(|(_, mask)| (*mask >> (channel / 3)) & 1 == 1).map(|(value, _)| value), base[2])
    });
    [features.collect(), scalings.collect(), offsets.collect()].map(|channels: Vec<(f32, f32)>| {
        let (means, deviations) = channels.into_iter().unzip();
        GroupStatistics { means, deviations }
    })
}

/// Mean and standard deviation of a channel's finite values, in steps, with outliers clamped.
fn of(values: impl Iterator<Item = f32>, step: f32) -> (f32, f32) {
    let mut values: Vec<f64> =
        values.map(|value| f64::from(value) / f64::from(step)).filter(|value| value.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let trimmed = (values.len() as f64 * TRIMMED_SHARE) as usize;
    let middle = &values[trimmed..values.len() - trimmed];
    if middle.is_empty() {
        return (0.0, 0.0);
    }
    let (mean, width) = moments(middle);
    values
        .iter_mut()
        .for_each(|value| *value = value.clamp(mean - MAX_WIDTHS * width, mean + MAX_WIDTHS * width));
    let (mean, deviation) = moments(&values);
    (mean as f32, deviation as f32)
}

fn moments(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (mean, (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::Lattice, model::ModelShape};

    const SHAPE: ModelShape = ModelShape::new(1, 1);

    fn anchors(rows: &[[f32; 10]], masks: Vec<u32>) -> AnchorRows {
        let cells = (0..).map(|x| [x, 0, 0]).take(rows.len()).collect();
        let lattice = Lattice { voxel: 1.0, origin: [0.0; 3] };
        AnchorRows { shape: SHAPE, lattice, cells, values: rows.concat(), masks }
    }

    #[test]
    fn figures_are_in_steps_scalings_linear_and_masked_offsets_left_out() {
        let row = |feature: f32, scaling: f32, offset: f32| {
            let log = scaling.ln();
            [feature, log, log, log, log, log, log, offset, 0.0, 0.0]
        };
        let rows = [row(1.0, 4.0, 7.0), row(3.0, 8.0, 100.0)];
        let [features, scalings, offsets] = group_statistics(&anchors(&rows, vec![1, 0]), [0.5, 2.0, 1.0]);
        assert_eq!((features.means, features.deviations), (vec![4.0], vec![2.0]));
        let near = |found: &[f32], expected: f32| found.iter().all(|v| (v - expected).abs() < 1e-5);
        assert!(near(&scalings.means, 3.0) && near(&scalings.deviations, 1.0));
        assert_eq!((offsets.means, offsets.deviations), (vec![7.0, 0.0, 0.0], vec![0.0; 3]));
    }

    #[test]
    fn one_vast_value_in_a_hundred_and_numbers_that_are_none_change_little() {
        let mut rows: Vec<_> = (0..100).map(|i| [if i % 2 == 0 { 1.0 } else { -1.0 }; 10]).collect();
        rows[0] = [1e30; 10];
        rows[1] = [f32::NAN; 10];
        for group in group_statistics(&anchors(&rows, vec![1; 100]), [1.0; 3]) {
            for (mean, deviation) in group.means.iter().zip(&group.deviations) {
                assert!(mean.abs() < 2.0 && (0.9..1.5).contains(deviation), "{mean} {deviation}");
            }
        }
        let none = group_statistics(&anchors(&[[f32::NAN; 10]], vec![1]), [1.0; 3]);
        assert!(none.iter().all(|group| group.means.iter().chain(&group.deviations).all(|v| *v == 0.0)));
    }
}
