//! The layout of a context model's parameters in one flat array.
//!
//! The networks come first: their hidden layers as one layer on the common input, then an output layer a group, each on
//! its own part of the hidden values; weights of dense layers are input-major. Then raw planes, layers down, layers up
//! and latents. Tensors of planes are `[3][channels][edge][edge]`, weights of layers `[coarse][fine][3][3]`, where coarse and
//! fine are the channels on the side of the latents and on that of the planes: so the gradient of a layer down by its
//! input is a layer up, and the reverse.

use std::ops::Range;

use rand::{Rng, RngExt};

use super::ContextConfig;
use crate::{
    domain::{AttributeGroup, ContextKind, Mlp, Planes, UpLayer},
    model::LayerSpec,
    train::ContextError,
};

/// Bound of a fresh plane's values (METHOD.md §4.3).
const FIRST_PLANE: f32 = 0.01;

/// Smallest initial standard deviation, in base steps; with a smaller one all symbols are equal.
const MIN_DEVIATION: f32 = 0.05;

/// A convolution of stride two between a coarse and a fine tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvSpec {
    /// Channels on the side of the latents.
    pub coarse: usize,
    /// Channels on the side of the planes.
    pub fine: usize,
    /// Texels along a coarse edge; a fine one has twice as many.
    pub edge: usize,
    /// Where its weights begin, `[coarse][fine][3][3]`.
    pub weights: usize,
    /// Where its bias begins: one a channel of its output.
    pub bias: usize,
}

impl ConvSpec {
    /// Weights.
    #[must_use]
    pub fn weight_count(&self) -> usize {
        self.coarse * self.fine * 9
    }

    /// Values of the coarse tensor.
    #[must_use]
    pub fn coarse_values(&self) -> usize {
        3 * self.coarse * self.edge * self.edge
    }

    /// Values of the fine tensor.
    #[must_use]
    pub fn fine_values(&self) -> usize {
        12 * self.fine * self.edge * self.edge
    }
}

/// The learning rate of each part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContextLearningRates {
    /// Of the groups' networks; for outputs that predict means, in standard deviations of the channel.
    pub networks: f32,
    /// Of raw planes.
    pub planes: f32,
    /// Of layers between planes and latents.
    pub layers: f32,
    /// Of latents.
    pub latents: f32,
}

/// The statistics of a group; a new context model predicts them for every anchor.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupStatistics {
    /// Mean of each channel, in base steps.
    pub means: Vec<f32>,
    /// Standard deviation of each channel, in base steps.
    pub deviations: Vec<f32>,
}

/// The layout for a configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct ContextLayout {
    /// The sizes.
    pub config: ContextConfig,
    /// The groups' hidden layers as one.
    pub hidden: LayerSpec,
    /// The groups' output layers.
    pub heads: [LayerSpec; 3],
    /// Parameters of the networks.
    pub networks: usize,
    /// Where raw planes are.
    pub planes: Range<usize>,
    /// Layers from planes to latents, in this order.
    pub down: Vec<ConvSpec>,
    /// Layers from latents to planes, in this order.
    pub up: Vec<ConvSpec>,
    /// Where latents are.
    pub latents: Range<usize>,
    /// Parameters in all.
    pub parameters: usize,
}

impl ContextLayout {
    /// All layers of the networks.
    #[must_use]
    pub fn network_layers(&self) -> [LayerSpec; 4] {
        let [features, scalings, offsets] = self.heads;
        [self.hidden, features, scalings, offsets]
    }

