//! From floats to the integers of a file and back. The way back is one f32 multiplication a value, in one place,
//! used by encoder and decoder alike.

use super::{
    error::EncodeError,
    manifest::{Manifest, Steps},
    networks::QuantisedNetworks,
    symbols::MAX_SYMBOL,
};
use crate::domain::{AnchorScene, NearPlane, anchors::SCALINGS_PER_ANCHOR};

/// The integers of a file, anchors in file order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Symbols {
    /// `[N]` cells.
    pub(super) cells: Vec<[i32; 3]>,
    /// `[N][K]`.
    pub(super) masks: Vec<bool>,
    /// `[N][F]`.
    pub(super) features: Vec<i32>,
    /// `[N][6]`, at least 1.
    pub(super) scalings: Vec<i32>,
    /// `[N][K][3]`, zero where masked off.
    pub(super) offsets: Vec<i32>,
}

/// Quantises the anchors that `order` names, in that order.
pub(super) fn quantise(scene: &AnchorScene, order: &[usize], steps: Steps) -> Result<Symbols, EncodeError> {
    let (f, k) = (scene.feature_dim, scene.offsets_per_anchor);
    let mut symbols = Symbols {
        cells: order.iter().map(|anchor| scene.cells[*anchor]).collect(),
        masks: Vec::with_capacity(order.len() * k),
        features: Vec::with_capacity(order.len() * f),
        scalings: Vec::with_capacity(order.len() * SCALINGS_PER_ANCHOR),
        offsets: Vec::with_capacity(order.len() * k * 3),
    };
    for anchor in order {
        for index in anchor * f..(anchor + 1) * f {
            symbols.features.push(nearest("features", index, scene.features[index], steps.feature)?);
        }
        for index in anchor * SCALINGS_PER_ANCHOR..(anchor + 1) * SCALINGS_PER_ANCHOR {
            let value = scene.scalings[index];
            if value < 0.0 {
                return Err(EncodeError::NegativeScaling { index, value });
            }
            // A scaling of zero would divide by zero in a renderer; the finest is one step.
            symbols.scalings.push(nearest("scalings", index, value, steps.scaling)?.max(1));
        }
        for offset in anchor * k..(anchor + 1) * k {
            let kept = scene.masks[offset];
            symbols.masks.push(kept);
            for index in offset * 3..(offset + 1) * 3 {
                let value = if kept { scene.offsets[index] } else { 0.0 };
                symbols.offsets.push(nearest("offsets", index, value, steps.offset)?);
            }
        }
    }
    Ok(symbols)
}

/// The multiple of `step` nearest to `value`, ties to the even one: an absolute grid that contains zero
/// (method.md §7, item 6).
fn nearest(what: &'static str, index: usize, value: f32, step: f32) -> Result<i32, EncodeError> {
    let quotient = (value / step).round_ties_even();
    if quotient.abs() <= MAX_SYMBOL as f32 {
        Ok(quotient as i32)
    } else {
        Err(EncodeError::OutOfRange { what, index, value, step })
    }
}

/// The scene that the integers stand for: each value is its integer, exact in f32, times its step.
pub(super) fn dequantise(symbols: Symbols, networks: &QuantisedNetworks, manifest: &Manifest) -> AnchorScene {
    let scaled = |integers: Vec<i32>, step: f32| integers.into_iter().map(|q| q as f32 * step).collect();
    AnchorScene {
        lattice: manifest.lattice,
        cells: symbols.cells,
        feature_dim: manifest.feature_dim,
        offsets_per_anchor: manifest.offsets_per_anchor,
        features: scaled(symbols.features, manifest.steps.feature),
        scalings: scaled(symbols.scalings, manifest.steps.scaling),
        offsets: scaled(symbols.offsets, manifest.steps.offset),
        masks: symbols.masks,
        networks: networks.dequantise(),
        near: NearPlane::USUAL,
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
