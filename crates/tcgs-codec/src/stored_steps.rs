//! The quantization steps of a file's anchors, for measurements of what rounding costs.

use super::{
    context::quant_steps::factor,
    decode::{DecodeLimits, read},
    error::Result,
    shape::Attribute,
};

/// Steps of every anchor of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredSteps {
    /// Cells of the anchors, in the file's order.
    pub cells: Vec<[i32; 3]>,
    /// `[N]` steps of features, scalings and offsets each: a decoded value is an integer times its step.
    pub steps: [Vec<f32>; 3],
}

/// Reads the steps.
///
/// # Errors
/// [`super::DecodeError`] as for [`super::decode`].
pub fn stored_steps(bytes: &[u8], limits: &DecodeLimits) -> Result<StoredSteps> {
    let content = read(bytes, limits)?;
    let steps = Attribute::ALL.map(|attribute| {
        let base = content.manifest.steps.of(attribute);
        attribute.of(&content.symbols.step_indices).iter().map(|index| base * factor(*index)).collect()
    });
    Ok(StoredSteps { cells: content.symbols.cells, steps })
}
