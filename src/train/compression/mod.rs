//! Compression-aware training: what a run does so that its scene costs few bytes (METHOD.md §4.2).
//!
//! Rendering sees attributes as the decoder will, first with noise and at last rounded; a sample of the anchors is
//! measured for its rate each step, and the context model learns with them.

mod context_fit;
mod frozen_quant_steps;
mod learning;
mod quant_steps;
mod statistics;

pub(super) use learning::{Compression, compression_bytes};
