//! The anchors and networks that a training begins with.
//!
//! What the networks are to say of all slots of an anchor (opacities, sizes, rotations, colors) is reduced to its principal
//! components over all anchors: features are the coordinates along them, and the networks begin as the map back.

use rand::Rng;

use super::principal::principal_components;
use crate::domain::anchors::VIEW_INPUTS;
use crate::model::{AnchorRows, NetworkLayout};

/// Values of a slot, before their activations: opacity, three sizes, quaternion (w, x, y, z), color.
pub(super) const SLOT: usize = 11;
/// Weights of these values in the components.
const WEIGHTS: [f64; SLOT] = [3.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0];
/// Largest share of a network's hidden units that pass a component on; the others begin random.
const PASSED: f64 = 0.75;
/// Components that deviate less are left to random units.
const MIN_DEVIATION: f64 = 1e-3;

/// How the hidden units begin that pass a component on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassingUnits {
    /// Standard deviations of its component below the mean that a unit passes on; what is further below it cuts off.
    pub reach: f64,
    /// Weights from the view, by the usual.
    pub of_view: f32,
}

impl PassingUnits {
    /// They cut off hardly anything: anchors begin as what they are made of, from all sides alike.
    pub const LINEAR: Self = Self { reach: 3.0, of_view: 0.1 };
    /// They cut a sixth of the anchors off, another part of them for each view: a scene loses at first, and learns sooner what
    /// differs between anchors and between views together.
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
    /// `anchors` with features and networks that make about `slots` of them. `random` scales the weights from hidden units that pass
    /// nothing on to the outputs of the opacity, covariance and color networks.
    pub(super) fn saying(
        mut anchors: AnchorRows,
        slots: SlotValues,
        units: PassingUnits,
        random: [f32; 3],
        rng: &mut impl Rng,
    ) -> Self {
        let networks = teach(&mut anchors, slots, units, random, rng);
        Self { anchors, networks }
    }
}

/// What networks are to say: [`SLOT`] values of each slot of each anchor, some of them free.
#[derive(Debug, Clone, Default)]
pub(super) struct SlotValues {
    values: Vec<f64>,
    known: Vec<bool>,
}

impl SlotValues {
    /// None yet, with room for so many slots.
    pub(super) fn with_capacity(slots: usize) -> Self {
        Self { values: Vec::with_capacity(slots * SLOT), known: Vec::with_capacity(slots * SLOT) }
    }

    /// Appends the next slot; where a value is not known it only begins as given.
    pub(super) fn push(&mut self, slot: &[f64; SLOT], known: impl FnMut(usize) -> bool) {
        self.values.extend(slot);
        self.known.extend((0..SLOT).map(known));
    }
}

/// Features and networks that say `slots`, as far as the principal components do; `random` as in [`FirstAnchors::saying`].
fn teach(
    anchors: &mut AnchorRows,
    slots: SlotValues,
    units: PassingUnits,
    random: [f32; 3],
    rng: &mut impl Rng,
) -> Vec<f32> {
    let SlotValues { values: mut targets, known } = slots;
    let shape = anchors.shape;
    let width = SLOT * shape.offsets;
    let passed = ((PASSED * shape.features as f64).ceil() as usize).min(shape.features);
    for row in targets.chunks_exact_mut(SLOT) {
        for (value, weight) in row.iter_mut().zip(WEIGHTS) {
            *value *= weight;
        }
    }
    let found = principal_components(targets, &known, width, passed);
    let kept = found.directions.len();
    let deviations: Vec<f64> = (0..kept)
        .map(|c| {
            let squares = found.coordinates.iter().skip(c).step_by(kept).map(|z| z * z).sum::<f64>();
            (squares / anchors.len() as f64).sqrt()
        })
        .take_while(|deviation| *deviation >= MIN_DEVIATION)
        .collect();
    let count = deviations.len();
    // Feature and weight share a component's deviation evenly.
    let of_feature: Vec<f64> = deviations.iter().map(|deviation| deviation.sqrt().recip()).collect();
    for (row, z) in anchors.values.chunks_exact_mut(shape.row()).zip(found.coordinates.chunks_exact(kept)) {
        for ((feature, z), factor) in row.iter_mut().zip(z).zip(&of_feature) {
            *feature = (z * factor) as f32;
        }
    }
    let layout = NetworkLayout::new(shape);
    let mut networks = layout.initial(rng);
    let hidden = &layout.hidden;
    for (head, random) in random.into_iter().enumerate() {
        for unit in 0..shape.features {
            let column = head * shape.features + unit;
            for input in 0..hidden.inputs {
                let weight = &mut networks[hidden.weights + input * hidden.outputs + column];
                if unit < count {
                    *weight = match input {
                        _ if input == unit => 1.0,
                        _ if input < shape.features => 0.0,
                        _ if input + 1 < shape.features + VIEW_INPUTS => units.of_view * *weight,
                        // The distance.
                        _ => 0.0,
                    };
                }
            }
            if unit < count {
                networks[hidden.bias + column] = (units.reach * deviations[unit] * of_feature[unit]) as f32;
            }
        }
        let spec = &layout.heads[head];
        for output in 0..spec.outputs {
            let (slot, value) = match head {
                0 => (output, 0),
                1 => (output / 7, 1 + output % 7),
                _ => (output / 3, 8 + output % 3),
            };
            let target = slot * SLOT + value;
            let mut bias = found.mean[target] / WEIGHTS[value];
            for unit in 0..spec.inputs {
                let weight = &mut networks[spec.weights + unit * spec.outputs + output];
                if unit < count {
                    let back = found.directions[unit][target] / (WEIGHTS[value] * of_feature[unit]);
                    *weight = back as f32;
                    bias -= back * units.reach * deviations[unit] * of_feature[unit];
                } else {
                    *weight *= random;
                }
            }
            networks[spec.bias + output] = bias as f32;
        }
    }
    networks
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