    /// The layout of `config`.
    ///
    /// # Errors
    /// As [`ContextConfig::check`].
    pub fn new(config: ContextConfig) -> Result<Self, ContextError> {
        config.check()?;
        let mut next = 0;
        let mut take = |count: usize| {
            next += count;
            next - count
        };
        let mut dense = |inputs: usize, outputs: usize, input_row: usize, output_row: usize| LayerSpec {
            inputs,
            outputs,
            weights: take(inputs * outputs),
            bias: take(outputs),
            input_row,
            output_row,
        };
        let hidden = dense(config.inputs(), config.hidden.iter().sum(), 0, 0);
        let rows = config.output_rows();
        let heads = std::array::from_fn(|group| {
            let first = config.hidden[..group].iter().sum();
            dense(config.hidden[group], rows[group + 1] - rows[group], first, rows[group])
        });
        let networks = take(0);
        let has_planes = config.kind.sampled() > 0;
        let layers = if has_planes { config.planes.layers } else { 0 };
        let first_plane = take(if has_planes { config.planes.plane_values() } else { 0 });
        let planes = first_plane..take(0);
        let level_channels = config.planes.level_channels();
        let mut conv = |level: usize, upwards: bool| {
            let (fine, coarse) = (level_channels[level], level_channels[level + 1]);
            ConvSpec {
                coarse,
                fine,
                edge: config.planes.edge >> (level + 1),
                weights: take(coarse * fine * 9),
                bias: take(if upwards { fine } else { coarse }),
            }
        };
        let down: Vec<_> = (0..layers).map(|level| conv(level, false)).collect();
        let up: Vec<_> = (0..layers).rev().map(|level| conv(level, true)).collect();
        let first_latent = take(if has_planes { config.planes.latent_values() } else { 0 });
        let latents = first_latent..take(0);
        Ok(Self { config, hidden, heads, networks, planes, down, up, parameters: latents.end, latents })
    }

    /// Fresh parameters: planes and hidden layers uniform (METHOD.md §4.3), output layers such that every prediction is the
    /// channel's mean and standard deviation.
    ///
    /// # Errors
    /// [`ContextError::Config`] if a group's statistics have another number of channels.
    pub fn initial(
        &self,
        statistics: &[GroupStatistics; 3],
        rng: &mut impl Rng,
    ) -> Result<Vec<f32>, ContextError> {
        let mut values = vec![0.0; self.parameters];
        let mut fill = |range: Range<usize>, bound: f32| {
            values[range].iter_mut().for_each(|value| *value = rng.random_range(-bound..bound));
        };
        let hidden = &self.hidden;
        fill(hidden.weights..hidden.bias + hidden.outputs, 1.0 / (hidden.inputs as f32).sqrt());
        fill(self.planes.clone(), FIRST_PLANE);
        for layer in &self.down {
            let bound = 1.0 / (9.0 * layer.fine as f32).sqrt();
            fill(layer.weights..layer.bias + layer.coarse, bound);
        }
        for layer in &self.up {
            // Nine taps over four positions: each fine value gets a quarter of them on average.
            let bound = 1.0 / (2.25 * layer.coarse as f32).sqrt();
            fill(layer.weights..layer.bias + layer.fine, bound);
        }
        for ((head, statistics), channels) in self.heads.iter().zip(statistics).zip(self.config.channels) {
            let GroupStatistics { means, deviations } = statistics;
            if means.len() != channels || deviations.len() != channels {
                return Err(ContextError::Config(format!(
                    "{} means and {} deviations of {channels} channels",
                    means.len(),
                    deviations.len()
                )));
            }
            values[head.bias..][..channels].copy_from_slice(means);
            for (bias, deviation) in values[head.bias + channels..][..channels].iter_mut().zip(deviations) {
                *bias = deviation.max(MIN_DEVIATION).log2();
            }
        }
        Ok(values)
    }

