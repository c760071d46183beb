//! L1 and SSIM of two images and their gradient (METHOD.md §2.4), and the wavelet constraint.
//!
//! An image is one RGB triple a pixel, rows from the top.

mod image_gradient;
mod image_gradient_tiles;
mod image_loss;
mod masked_image_loss;
mod similarity;
mod ssim_columns;
mod ssim_rows;
mod ssim_tiles;
mod sum_losses;
mod wavelet;
mod window;

pub use image_gradient::image_gradient;
pub use image_gradient_tiles::image_gradient_tiles;
pub use image_loss::image_loss;
pub use masked_image_loss::masked_image_loss;
pub use similarity::{Moments, SsimGradient};
pub use ssim_columns::ssim_columns;
pub use ssim_rows::ssim_rows;
pub use ssim_tiles::ssim_tiles;
pub use sum_losses::{Losses, sum_losses};
pub use wavelet::wavelet;
