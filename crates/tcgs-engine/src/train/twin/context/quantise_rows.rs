//! Quantised rows.

use super::quantiser::{Quantiser, group, widths};
use crate::{model::Shape, train::context::Quantisation};

/// One anchor's rendered row. `steps` are the anchor's own.
#[must_use]
pub fn quantise_rows(
    shape: Shape,
    by: &Quantisation,
    anchor: u32,
    row: &[f64],
    mask: u32,
    steps: [f64; 3],
) -> Vec<f64> {
    let (widths, quantiser) = (widths(by, steps), Quantiser { by, anchor });
    let columns = row.iter().enumerate();
    columns
        .map(|(column, value)| match group(shape, column, mask) {
            None => *value,
            Some(1) => quantiser.quantise_scaling(column, value.exp(), widths[1]).value.ln(),
            Some(group) => quantiser.quantise(column, *value, widths[group]).value,
        })
        .collect()
}
