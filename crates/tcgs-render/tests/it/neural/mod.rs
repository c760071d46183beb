//! From anchors to Gaussians and back: the twins against central differences, the kernels against the twins.

mod device;
mod faults;
mod gradients;
mod independent;
mod scene;
mod visibility;
