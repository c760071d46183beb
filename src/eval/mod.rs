//! Image quality: PSNR and SSIM from 8-bit images, per view and as means over views, and errors by wavelet band.
//!
//! Conventions are those of the field's final metrics (method.md §1.1): both images are 8-bit, PSNR pools the squared
//! error over the three channels, means are over views.

mod bands;
mod haar;
mod measure;
mod quality;
mod scores;

pub use bands::{BandErrors, band_errors};
pub use haar::Haar;
pub use measure::measure_views;
pub use quality::{psnr, ssim};
pub use scores::{ViewScore, mean_scores};
