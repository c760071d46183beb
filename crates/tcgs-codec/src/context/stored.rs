//! Networks and planes after a round trip through the file's integers, as floats.
//!
//! Training rounds with these in its last phase, so that it sees what a decoder will see. The round trip is idempotent.

use super::{
    dense::{IntegerMlp, WeightBits},
    planes::IntegerPlanes,
};
use crate::domain::{Mlp, Planes};

/// A context network with weights of `weight_bits` bits (2 to 8; others count as the nearest of these). Each row's weights are
/// multiples of a power of two, the finest down to 2^-15 with which the largest stays within 2^(bits - 1) - 1 of them; biases
/// are multiples of 1/256.
#[must_use]
pub fn stored_network(mlp: &Mlp, weight_bits: u8) -> Mlp {
    match WeightBits::new(weight_bits.clamp(2, 8)) {
        Some(bits) => IntegerMlp::quantize(mlp, bits).as_floats(),
        None => mlp.clone(),
    }
}

/// Planes with latents in multiples of 1/16, at most 127 of them, and layers as [`stored_network`] has them at eight bits,
/// a row being the weights of one output.
#[must_use]
pub fn stored_planes(planes: &Planes) -> Planes {
    IntegerPlanes::quantize(planes).as_floats()
}