    /// The learning rate of each parameter. The length of an Adam step does not depend on the gradient's size, so outputs that
    /// predict means learn in proportion to their channel's standard deviation, as if they were in units of it.
    ///
    /// # Errors
    /// [`ContextError::Config`] if a group's statistics have another number of channels.
    pub fn learning_rates(
        &self,
        learning_rates: &ContextLearningRates,
        statistics: &[GroupStatistics; 3],
    ) -> Result<Vec<f32>, ContextError> {
        let mut values = vec![learning_rates.layers; self.parameters];
        values[..self.networks].fill(learning_rates.networks);
        values[self.planes.clone()].fill(learning_rates.planes);
        values[self.latents.clone()].fill(learning_rates.latents);
        for ((head, statistics), channels) in self.heads.iter().zip(statistics).zip(self.config.channels) {
            let deviations = &statistics.deviations;
            if deviations.len() != channels {
                return Err(ContextError::Config(format!(
                    "{} deviations of {channels} channels",
                    deviations.len()
                )));
            }
            for row in 0..=head.inputs {
                let row = &mut values[head.weights + row * head.outputs..][..channels];
                for (learning_rate, deviation) in row.iter_mut().zip(deviations) {
                    *learning_rate *= deviation.max(MIN_DEVIATION);
                }
            }
        }
        Ok(values)
    }

    /// A group's network.
    #[must_use]
    pub fn network(&self, values: &[f32], group: AttributeGroup) -> Mlp {
        let head = &self.heads[group as usize];
        Mlp {
            layers: vec![
                self.hidden.part(values, head.input_row, head.inputs),
                head.part(values, 0, head.outputs),
            ],
        }
    }

    /// The planes as they are stored: latents and layers up, as trained, not rounded. Meaningful once latents are parameters.
    /// `None` for networks without planes.
    #[must_use]
    pub fn stored_planes(&self, values: &[f32]) -> Option<Planes> {
        let config = &self.config.planes;
        (self.config.kind.sampled() > 0).then(|| Planes {
            edge: config.latent_edge(),
            channels: config.latents,
            latents: values[self.latents.clone()].to_vec(),
            layers: self
                .up
                .iter()
                .map(|layer| UpLayer {
                    inputs: layer.coarse,
                    outputs: layer.fine,
                    weights: values[layer.weights..][..layer.weight_count()].to_vec(),
                    bias: values[layer.bias..][..layer.fine].to_vec(),
                })
                .collect(),
        })
    }

