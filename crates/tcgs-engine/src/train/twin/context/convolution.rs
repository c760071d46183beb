//! The layers between planes and latents, over three planes at once, as [`crate::domain::context_model::UpLayer`] defines them:
//! tap (v, u) joins the coarse place (x, y) and the fine place (2 x + u - 1, 2 y + v - 1), where there is one.

use crate::train::context::ConvSpec;

/// One product of a layer: indices of the coarse value, the fine value and the weight.
struct Term {
    coarse: usize,
    fine: usize,
    weight: usize,
}

fn terms(spec: &ConvSpec) -> impl Iterator<Item = Term> {
    let ConvSpec { coarse, fine, edge, .. } = *spec;
    let places =
        (0..3 * coarse * fine).flat_map(move |index| (0..edge * edge * 9).map(move |at| (index, at)));
    places.filter_map(move |(index, at)| {
        let (plane, pair) = (index / (coarse * fine), index % (coarse * fine));
        let (c, f) = (pair / fine, pair % fine);
        let (place, tap) = (at / 9, at % 9);
        let (x, y) = (place % edge, place / edge);
        let fine_x = (2 * x + tap % 3).checked_sub(1)?;
        let fine_y = (2 * y + tap / 3).checked_sub(1)?;
        Some(Term {
            coarse: (plane * coarse + c) * edge * edge + place,
            fine: ((plane * fine + f) * 2 * edge + fine_y) * 2 * edge + fine_x,
            weight: 9 * pair + tap,
        })
    })
}

fn from_bias(parameters: &[f64], bias: Option<usize>, channels: usize, area: usize) -> Vec<f64> {
    let channel = |index: usize| index / area % channels;
    (0..3 * channels * area).map(|index| bias.map_or(0.0, |bias| parameters[bias + channel(index)])).collect()
}

/// From fine to coarse. Without a bias it is the gradient of [`conv_up`] by its input.
#[must_use]
pub fn conv_down(spec: &ConvSpec, parameters: &[f64], bias: Option<usize>, source: &[f64]) -> Vec<f64> {
    let mut result = from_bias(parameters, bias, spec.coarse, spec.edge * spec.edge);
    terms(spec).for_each(|t| result[t.coarse] += parameters[spec.weights + t.weight] * source[t.fine]);
    result
}

/// From coarse to fine. Without a bias it is the gradient of [`conv_down`] by its input.
#[must_use]
pub fn conv_up(spec: &ConvSpec, parameters: &[f64], bias: Option<usize>, source: &[f64]) -> Vec<f64> {
    let mut result = from_bias(parameters, bias, spec.fine, 4 * spec.edge * spec.edge);
    terms(spec).for_each(|t| result[t.fine] += parameters[spec.weights + t.weight] * source[t.coarse]);
    result
}

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
