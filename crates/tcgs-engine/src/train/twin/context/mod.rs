//! The context model on the CPU in f64.

mod convolution;
mod net;
mod sampling;
mod weights;

pub use convolution::{conv_down, conv_up, conv_weight_gradient};
pub use net::{ContextForward, ContextTwin};
pub use sampling::{context_input, neighbour_gradient, plane_gradient};
pub use weights::{plane_l1, round_latents, round_weights};
