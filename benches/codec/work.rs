//! What a stage has to do at least: bytes that it must read and write, symbols that it codes, operations.

use tcgs::domain::{AnchorScene, ByteCounts, anchors::SCALINGS_PER_ANCHOR};

/// A scene's counts.
pub(crate) struct Work {
    anchors: f64,
    gaussians: f64,
    feature_dim: f64,
    offsets_per_anchor: f64,
    counts: ByteCounts,
}

/// The least that a stage does.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Cost {
    pub(crate) bytes: f64,
    pub(crate) symbols: f64,
    pub(crate) operations: f64,
}

impl Work {
    pub(crate) fn new(scene: &AnchorScene, counts: &ByteCounts) -> Self {
        Self {
            anchors: scene.len() as f64,
            gaussians: scene.gaussians() as f64,
            feature_dim: scene.feature_dim as f64,
            offsets_per_anchor: scene.offsets_per_anchor as f64,
            counts: counts.clone(),
        }
    }

    /// Symbols of the attributes.
    pub(crate) fn symbols(&self) -> f64 {
        self.anchors * (self.feature_dim + SCALINGS_PER_ANCHOR as f64) + 3.0 * self.gaussians
    }

    /// The cost of a stage, by the last names of its path.
    pub(crate) fn of(&self, path: &str) -> Cost {
        let values =
            self.anchors * (self.feature_dim + SCALINGS_PER_ANCHOR as f64 + 3.0 * self.offsets_per_anchor);
        let slots = self.anchors * self.offsets_per_anchor;
        let cells = 12.0 * self.anchors;
        let counts = &self.counts;
        let coded = (counts.features + counts.scalings + counts.offsets) as f64;
        let products = crate::context::products(self.feature_dim as usize, self.offsets_per_anchor as usize);
        let (bytes, symbols) = match path.rsplit('/').next().unwrap_or(path) {
            // Floats become integers and integers floats, with the masks looked at.
            "quantize" | "dequantize" => (8.0 * values + slots, values),
            "order" => (cells + 16.0 * self.anchors, self.anchors),
            "positions" => (cells + counts.positions as f64, self.anchors),
            "masks" => (slots + counts.masks as f64, slots),
            "fit" => (4.0 * values + slots, self.symbols()),
            "symbols" | "predicted symbols" | "attributes" => (4.0 * values + slots + coded, self.symbols()),
            "digest" => (cells + 4.0 * values + slots, 0.0),
            "section" => (2.0 * coded, 0.0),
            "container" => (2.0 * counts.total as f64, 0.0),
            "neighbors" => (cells + 16.0 * self.anchors, self.anchors),
            "encode" | "decode" => (cells + 4.0 * values + slots + counts.total as f64, self.symbols()),
            _ => (0.0, 0.0),
        };
        let operations = match path.rsplit('/').next() {
            Some("predicted symbols") => 2.0 * self.anchors * products as f64,
            _ => 0.0,
        };
        Cost { bytes, symbols, operations }
    }
}
