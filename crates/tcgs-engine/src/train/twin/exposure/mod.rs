//! Color corrections of photographs and their learning (METHOD.md §2.11).
//!
//! A correction is three rows, each a row of A and then the component of b.

mod correct_colors;
mod correct_colors_gradient;
mod correction_step;

pub use correct_colors::correct_colors;
pub use correct_colors_gradient::correct_colors_gradient;
pub use correction_step::{CorrectionElements, correction_step};
