//! Carries a context model over to the channels that are left after channel pruning.
//!
//! Hidden layers, planes and what is predicted of scalings stay as they are. Of offsets, the outputs of the kept slots stay. Means of
//! features follow their basis, for a mean of a linear map is the map of the means; deviations do not, and begin as those of the
//! whole scene.

use crate::train::{ContextError, channel_pruning::ChannelPruning, context::ContextLayout};

/// Copies the parameters of a context model into those of the smaller one, which are newly initialized. `feature_step` is the base
/// quantization step of features, in which networks predict.
///
/// # Errors
/// [`ContextError::Config`] if the models' planes differ.
pub(super) fn copy_kept_channels(
    pruning: &ChannelPruning,
    feature_step: f32,
    (old, from): (&ContextLayout, &[f32]),
    (new, to): (&ContextLayout, &mut [f32]),
) -> Result<(), ContextError> {
    let hidden = |layout: &ContextLayout| layout.hidden.weights..layout.hidden.bias + layout.hidden.outputs;
    to[hidden(new)].copy_from_slice(&from[hidden(old)]);
    if new.config.kind.sampled() > 0 {
        new.copy_planes(to, old, from)?;
    }
    for (group, (old_head, new_head)) in old.heads.iter().zip(&new.heads).enumerate() {
        let (before, after) = (old.config.channels[group], new.config.channels[group]);
        // The row after those of the inputs holds the biases.
        for input in 0..=old_head.inputs {
            let is_bias = input == old_head.inputs;
            let old_row = &from[old_head.weights + input * old_head.outputs..][..old_head.outputs];
            let new_row = &mut to[new_head.weights + input * new_head.outputs..][..new_head.outputs];
            // Means, logarithms of deviations, the step adjustment.
            new_row[2 * after] = old_row[2 * before];
            match group {
                0 => {
                    let basis = &pruning.basis;
                    let shift = if is_bias { f64::from(feature_step).recip() } else { 0.0 };
                    let means: Vec<f64> = old_row[..before]
                        .iter()
                        .zip(&basis.mean)
                        .map(|(value, mean)| f64::from(*value) - shift * mean)
                        .collect();
                    for (value, map) in new_row.iter_mut().zip(basis.to.chunks_exact(before)) {
                        *value =
                            map.iter().zip(&means).map(|(weight, mean)| weight * mean).sum::<f64>() as f32;
                    }
                }
                1 => new_row.copy_from_slice(old_row),
                _ => {
                    let (means, deviations) = old_row[..2 * before].split_at(before);
                    let kept = pruning.of_slots(means, 3).chain(pruning.of_slots(deviations, 3));
                    new_row.iter_mut().zip(kept).for_each(|(place, value)| *place = value);
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        domain::ContextKind,
        model::ModelShape,
        train::{
            context::{ContextConfig, GroupStatistics, PlaneConfig},
            feature_basis::FeatureBasis,
        },
    };

    const STEP: f32 = 0.25;

    fn config(kind: ContextKind, channels: [usize; 3]) -> ContextConfig {
        let planes = PlaneConfig { edge: 8, channels: 4, layers: 0, hidden: 4, latents: 4 };
        ContextConfig { kind, channels, hidden: [5, 3, 4], planes }
    }

    /// A group's output from its hidden values.
    fn output(layout: &ContextLayout, values: &[f32], group: usize, hidden: &[f64], row: usize) -> f64 {
        let head = &layout.heads[group];
        let weight = |input: usize| f64::from(values[head.weights + input * head.outputs + row]);
        hidden.iter().enumerate().map(|(input, value)| weight(input) * value).sum::<f64>()
            + weight(head.inputs)
    }

    #[test]
    fn predictions_are_those_of_the_model_before_in_the_basis_and_slots_of_the_one_after() {
        let mut rng = Pcg64::seed_from_u64(7);
        let basis = FeatureBasis {
            width: 3,
            channels: 2,
            mean: vec![0.5, -1.0, 0.25],
            to: vec![1.0, 2.0, 0.0, 0.0, -1.0, 0.5],
            back: vec![0.0; 6],
            bits_share: 1.0,
        };
        let pruning = ChannelPruning { from: ModelShape::new(3, 3), basis, slots: vec![0, 2] };
        for kind in [ContextKind::Position, ContextKind::TriPlaneKnn] {
            let old = ContextLayout::new(config(kind, [3, 6, 9])).expect("known sizes");
            let new = ContextLayout::new(config(kind, [2, 6, 6])).expect("known sizes");
            let from: Vec<f32> = (0..old.parameters).map(|_| rng.random_range(-1.0..1.0)).collect();
            let statistics = [2, 6, 6].map(|channels| GroupStatistics {
                means: vec![9.0; channels],
                deviations: vec![4.0; channels],
            });
            let mut to = new.initial(&statistics, &mut rng).expect("statistics");
            copy_kept_channels(&pruning, STEP, (&old, &from), (&new, &mut to)).expect("equal planes");
            assert_eq!(to[..new.hidden.outputs], from[..old.hidden.outputs], "hidden layers");
            assert_eq!(to[new.networks..], from[old.networks..], "planes");
            let hidden: Vec<f64> = (0..5).map(|_| rng.random_range(0.0..2.0)).collect();
            let before = |group: usize, row: usize| {
                output(&old, &from, group, &hidden[..old.heads[group].inputs], row)
            };
            let after =
                |group: usize, row: usize| output(&new, &to, group, &hidden[..new.heads[group].inputs], row);
            let near = |found: f64, expected: f64| {
                assert!((found - expected).abs() < 1e-4, "{found} for {expected}")
            };
            for channel in 0..2 {
                let map = &pruning.basis.to[3 * channel..][..3];
                let mean = |i: usize| before(0, i) - pruning.basis.mean[i] / f64::from(STEP);
                near(after(0, channel), (0..3).map(|i| map[i] * mean(i)).sum());
                near(after(0, 2 + channel), 2.0);
            }
            near(after(0, 4), before(0, 6));
            for row in 0..13 {
                near(after(1, row), before(1, row));
            }
            let kept = [0, 1, 2, 6, 7, 8, 9, 10, 11, 15, 16, 17, 18];
            for (row, old_row) in kept.into_iter().enumerate() {
                near(after(2, row), before(2, old_row));
            }
        }
    }
}
