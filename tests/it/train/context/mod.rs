//! The context model in training: twins against their definitions and central differences, kernels against twins.

mod device;
mod finished;
mod gradients;
mod learning;
mod scene;
