//! Training: the loss, the rate and its networks, the optimizer, checkpoints, memory, and runs from end to end.

mod adam;
mod basis;
mod checkpoint;
mod context;
mod crop;
mod loss;
mod masked_loss;
mod memory;
#[allow(dead_code, reason = "tests of the renderer use the rest")]
#[path = "../../../crates/tcgs-render/tests/it/neural/scene.rs"]
mod neural_scene;
mod offset_masks;
mod rate;
mod rate_control;
mod rounding;
pub(crate) mod training;
mod wavelet;
