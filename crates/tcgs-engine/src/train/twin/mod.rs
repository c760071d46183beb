//! The image loss, color corrections, the offset masks, the context model, the rate term and the optimizer on the CPU in f64, written plainly:
//! every kernel has a function of the same name here.

pub mod context;
mod exposure;
mod loss;
mod masks;
mod optimizer;

pub use context::{
    RateGradients, RateInput, SymbolBits, freeze_quant_steps, frozen_quant_step_gradient, noise,
    quantize_gradient, quantize_rows, rate, refresh_quant_steps, round_rows, sum_bits, symbol_bits,
};
pub use exposure::{CorrectionElements, correct_colors, correct_colors_gradient, correction_step};
pub use loss::{
    Losses, Moments, SsimGradient, image_gradient, image_gradient_tiles, image_loss, masked_image_loss,
    ssim_columns, ssim_rows, ssim_tiles, sum_losses, wavelet,
};
pub use masks::{mask_bits, mask_gradient, mask_loss, mask_rate};
pub use optimizer::{AdamElement, adam};
