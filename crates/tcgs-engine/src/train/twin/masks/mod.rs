//! Offset masks (TC-GS II-C, METHOD.md §4.1): their loss, the gradients of rendering and bits by them, and their packing.

mod logistic;
mod mask_bits;
mod mask_gradient;
mod mask_loss;
mod mask_rate;

pub use mask_bits::mask_bits;
pub use mask_gradient::mask_gradient;
pub use mask_loss::mask_loss;
pub use mask_rate::mask_rate;
