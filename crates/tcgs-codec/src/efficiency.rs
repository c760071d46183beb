//! How close the coded attributes come to the entropy under their model: figures for result tables.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    attributes::is_coded,
    context::{ContextChoice, GroupChoice, GroupModel, floats::FloatAnchors, quant_steps},
    decode::{DecodeLimits, DecodedSections, read},
    error::Result,
    inspect::inspect,
    shape::Attribute,
};
use crate::domain::{ContextCandidates, Mlp, context_model::ContextKind};

/// Least probability that a float network is taken at, so that one symbol far away does not hide all others.
const MIN_PROBABILITY: f64 = 1e-300;

/// Bytes of the attributes against the information in them; features, scalings, offsets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Efficiency {
    /// Bytes in the file, tables of channels included.
    pub bytes: [u64; 3],
    /// Sum of -log2 p over the symbols, by the integer tables that code them.
    pub table_bits: [f64; 3],
    /// The same by the integer network alone, without a regression, and by the normal distributions of the float network, of groups that
    /// have one and for which it was given. Steps and symbols are those of the file.
    pub network_bits: [Option<NetworkBits>; 3],
}

/// Bits of a group's symbols by its network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NetworkBits {
    /// By the integers that a file has.
    pub integers: f64,
    /// By the floats that they were made from.
    pub floats: f64,
}

impl Efficiency {
    /// Coded bytes over the entropy under the model: the loss of the coder. NaN if nothing is coded.
    #[must_use]
    pub fn entropy_overhead(&self) -> f64 {
        8.0 * self.bytes.iter().sum::<u64>() as f64 / self.table_bits.iter().sum::<f64>()
    }

    /// Bits by the integer networks over bits by the float networks; none without any.
    #[must_use]
    pub fn over_floats(&self) -> Option<f64> {
        let both = self.network_bits.iter().flatten();
        let (integers, floats) =
            both.fold((0.0, 0.0), |sum, bits| (sum.0 + bits.integers, sum.1 + bits.floats));
        (floats > 0.0).then_some(integers / floats)
    }
}

/// Measures a file; with what training left, and what an encoder chose of it, also against floats.
///
/// # Errors
/// [`super::DecodeError`] as for [`super::decode`].
pub fn efficiency(
    bytes: &[u8],
    limits: &DecodeLimits,
    trained: Option<(&ContextCandidates, &ContextChoice)>,
) -> Result<Efficiency> {
    let counts = inspect(bytes)?.byte_counts;
    let content = read(bytes, limits)?;
    let planes = trained.and_then(|(candidates, choice)| candidates.planes.get(choice.planes?));
    let anchors = trained.map(|(candidates, _)| {
        FloatAnchors::new(&candidates.frame, &content.symbols.cells, planes.map(|set| &set.planes))
    });
    let mut network_bits = [None; 3];
    if let (Some((candidates, choice)), Some(anchors)) = (trained, &anchors) {
        for attribute in Attribute::ALL {
            let group = attribute as usize;
            let GroupChoice::Network { kind, .. } = choice.groups[group] else { continue };
            let mlp = match kind {
                ContextKind::Position => candidates.position[group].as_ref(),
                ContextKind::TriPlane => planes.and_then(|set| set.own[group].as_ref()),
                ContextKind::TriPlaneKnn => planes.and_then(|set| set.neighbors[group].as_ref()),
            };
            network_bits[group] = mlp.map(|mlp| NetworkBits {
                integers: by_tables(&content, attribute, &content.models[group].base.clone().into()),
                floats: by_floats(&content, attribute, anchors, mlp, kind),
            });
        }
    }
    Ok(Efficiency {
        bytes: [counts.features, counts.scalings, counts.offsets],
        table_bits: Attribute::ALL
            .map(|attribute| by_tables(&content, attribute, attribute.of(&content.models))),
        network_bits,
    })
}

/// Whether each symbol of an anchor is in the file, with its channel and value.
fn coded(
    content: &DecodedSections,
    attribute: Attribute,
    anchor: usize,
) -> impl Iterator<Item = (usize, i32)> {
    let shape = content.manifest.shape();
    let channels = shape.channels(attribute);
    let row = &attribute.of(&content.symbols.groups)[anchor * channels..(anchor + 1) * channels];
    let masks = &content.symbols.masks;
    let symbols = row.iter().copied().enumerate();
    symbols.filter(move |(channel, _)| is_coded(masks, shape, anchor, attribute, *channel))
}

fn by_tables(content: &DecodedSections, attribute: Attribute, model: &GroupModel) -> f64 {
    let shape = content.manifest.shape();
    let channels = shape.channels(attribute);
    let each: Vec<f64> = (0..content.manifest.anchors)
        .into_par_iter()
        .map_init(
            || model.predictions(&content.anchors),
            |predictions, anchor| {
                predictions.begin(anchor);
                let row = &attribute.of(&content.symbols.groups)[anchor * channels..][..channels];
                let cost = |(channel, symbol): (usize, &i32)| {
                    let coded = is_coded(&content.symbols.masks, shape, anchor, attribute, channel);
                    let bits = if coded { predictions.next(channel).cost(*symbol) } else { 0.0 };
                    predictions.observe(channel, coded.then_some(*symbol));
                    bits
                };
                row.iter().enumerate().map(cost).sum()
            },
        )
        .collect();
    // One after another, so that the figure does not depend on the threads.
    each.iter().sum()
}

fn by_floats(
    content: &DecodedSections,
    attribute: Attribute,
    anchors: &FloatAnchors,
    mlp: &Mlp,
    kind: ContextKind,
) -> f64 {
    let channels = content.manifest.shape().channels(attribute);
    let each: Vec<f64> = (0..content.manifest.anchors)
        .into_par_iter()
        .map(|anchor| {
            let outputs = anchors.outputs(mlp, kind, anchor);
            let step = f64::from(quant_steps::factor(attribute.of(&content.symbols.step_indices)[anchor]));
            let bits = |(channel, symbol): (usize, i32)| {
                let mean = outputs[channel] / step;
                let sigma = libm::exp2(outputs[channels + channel]) / step;
                // In the upper tail, where the difference of two small numbers is exact enough.
                let distance = (f64::from(symbol) - mean).abs();
                let tail = |x: f64| 0.5 * libm::erfc(x / sigma * std::f64::consts::FRAC_1_SQRT_2);
                -libm::log2((tail(distance - 0.5) - tail(distance + 0.5)).max(MIN_PROBABILITY))
            };
            coded(content, attribute, anchor).map(bits).sum()
        })
        .collect();
    each.iter().sum()
}
