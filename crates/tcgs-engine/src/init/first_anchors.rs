//! The anchors and networks that a training begins with.
//!
//! The target outputs of the networks for all slots of an anchor (opacities, sizes, rotations, colors) are reduced to their principal
//! components over all anchors. Features are the coordinates along the components, and the networks begin as the inverse map.

use rand::Rng;

use super::principal::{Components, principal_components};
use crate::model::{AnchorRows, LayerSpec, ModelShape, NetworkLayout};

/// Target outputs of a slot, before their activations: opacity, three sizes, quaternion (w, x, y, z), color.
pub(super) const SLOT: usize = 11;
/// Outputs per slot of the opacity, covariance and color networks, and their first target.
const HEADS: [(usize, usize); 3] = [(1, 0), (7, 1), (3, 8)];
/// Weights of the targets in the components.
const WEIGHTS: [f64; SLOT] = [3.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0];
/// Largest share of a network's hidden units that pass a component on; the others begin random.
const PASSED: f64 = 0.75;
/// Components with a smaller standard deviation are left to random units.
const MIN_DEVIATION: f64 = 1e-3;

/// Factor of their random weights from harmonics of the view direction: small, so that the first scene does not depend on these.
const OF_HARMONICS: f32 = 0.1;

/// How the hidden units begin that pass a component on. Each is a rectifier whose bias lifts its component above zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassingUnits {
    /// The bias in standard deviations of the component: anchors that lie further below the mean than this are cut off.
    pub reach: f64,
    /// Factor of the random weights from the view direction.
    pub of_view: f32,
}

impl PassingUnits {
    /// Hardly any anchor is cut off, so the first scene looks like its source, the same from all sides.
    pub const LINEAR: Self = Self { reach: 3.0, of_view: 0.1 };
    /// Each unit cuts off a sixth of the anchors, others in each view. The first scene is worse, and learns sooner how colors differ
    /// between anchors and between views together.
    pub const RECTIFYING: Self = Self { reach: 1.0, of_view: 1.0 };
}

/// Anchors with the networks that make their Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct FirstAnchors {
    /// Anchors and rows.
    pub anchors: AnchorRows,
    /// Parameters by [`NetworkLayout`].
    pub networks: Vec<f32>,
}

impl FirstAnchors {
    /// `anchors` with features and networks that predict `targets`, as far as their principal components do. `random` scales the
    /// weights from hidden units without a component to the outputs of the opacity, covariance and color networks.
    pub(super) fn from_slot_targets(
        mut anchors: AnchorRows,
        targets: SlotTargets,
        units: PassingUnits,
        random: [f32; 3],
        rng: &mut impl Rng,
    ) -> Self {
        let components = TargetComponents::of(targets, anchors.shape);
        components.write_features(&mut anchors);
        let layout = NetworkLayout::new(anchors.shape);
        let mut networks = layout.initial(rng);
        for (head, random) in random.into_iter().enumerate() {
            let first_unit = head * anchors.shape.features;
            components.write_hidden_units(&layout.hidden, first_unit, units, &mut networks);
            components.write_outputs(&layout.heads[head], HEADS[head], units, random, &mut networks);
        }
        Self { anchors, networks }
    }
}

/// Target outputs of the networks: [`SLOT`] values of each slot of each anchor, some of them free.
#[derive(Debug, Clone, Default)]
pub(super) struct SlotTargets {
    values: Vec<f64>,
    known: Vec<bool>,
}

impl SlotTargets {
    /// None yet, with room for `slots` slots.
    pub(super) fn with_capacity(slots: usize) -> Self {
        Self { values: Vec::with_capacity(slots * SLOT), known: Vec::with_capacity(slots * SLOT) }
    }

    /// Appends the next slot; a free value is the first guess of the components.
    pub(super) fn push(&mut self, slot: &[f64; SLOT], known: impl FnMut(usize) -> bool) {
        self.values.extend(slot);
        self.known.extend((0..SLOT).map(known));
    }
}

/// The principal components of the weighted targets that features and hidden units represent.
struct TargetComponents {
    components: Components,
    /// Standard deviations of the components that are used.
    deviations: Vec<f64>,
    /// Factor from a coordinate to its feature: feature and network share a component's deviation evenly.
    to_feature: Vec<f64>,
    features: usize,
}

