//! Training: the loss, the rate and its networks, the optimiser, checkpoints, memory, and runs from end to end.

mod adam;
mod basis;
mod checkpoint;
mod context;
mod convergence;
mod loss;
mod memory;
mod rate;
mod rate_control;
mod rounding;
pub(crate) mod training;
mod wavelet;
