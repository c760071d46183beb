//! The gradient by weights and bias of a layer between planes and latents.

use super::convolution::terms;
use crate::train::context::ConvSpec;

/// The gradient by weights and bias, where one side is the layer's input and the other the gradient by its output: the fine
/// one if the layer goes up.
#[must_use]
pub fn conv_weight_gradient(
    spec: &ConvSpec,
    fine_side: &[f64],
    coarse_side: &[f64],
    upwards: bool,
) -> (Vec<f64>, Vec<f64>) {
    let mut weights = vec![0.0; spec.weight_count()];
    terms(spec).for_each(|t| weights[t.weight] += coarse_side[t.coarse] * fine_side[t.fine]);
    let area = spec.edge * spec.edge;
    let (d, channels, area) =
        if upwards { (fine_side, spec.fine, 4 * area) } else { (coarse_side, spec.coarse, area) };
    let mut bias = vec![0.0; channels];
    d.iter().enumerate().for_each(|(index, d)| bias[index / area % channels] += d);
    (weights, bias)
}
