//! From floats to the integers of a file and back. Dequantization is one f32 multiplication a value and one a step, in one function that
//! encoder and decoder share.

use rayon::prelude::*;

use super::{
    context::quant_steps::factor, error::EncodeError, manifest::Manifest, networks::QuantizedNetworks,
    shape::Attribute, symbols::MAX_SYMBOL,
};
use crate::domain::{AnchorScene, NearPlane, SceneFrame, SceneScale};

/// The integers of a file, anchors in file order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Symbols {
    /// `[N]` cells.
    pub(super) cells: Vec<[i32; 3]>,
    /// `[N][K]`.
    pub(super) masks: Vec<bool>,
    /// Features `[N][F]`, scalings `[N][6]` (at least 1), offsets `[N][K][3]` (zero where masked off).
    pub(super) groups: [Vec<i32>; 3],
    /// `[N]` step indices of each group.
    pub(super) step_indices: [Vec<i8>; 3],
}

/// An attribute group of a scene, to be quantized anchor by anchor.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quantizer<'a> {
    pub(super) scene: &'a AnchorScene,
    /// Anchors of the scene in file order.
    pub(super) order: &'a [usize],
    pub(super) attribute: Attribute,
    /// The group's base step.
    pub(super) base: f32,
}

impl Quantizer<'_> {
    /// Integers of the anchor at place `anchor` of the file, with steps of index `step_index`.
    pub(super) fn row(&self, anchor: usize, step_index: i8, row: &mut [i32]) -> Result<(), EncodeError> {
        let scene = self.scene;
        let anchor = self.order[anchor];
        let step = self.base * factor(step_index);
        let first = anchor * row.len();
        match self.attribute {
            Attribute::Features => {
                for (index, symbol) in (first..).zip(row) {
                    *symbol = nearest("features", index, scene.features[index], step)?;
                }
            }
            Attribute::Scalings => {
                for (index, symbol) in (first..).zip(row) {
                    let value = scene.scalings[index];
                    if value < 0.0 {
                        return Err(EncodeError::NegativeScaling { index, value });
                    }
                    // A scaling of zero would divide by zero in a renderer; the finest is one step.
                    *symbol = nearest("scalings", index, value, step)?.max(1);
                }
            }
            Attribute::Offsets => {
                for (index, symbol) in (first..).zip(row) {
                    let value = if scene.masks[index / 3] { scene.offsets[index] } else { 0.0 };
                    *symbol = nearest("offsets", index, value, step)?;
                }
            }
        }
        Ok(())
    }
}

/// The multiple of `step` nearest to `value`, ties to the even one: an absolute grid that contains zero
/// (METHOD.md §4.2).
fn nearest(what: &'static str, index: usize, value: f32, step: f32) -> Result<i32, EncodeError> {
    let quotient = round_ties_even(value / step);
    if quotient.abs() <= f64::from(MAX_SYMBOL) {
        Ok(quotient as i32)
    } else {
        Err(EncodeError::OutOfRange { what, index, value, step })
    }
}

/// The nearest integer: in the doubles from 2^52 to 2^53 they are all there is. Processors without an instruction for it take ten
/// times as long over the standard library's.
fn round_ties_even(value: f32) -> f64 {
    const INTEGERS: f64 = 1.5 * (1_u64 << 52) as f64;
    (f64::from(value) + INTEGERS) - INTEGERS
}

/// The scene of the integers: each value is its integer, exact in f32, times its anchor's step, which is its
/// group's base step times a factor from a table.
pub(super) fn dequantize(symbols: Symbols, networks: &QuantizedNetworks, manifest: &Manifest) -> AnchorScene {
    let _stage = tracing::debug_span!("dequantize").entered();
    let shape = manifest.shape();
    let [features, scalings, offsets] = Attribute::ALL.map(|attribute| {
        let (integers, steps) = (attribute.of(&symbols.groups), attribute.of(&symbols.step_indices));
        let base = manifest.steps.of(attribute);
        let channels = shape.channels(attribute);
        let mut values = vec![0.0; integers.len()];
        values
            .par_chunks_mut(channels)
            .zip(integers.par_chunks(channels))
            .zip(steps)
            .with_min_len(1024)
            .for_each(|((values, integers), step)| {
                let step = base * factor(*step);
                values.iter_mut().zip(integers).for_each(|(value, q)| *value = *q as f32 * step);
            });
        values
    });
    AnchorScene {
        lattice: manifest.lattice,
        cells: symbols.cells,
        feature_dim: manifest.feature_dim,
        offsets_per_anchor: manifest.offsets_per_anchor,
        features,
        scalings,
        offsets,
        masks: symbols.masks,
        networks: networks.dequantize(),
        near: NearPlane::DEFAULT,
        scene_scale: SceneScale::DEFAULT,
        frame: SceneFrame::WORLD,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_absolute_and_ties_go_to_even() {
        let values = [0.0, 0.5, 1.5, -0.5, -1.5, 2.4, -2.6];
        let expected = [0, 0, 2, 0, -2, 2, -3];
        for (value, expected) in values.into_iter().zip(expected) {
            assert_eq!(nearest("features", 0, value, 1.0), Ok(expected));
        }
        assert_eq!(nearest("offsets", 0, 16_777_216.0, 1.0), Ok(1 << 24));
        assert!(matches!(nearest("offsets", 7, 1e30, 0.2), Err(EncodeError::OutOfRange { index: 7, .. })));
    }
}
