//! From anchors to Gaussians and back: the twins against central differences, the kernels against the twins.

mod device;
mod gradients;
mod scene;
mod visibility;
