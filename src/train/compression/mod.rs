//! Compression-aware training: what a run does so that its scene costs few bytes (method.md §4.6).
//!
//! Rendering sees attributes as the decoder will, first with noise and at last rounded; a sample of the anchors is
//! measured for its rate each step, and the context model learns with them.

mod base_steps;
mod fit;
mod hold;
mod learning;
mod schedule;
mod statistics;
mod steps;

pub use base_steps::BaseSteps;
pub(super) use learning::{Compression, compression_bytes};
pub use schedule::{BaseStepRule, CompressionSchedule, Stage};
