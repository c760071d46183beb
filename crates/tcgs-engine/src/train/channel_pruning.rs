//! Channel pruning: a model's change to fewer feature channels, in another basis, and fewer offset slots.
//!
//! Invariant: but for channels and slots that are left out, the scene renders as before.
//!
//! Adam's second moments of features and their weights are mapped as those of uncorrelated gradients. Their first moments begin at
//! zero: divided by other second moments, momentum would carry the networks elsewhere, and in short runs that ruins the picture.

use std::ops::Range;

use super::{MaskRows, Statistics, densify::TrainableAnchors, feature_basis::FeatureBasis};
use crate::model::{AnchorRows, LayerSpec, ModelShape, NetworkLayout};

/// The channels and offset slots that a model keeps.
pub(super) struct ChannelPruning {
    /// The shape before.
    pub(super) from: ModelShape,
    /// The features' new basis.
    pub(super) basis: FeatureBasis,
    /// Offset slots that are kept, ascending; at least one.
    pub(super) slots: Vec<usize>,
}

impl ChannelPruning {
    /// The shape after.
    pub(super) fn shape(&self) -> ModelShape {
        ModelShape { features: self.basis.channels, offsets: self.slots.len(), ..self.from }
    }

    /// The values of the kept slots, of `width` values each, of rows that have one group a slot.
    pub(super) fn of_slots<'a, T: Copy>(
        &'a self,
        row: &'a [T],
        width: usize,
    ) -> impl Iterator<Item = T> + 'a {
        self.slots.iter().flat_map(move |slot| row[slot * width..(slot + 1) * width].iter().copied())
    }

    /// Rows of anchors, whose features `feature` maps.
    fn rows(&self, values: &[f32], feature: impl Fn(&[f32]) -> Vec<f32>) -> Vec<f32> {
        let from = self.from;
        let mut pruned = Vec::with_capacity(values.len() / from.row() * self.shape().row());
        for row in values.chunks_exact(from.row()) {
            pruned.extend(feature(&row[..from.features]));
            pruned.extend_from_slice(&row[from.scaling_column()..from.offset_column()]);
            pruned.extend(self.of_slots(&row[from.offset_column()..], 3));
        }
        pruned
    }

    fn mask(&self, mask: u32) -> u32 {
        self.slots.iter().zip(0..).fold(0, |bits, (slot, bit)| bits | ((mask >> slot) & 1) << bit)
    }

    /// The statistics of growth.
    pub(super) fn statistics(&self, statistics: &Statistics) -> Statistics {
        let offsets = self.from.offsets;
        let values = statistics.values.chunks_exact(Statistics::width(self.from)).flat_map(|row| {
            let (sums, rest) = row.split_at(offsets);
            let (views, rest) = rest.split_at(offsets);
            self.of_slots(sums, 1)
                .chain(self.of_slots(views, 1))
                .chain(rest.iter().copied())
                .collect::<Vec<_>>()
        });
        Statistics { shape: self.shape(), values: values.collect() }
    }

    fn masks(&self, masks: &MaskRows) -> MaskRows {
        let of = |values: &[f32]| {
            let rows = values.chunks_exact(self.from.offsets);
            rows.flat_map(|row| self.of_slots(row, 1).collect::<Vec<_>>()).collect()
        };
        MaskRows { logits: of(&masks.logits), first: of(&masks.first), second: of(&masks.second) }
    }

    /// Anchors with all their state.
    pub(super) fn anchors(&self, state: TrainableAnchors) -> TrainableAnchors {
        let TrainableAnchors { anchors, first, second, masks } = state;
        let basis = &self.basis;
        TrainableAnchors {
            first: self.rows(&first, |_| vec![0.0; basis.channels]),
            second: self.rows(&second, |row| basis.squared_gradient(row)),
            masks: masks.map(|masks| self.masks(&masks)),
            anchors: AnchorRows {
                shape: self.shape(),
                values: self.rows(&anchors.values, |row| basis.feature(row)),
                masks: anchors.masks.iter().map(|mask| self.mask(*mask)).collect(),
                ..anchors
            },
        }
    }

    /// The networks' parameters and moments.
    pub(super) fn networks(&self, networks: [Vec<f32>; 3]) -> [Vec<f32>; 3] {
        let [values, first, second] = networks;
        let (from, to) = (NetworkLayout::new(self.from), NetworkLayout::new(self.shape()));
        let mut pruned = [(); 3].map(|()| vec![0.0; to.parameters]);
        let outputs = from.hidden.outputs;
        for output in 0..outputs {
            let of = |values: &[f32]| -> (Vec<f32>, Vec<f32>, f32) {
                let column = |inputs: Range<usize>| {
                    inputs.map(|input| values[from.hidden.weights + input * outputs + output]).collect()
                };
                let features = self.from.features;
                (column(0..features), column(features..from.hidden.inputs), values[from.hidden.bias + output])
            };
            let mut put = |array: usize, features: Vec<f32>, view: Vec<f32>, bias: f32| {
                for (input, weight) in features.into_iter().chain(view).enumerate() {
                    pruned[array][to.hidden.weights + input * outputs + output] = weight;
                }
                pruned[array][to.hidden.bias + output] = bias;
            };
            let (weights, view, bias) = of(&values);
            let (weights, added) = self.basis.weights(&weights);
            put(0, weights, view, (f64::from(bias) + added) as f32);
            let (_, view, bias) = of(&first);
            put(1, vec![0.0; self.basis.channels], view, bias);
            let (weights, view, bias) = of(&second);
            put(2, self.basis.squared_weight_gradient(&weights), view, bias);
        }
        for (head, (old, new)) in from.heads.iter().zip(&to.heads).enumerate() {
            let width = [1, 7, 3][head];
            for (array, values) in [&values, &first, &second].into_iter().enumerate() {
                self.head(width, (old, values), (new, &mut pruned[array]));
            }
        }
        pruned
    }

    fn head(
        &self,
        width: usize,
        (old, values): (&LayerSpec, &[f32]),
        (new, pruned): (&LayerSpec, &mut [f32]),
    ) {
        for row in 0..=old.inputs {
            // The biases follow the weights of the last input.
            let (from, to) = (old.weights + row * old.outputs, new.weights + row * new.outputs);
            let kept = self.of_slots(&values[from..from + old.outputs], width);
            pruned[to..to + new.outputs].iter_mut().zip(kept).for_each(|(place, value)| *place = value);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        domain::Lattice,
        train::feature_basis::{FeatureMoments, add_products},
    };

    const FROM: ModelShape = ModelShape::new(6, 4);

    fn random(rng: &mut Pcg64, len: usize) -> Vec<f32> {
        (0..len).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    fn state(rng: &mut Pcg64, anchors: usize) -> TrainableAnchors {
        let len = anchors * FROM.row();
        TrainableAnchors {
            first: random(rng, len),
            second: random(rng, len),
            masks: Some(MaskRows {
                logits: (0..4 * anchors).map(|i| i as f32).collect(),
                first: (0..4 * anchors).map(|i| 100.0 + i as f32).collect(),
                second: (0..4 * anchors).map(|i| 200.0 + i as f32).collect(),
            }),
            anchors: AnchorRows {
                shape: FROM,
                lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
                cells: (0..anchors as i32).map(|x| [x, 0, 0]).collect(),
                values: random(rng, len),
                masks: (0..anchors as u32).map(|anchor| anchor % 16).collect(),
            },
        }
    }

    fn pruning(state: &TrainableAnchors, rng: &mut Pcg64, quant_step: f64) -> ChannelPruning {
        let rows = (0..state.anchors.len()).map(|anchor| &state.anchors.row(anchor)[..FROM.features]);
        let mut sensitivity = vec![0.0; FROM.features * FROM.features];
        for _ in 0..20 {
            let row: Vec<f64> = random(rng, FROM.features).into_iter().map(f64::from).collect();
            add_products(&mut sensitivity, &row, 1.0);
        }
        let basis = FeatureBasis::of(&FeatureMoments::of(rows, FROM.features), &sensitivity, quant_step);
        ChannelPruning { from: FROM, basis: basis.expect("a basis"), slots: vec![0, 3] }
    }

    /// The networks' outputs for a feature and the four inputs of a view.
    fn outputs(shape: ModelShape, networks: &[f32], feature: &[f32]) -> Vec<f64> {
        let layout = NetworkLayout::new(shape);
        let layer = |spec: &LayerSpec, input: &[f64], output: usize| {
            let weight = |i: usize| f64::from(networks[spec.weights + i * spec.outputs + output]);
            let sum: f64 = input.iter().enumerate().map(|(i, value)| weight(i) * value).sum();
            sum + f64::from(networks[spec.bias + output])
        };
        let input: Vec<f64> =
            feature.iter().map(|value| f64::from(*value)).chain([0.6, 0.0, -0.8, 2.0]).collect();
        let hidden: Vec<f64> =
            (0..layout.hidden.outputs).map(|output| layer(&layout.hidden, &input, output).max(0.0)).collect();
        let of = |head: &LayerSpec| {
            let part = &hidden[head.input_row..head.input_row + head.inputs];
            (0..head.outputs).map(|output| layer(head, part, output)).collect::<Vec<_>>()
        };
        layout.heads.iter().flat_map(of).collect()
    }

    #[test]
    fn kept_slots_look_as_before() {
        let mut rng = Pcg64::seed_from_u64(1);
        let state = state(&mut rng, 40);
        let pruning = pruning(&state, &mut rng, 0.0);
        let parameters = NetworkLayout::new(FROM).parameters;
        let networks = [(); 3].map(|()| random(&mut rng, parameters));
        let [pruned, first, second] = pruning.networks(networks.clone());
        assert!([&first, &second].iter().all(|moments| moments.len() == pruned.len()));
        let (old, new) = (NetworkLayout::new(FROM).hidden, NetworkLayout::new(pruning.shape()).hidden);
        let of_view = 6 * old.outputs;
        assert!(first[new.weights..][..of_view].iter().all(|moment| *moment == 0.0), "no momentum");
        assert_eq!(first[new.weights + of_view..new.bias], networks[1][old.weights + of_view..old.bias]);
        let after = pruning.anchors(state.clone());
        assert!(after.first.chunks_exact(12 + 6).all(|row| row[..6] == [0.0; 6]), "no momentum");
        assert_eq!(after.first[6..12], state.first[6..12]);
        let shape = pruning.shape();
        assert_eq!((shape, after.anchors.shape), (ModelShape::new(6, 2), shape));
        for anchor in 0..40 {
            let (before, after) = (state.anchors.row(anchor), after.anchors.row(anchor));
            assert_eq!(before[6..12], after[6..12], "scalings");
            assert_eq!([&before[12..15], &before[21..24]].concat(), after[12..], "offsets of slots 0 and 3");
            let old = outputs(FROM, &networks[0], &before[..6]);
            let new = outputs(shape, &pruned, &after[..6]);
            let kept = [0, 3, 4, 10, 25, 31, 32, 34, 41, 43];
            let at = [0, 1, 2, 8, 9, 15, 16, 18, 19, 21];
            for (old_row, new_row) in kept.into_iter().zip(at) {
                assert!((old[old_row] - new[new_row]).abs() < 1e-4, "output {old_row}");
            }
        }
    }

    #[test]
    fn masks_logits_and_statistics_stay_with_their_slots() {
        let mut rng = Pcg64::seed_from_u64(2);
        let state = state(&mut rng, 17);
        let pruning = pruning(&state, &mut rng, 0.0);
        let after = pruning.anchors(state);
        assert_eq!(after.anchors.masks[..10], [0, 1, 0, 1, 0, 1, 0, 1, 2, 3]);
        let masks = after.masks.expect("masks learn");
        assert_eq!(masks.logits[..4], [0.0, 3.0, 4.0, 7.0]);
        assert_eq!((masks.first[1], masks.second[2]), (103.0, 204.0));
        let width = Statistics::width(FROM);
        let values = (0..2 * width).map(|i| i as f32).collect();
        let statistics = pruning.statistics(&Statistics { shape: FROM, values });
        assert_eq!(statistics.values[..6], [0.0, 3.0, 4.0, 7.0, 8.0, 9.0]);
        assert_eq!(statistics.values.len(), 12);
    }
}
