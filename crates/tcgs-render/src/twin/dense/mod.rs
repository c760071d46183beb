//! Dense layers and their gradients, one column at a time.

#[allow(clippy::module_inception, reason = "each file has the name of its kernel")]
mod dense;
mod dense_input_gradient;
mod dense_software;
mod dense_weight_gradient;
mod dense_weight_gradient_software;
mod pack_weights;
mod relu;
mod sum_partials;
mod sum_weight_gradient;
#[cfg(test)]
mod tests;
mod weight;

pub use dense::dense;
pub use dense_input_gradient::dense_input_gradient;
pub use dense_software::dense_software;
pub use dense_weight_gradient::dense_weight_gradient;
pub use dense_weight_gradient_software::dense_weight_gradient_software;
pub use pack_weights::pack_weights;
pub use relu::{relu, relu_gate};
pub use sum_partials::sum_partials;
pub use sum_weight_gradient::sum_weight_gradient;
