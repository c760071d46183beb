//! The image loss, the offset masks, the context model, the rate term and the optimiser on the CPU in f64, written plainly:
//! every kernel has a function of the same name here.

mod adam;
pub mod context;
mod frozen_quant_steps;
mod gaussian;
mod loss;
mod masks;
mod quantise;
mod rate;
mod wavelet;

pub use adam::{AdamElement, adam};
pub use frozen_quant_steps::{freeze_quant_steps, frozen_quant_step_gradient};
pub use gaussian::{SymbolBits, symbol_bits};
pub use loss::{
    Losses, Moments, SsimGradient, image_gradient, image_gradient_tiles, image_loss, ssim_columns, ssim_rows,
    ssim_tiles, sum_losses,
};
pub use masks::{mask_bits, mask_gradient, mask_loss, mask_rate};
pub use quantise::{noise, quantise_gradient, quantise_rows, round_rows};
pub use rate::{RateGradients, RateInput, rate, refresh_quant_steps, sum_bits};
pub use wavelet::wavelet;
