//! A distance of images by the features of a network, for programs that measure one beside PSNR and SSIM.

use std::fmt;

use crate::domain::{Image, LpipsNetwork, Problem};

/// Compares images by the features of a network with weights.
pub trait PerceptualDistance: fmt::Debug + Send + Sync {
    /// The network.
    fn network(&self) -> LpipsNetwork;

    /// The distance of two RGB images of one size: 0 for equal ones, below 1 for most.
    ///
    /// # Errors
    /// Why the images cannot be compared.
    fn distance(&self, a: &Image, b: &Image) -> Result<f64, Problem>;
}