impl TargetComponents {
    fn of(targets: SlotTargets, shape: ModelShape) -> Self {
        let SlotTargets { mut values, known } = targets;
        for slot in values.chunks_exact_mut(SLOT) {
            for (value, weight) in slot.iter_mut().zip(WEIGHTS) {
                *value *= weight;
            }
        }
        let width = SLOT * shape.offsets;
        let anchors = values.len() / width;
        let max_components = ((PASSED * shape.features as f64).ceil() as usize).min(shape.features);
        let components = principal_components(values, &known, width, max_components);
        let kept = components.directions.len();
        let deviations: Vec<f64> = (0..kept)
            .map(|c| {
                let squares = components.coordinates.iter().skip(c).step_by(kept).map(|z| z * z).sum::<f64>();
                (squares / anchors as f64).sqrt()
            })
            .take_while(|deviation| *deviation >= MIN_DEVIATION)
            .collect();
        let to_feature = deviations.iter().map(|deviation| deviation.sqrt().recip()).collect();
        Self { components, deviations, to_feature, features: shape.features }
    }

    /// The bias of the hidden unit that passes a component on.
    fn bias(&self, unit: usize, units: PassingUnits) -> f64 {
        units.reach * self.deviations[unit] * self.to_feature[unit]
    }

    /// Writes the coordinates of every anchor into its features.
    fn write_features(&self, anchors: &mut AnchorRows) {
        let coordinates = self.components.coordinates.chunks_exact(self.components.directions.len());
        for (row, z) in anchors.values.chunks_exact_mut(anchors.shape.row()).zip(coordinates) {
            for ((feature, z), factor) in row.iter_mut().zip(z).zip(&self.to_feature) {
                *feature = (z * factor) as f32;
            }
        }
    }

    /// Makes the hidden units of a head from `first` on pass one component each; units beyond the components stay random.
    fn write_hidden_units(
        &self,
        hidden: &LayerSpec,
        first: usize,
        units: PassingUnits,
        networks: &mut [f32],
    ) {
        for unit in 0..self.deviations.len() {
            for input in 0..hidden.inputs {
                let weight = &mut networks[hidden.weights + input * hidden.outputs + first + unit];
                *weight = match input.checked_sub(self.features) {
                    None if input == unit => 1.0,
                    None => 0.0,
                    Some(0..3) => units.of_view * *weight,
                    // The distance.
                    Some(3) => 0.0,
                    Some(_) => OF_HARMONICS * *weight,
                };
            }
            networks[hidden.bias + first + unit] = self.bias(unit, units) as f32;
        }
    }

    /// Makes a head map its hidden units back to the targets, of which each slot has `per_slot` from `first` on.
    fn write_outputs(
        &self,
        head: &LayerSpec,
        (per_slot, first): (usize, usize),
        units: PassingUnits,
        random: f32,
        networks: &mut [f32],
    ) {
        for output in 0..head.outputs {
            let value = first + output % per_slot;
            let target = output / per_slot * SLOT + value;
            let mut bias = self.components.mean[target] / WEIGHTS[value];
            for unit in 0..head.inputs {
                let weight = &mut networks[head.weights + unit * head.outputs + output];
                if unit < self.deviations.len() {
                    let back =
                        self.components.directions[unit][target] / (WEIGHTS[value] * self.to_feature[unit]);
                    *weight = back as f32;
                    bias -= back * units.reach * self.deviations[unit] * self.to_feature[unit];
                } else {
                    *weight *= random;
                }
            }
            networks[head.bias + output] = bias as f32;
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::FirstAnchors;
    use crate::model::LayerSpec;
    use crate::model::NetworkLayout;

    /// Outputs of all heads for an anchor seen from a side, before their activations.
    pub(in crate::init) fn outputs(first: &FirstAnchors, anchor: usize) -> Vec<f32> {
        let shape = first.anchors.shape;
        let layout = NetworkLayout::new(shape);
        let mut input = first.anchors.row(anchor)[..shape.features].to_vec();
        input.extend([0.6, 0.0, 0.8, 4.0]);
        let dense = |spec: &LayerSpec, input: &[f32], output: usize| {
            let weights = input
                .iter()
                .enumerate()
                .map(|(i, v)| first.networks[spec.weights + i * spec.outputs + output] * v);
            first.networks[spec.bias + output] + weights.sum::<f32>()
        };
        let hidden: Vec<f32> =
            (0..layout.hidden.outputs).map(|unit| dense(&layout.hidden, &input, unit).max(0.0)).collect();
        let heads = layout.heads.iter();
        heads
            .flat_map(|head| {
                (0..head.outputs)
                    .map(|o| dense(head, &hidden[head.input_row..][..head.inputs], o))
                    .collect::<Vec<_>>()
            })
            .collect()
    }
}
