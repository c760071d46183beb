//! Image quality from 8-bit images: PSNR, SSIM and a perceptual distance that a program brings, per view and as means over views, errors by
//! wavelet band, affine color corrections, and the importance of each Gaussian to views. Over runs: confidence intervals.
//!
//! Conventions are those of the field's final metrics (METHOD.md §1.2): both images are 8-bit, PSNR pools the squared
//! error over the three channels, means are over views. [`crate::domain::Conventions`] states them in the metrics.

mod bands;
mod color_fit;
mod error_map;
mod haar;
mod interval;
mod measure;
mod overlap;
mod perceptual;
mod quality;
mod reference;
mod removal;
mod removal_signs;
mod scores;
mod ssim;
mod target;
mod train_view;

pub use bands::{BandErrors, band_errors};
pub use color_fit::{ColorFit, LeftHalf, RightHalf, mean_color_fit};
pub use error_map::{ERROR_CEILING, error_map, error_ramp, shrunk};
pub use haar::Haar;
pub use interval::{Estimate, student_t_975};
pub use measure::{ViewMeasurement, mean_psnr, measure_views};
pub use overlap::{InFlight, ViewTasks, for_each_view, measuring_bytes};
pub use perceptual::PerceptualDistance;
pub use quality::psnr;
pub use reference::{ColorError, reference_view};
pub use removal::{RemovalCosts, removal_costs};
pub use removal_signs::signs;
pub use scores::{mean_scores, mean_scores_with, score_view};
pub use ssim::ssim;
pub use target::Target;
pub use train_view::TrainView;
