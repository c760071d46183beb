//! Image quality: PSNR and SSIM from 8-bit images, per view and as means over views.
//!
//! Conventions are those of the field's final metrics (method.md §1.1): both images are 8-bit, PSNR pools the squared
//! error over the three channels, means are over views.

mod lpips;
mod measure;
mod quality;
mod scores;

pub use lpips::{Lpips, LpipsError};
pub use measure::measure_views;
pub use quality::{psnr, ssim};
pub use scores::{ViewScore, mean_scores};