    /// Overwrites planes, layers and latents with those of another model, whose planes have the same sizes.
    ///
    /// # Errors
    /// [`ContextError::Config`] if sizes differ or either model has no planes.
    pub fn copy_planes(&self, values: &mut [f32], other: &Self, from: &[f32]) -> Result<(), ContextError> {
        let has = |layout: &Self| layout.config.kind != ContextKind::Position;
        if !has(self) || !has(other) || self.config.planes != other.config.planes {
            return Err(ContextError::Config("planes of two models differ in size".to_owned()));
        }
        values[self.networks..].copy_from_slice(&from[other.networks..other.parameters]);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;
    use crate::train::context::PlaneConfig;

    fn layout(kind: ContextKind) -> ContextLayout {
        let planes = PlaneConfig { edge: 16, channels: 4, layers: 2, hidden: 5, latents: 3 };
        let config = ContextConfig { kind, channels: [4, 6, 3], hidden: [7, 3, 5], planes };
        ContextLayout::new(config).expect("known sizes")
    }

    fn statistics() -> [GroupStatistics; 3] {
        [4, 6, 3].map(|channels| GroupStatistics {
            means: (0..channels).map(|c| 10.0 * c as f32 - 7.0).collect(),
            deviations: (0..channels).map(|c| 0.5 * c as f32).collect(),
        })
    }

    #[test]
    fn every_parameter_has_one_place() {
        for kind in [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn] {
            let layout = layout(kind);
            let mut seen = vec![0; layout.parameters];
            let mut mark = |range: Range<usize>| seen[range].iter_mut().for_each(|count| *count += 1);
            for layer in std::iter::once(&layout.hidden).chain(&layout.heads) {
                mark(layer.weights..layer.weights + layer.inputs * layer.outputs);
                mark(layer.bias..layer.bias + layer.outputs);
            }
            mark(layout.planes.clone());
            mark(layout.latents.clone());
            for (layers, upwards) in [(&layout.down, false), (&layout.up, true)] {
                for layer in layers {
                    mark(layer.weights..layer.weights + layer.weight_count());
                    mark(layer.bias..layer.bias + if upwards { layer.fine } else { layer.coarse });
                }
            }
            assert!(seen.iter().all(|count| *count == 1), "{kind:?}");
            assert_eq!(layout.planes.is_empty(), kind == ContextKind::Position);
        }
    }

    #[test]
    fn a_fresh_model_predicts_each_channels_mean_and_deviation() {
        let layout = layout(ContextKind::TriPlaneKnn);
        let values =
            layout.initial(&statistics(), &mut Pcg64::seed_from_u64(1)).expect("statistics that fit");
        for (group, statistics) in AttributeGroup::ALL.into_iter().zip(statistics()) {
            let network = layout.network(&values, group);
            let [hidden, head] = network.layers.as_slice() else { panic!("two layers") };
            assert_eq!(hidden.inputs, 4 * 3 * 4 + 18);
            assert_eq!(hidden.outputs, head.inputs);
            assert!(hidden.weights.iter().all(|w| *w != 0.0 && w.abs() < 0.13));
            assert!(head.weights.iter().all(|w| *w == 0.0));
            let channels = statistics.means.len();
            assert_eq!(head.bias[..channels], statistics.means);
            let deviations = statistics.deviations.iter().map(|d| d.max(MIN_DEVIATION).log2());
            assert!(head.bias[channels..2 * channels].iter().copied().eq(deviations));
            assert_eq!(head.bias[2 * channels..], [0.0]);
        }
        let mut short = statistics();
        short[1].means.pop();
        assert!(layout.initial(&short, &mut Pcg64::seed_from_u64(1)).is_err());
    }

    #[test]
    fn parts_learn_at_their_rates_and_means_in_deviations() {
        let layout = layout(ContextKind::TriPlane);
        let rates = ContextLearningRates { networks: 1.0, planes: 2.0, layers: 3.0, latents: 4.0 };
        let values = layout.learning_rates(&rates, &statistics()).expect("statistics that fit");
        let scalings = layout.network(&values, AttributeGroup::Scalings);
        let [hidden, head] = scalings.layers.as_slice() else { panic!("two layers") };
        assert!(hidden.weights.iter().chain(&hidden.bias).all(|rate| *rate == 1.0));
        let expected = [0.05, 0.5, 1.0, 1.5, 2.0, 2.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        assert_eq!(head.bias, expected);
        assert!(head.weights.chunks(head.inputs).zip(expected).all(|(row, e)| row.iter().all(|r| *r == e)));
        assert!(values[layout.planes.clone()].iter().all(|rate| *rate == 2.0));
        assert!(values[layout.latents.clone()].iter().all(|rate| *rate == 4.0));
        let layers = layout.planes.end..layout.latents.start;
        assert!(values[layers].iter().all(|rate| *rate == 3.0));
    }

    #[test]
    fn planes_go_over_to_a_model_of_another_kind() {
        let (own, neighbors) = (layout(ContextKind::TriPlane), layout(ContextKind::TriPlaneKnn));
        let mut rng = Pcg64::seed_from_u64(2);
        let from: Vec<f32> = (0..neighbors.parameters).map(|_| rng.random()).collect();
        let mut values = vec![0.0; own.parameters];
        own.copy_planes(&mut values, &neighbors, &from).expect("equal planes");
        assert_eq!(own.stored_planes(&values), neighbors.stored_planes(&from));
        assert!(values[..own.networks].iter().all(|value| *value == 0.0));
        let planes = own.stored_planes(&values).expect("planes");
        assert_eq!((planes.edge, planes.plane_edge(), planes.plane_channels()), (4, 16, 4));
        assert_eq!(layout(ContextKind::Position).stored_planes(&values), None);
        assert!(layout(ContextKind::Position).copy_planes(&mut values, &own, &from).is_err());
    }
}
