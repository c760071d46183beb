//! The layers between planes and latents, over three planes at once, as [`crate::domain::context_model::UpLayer`] defines them:
//! tap (v, u) joins the coarse place (x, y) and the fine place (2 x + u - 1, 2 y + v - 1), where there is one.

use crate::train::context::ConvSpec;

/// One product of a layer: indices of the coarse value, the fine value and the weight.
pub(super) struct Term {
    pub(super) coarse: usize,
    pub(super) fine: usize,
    pub(super) weight: usize,
}

pub(super) fn terms(spec: &ConvSpec) -> impl Iterator<Item = Term> {
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

pub(super) fn from_bias(parameters: &[f64], bias: Option<usize>, channels: usize, area: usize) -> Vec<f64> {
    let channel = |index: usize| index / area % channels;
    (0..3 * channels * area).map(|index| bias.map_or(0.0, |bias| parameters[bias + channel(index)])).collect()
}
