//! The context model in training: twins against their definitions and central differences, kernels against twins.

mod device;
mod gradients;
mod learning;
mod scene;
