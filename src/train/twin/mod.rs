//! The image loss, the offset masks, the context model and the optimiser on the CPU in f64, written plainly: every kernel has a function of the same name here.

mod adam;
pub mod context;
mod loss;
mod masks;
mod wavelet;

pub use adam::{AdamElement, adam};
pub use loss::{
    Losses, Moments, SsimGradient, image_gradient, image_loss, ssim_columns, ssim_gradient_rows, ssim_rows,
    sum_losses,
};
pub use masks::{mask_bits, mask_gradient, mask_loss};
pub use wavelet::wavelet;
