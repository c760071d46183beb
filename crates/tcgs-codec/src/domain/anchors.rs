//! The trained scene on the host: anchors on an integer lattice, their attributes, and the three render networks.
//!
//! All coordinates and lengths are those of the scene's [`SceneFrame`]. All per-anchor arrays are anchor-major with the lengths that [`AnchorScene::check`] demands. Scalings are held
//! linear (the exponential of the trained logarithm), as the codec quantizes them (METHOD.md §4.2).

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{NearPlane, SceneFrame, SceneScale, ViewDegree};

/// Values per anchor in `scalings`: three scale the offsets, three are the base size of its Gaussians.
pub const SCALINGS_PER_ANCHOR: usize = 6;

/// Most values of a feature, and most offsets an anchor: far more than any model has, and few enough to compute sizes with. Arrays of a
/// scene without anchors are empty whatever its widths.
const MAX_WIDTH: usize = 1 << 16;

/// The lattice that anchor positions live on: `position = cell * voxel + origin`, per axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lattice {
    /// Edge length of a cell, in the units of the scene's frame.
    pub voxel: f32,
    /// Position of cell (0, 0, 0) in the scene's frame.
    pub origin: [f32; 3],
}

impl Lattice {
    /// Position of a cell in the scene's frame: one f32 multiply, then one f32 add, per axis.
    #[must_use]
    pub fn position(&self, cell: [i32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| cell[axis] as f32 * self.voxel + self.origin[axis])
    }
}

/// A dense layer: `y = W x + b`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DenseLayer {
    /// Input width.
    pub inputs: usize,
    /// Output width.
    pub outputs: usize,
    /// Row-major weights, `outputs` rows of `inputs`.
    pub weights: Vec<f32>,
    /// Bias, `outputs` long.
    pub bias: Vec<f32>,
}

/// Dense layers with ReLU between them; the last layer is linear, its activation belongs to the user of the output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mlp {
    /// The layers, first to last.
    pub layers: Vec<DenseLayer>,
}

/// The networks that turn an anchor feature and a view into neural Gaussians (METHOD.md §2.2).
///
/// Each takes `[feature, view direction (3), distance over the scene scale (1), harmonics of the direction]`, the last as the scene's
/// [`ViewDegree`] says; hidden width equals the feature width.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RenderNetworks {
    /// Outputs one opacity an offset, through tanh.
    pub opacity: Mlp,
    /// Outputs seven values an offset: three scale logits (through the logistic) and a raw quaternion (w, x, y, z).
    pub covariance: Mlp,
    /// Outputs RGB an offset, through the logistic.
    pub color: Mlp,
}

/// A scene of anchors, ready to be encoded or rendered.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchorScene {
    /// Where the scene's coordinates are in the world.
    pub frame: SceneFrame,
    /// Where cells are in the frame.
    pub lattice: Lattice,
    /// Integer cell of each anchor; no cell twice.
    pub cells: Vec<[i32; 3]>,
    /// Width F of a feature.
    pub feature_dim: usize,
    /// Offsets K an anchor.
    pub offsets_per_anchor: usize,
    /// `[N][F]` features.
    pub features: Vec<f32>,
    /// `[N][6]` linear scalings, positive.
    pub scalings: Vec<f32>,
    /// `[N][K][3]` offsets in units of the first three scalings.
    pub offsets: Vec<f32>,
    /// `[N][K]`, true where the offset makes a Gaussian.
    pub masks: Vec<bool>,
    /// The render networks.
    pub networks: RenderNetworks,
    /// Where views begin, as in training.
    pub near: NearPlane,
    /// Divides distances before the networks see them, as in training.
    pub scene_scale: SceneScale,
}

/// An [`AnchorScene`] whose parts do not fit together.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("inconsistent scene: {0}")]
pub struct SceneShapeError(pub String);

impl AnchorScene {
    /// Number of anchors.
    #[must_use]
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    /// Whether there is no anchor.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }

    /// Offsets that make a Gaussian, an upper bound on the Gaussians of any view.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.masks.iter().filter(|kept| **kept).count()
    }

    /// Center of the Gaussian of an offset, by its place in `masks`, in the scene's frame.
    #[must_use]
    pub fn gaussian_center(&self, offset: usize) -> [f32; 3] {
        let anchor = offset / self.offsets_per_anchor;
        let position = self.lattice.position(self.cells[anchor]);
        std::array::from_fn(|axis| {
            let scaling = self.scalings[anchor * SCALINGS_PER_ANCHOR + axis];
            position[axis] + self.offsets[offset * 3 + axis] * scaling
        })
    }

    /// The scene with those offsets alone that `kept` has, as `masks` does, without anchors that have none then.
    #[must_use]
    pub fn with_offsets(&self, kept: &[bool]) -> Self {
        let k = self.offsets_per_anchor;
        let masks: Vec<bool> = self.masks.iter().zip(kept).map(|(on, kept)| *on && *kept).collect();
        let anchors: Vec<usize> =
            (0..self.len()).filter(|anchor| masks[anchor * k..(anchor + 1) * k].contains(&true)).collect();
        fn rows<T: Copy>(values: &[T], width: usize, anchors: &[usize]) -> Vec<T> {
            anchors.iter().flat_map(|anchor| &values[anchor * width..(anchor + 1) * width]).copied().collect()
        }
        Self {
            cells: rows(&self.cells, 1, &anchors),
            features: rows(&self.features, self.feature_dim, &anchors),
            scalings: rows(&self.scalings, SCALINGS_PER_ANCHOR, &anchors),
            offsets: rows(&self.offsets, 3 * k, &anchors),
            masks: rows(&masks, k, &anchors),
            networks: self.networks.clone(),
            ..*self
        }
    }

    /// How the networks see the direction of view, by their number of inputs; `None` if no degree has so many.
    #[must_use]
    pub fn view_degree(&self) -> Option<ViewDegree> {
        let first = self.networks.opacity.layers.first()?;
        ViewDegree::of_inputs(first.inputs.checked_sub(self.feature_dim)?)
    }

    /// Checks lengths, widths and finiteness.
    ///
    /// # Errors
    /// [`SceneShapeError`] naming the first part that does not fit.
    pub fn check(&self) -> Result<(), SceneShapeError> {
        let n = self.len();
        let (f, k) = (self.feature_dim, self.offsets_per_anchor);
        for (what, width) in [("values of a feature", f), ("offsets per anchor", k)] {
            if width > MAX_WIDTH {
                return Err(SceneShapeError(format!("{width} {what} are more than {MAX_WIDTH}")));
            }
        }
        let lengths = [
            ("features", self.features.len(), n * f),
            ("scalings", self.scalings.len(), n * SCALINGS_PER_ANCHOR),
            ("offsets", self.offsets.len(), n * k * 3),
            ("masks", self.masks.len(), n * k),
        ];
        for (name, actual, expected) in lengths {
            if actual != expected {
                return Err(SceneShapeError(format!("{actual} {name} where {expected} are needed")));
            }
        }
        for (name, values) in
            [("features", &self.features), ("scalings", &self.scalings), ("offsets", &self.offsets)]
        {
            if let Some(index) = values.iter().position(|value| !value.is_finite()) {
                return Err(SceneShapeError(format!("{name}[{index}] is not finite")));
            }
        }
        let networks = [
            ("opacity", &self.networks.opacity, k),
            ("covariance", &self.networks.covariance, 7 * k),
            ("color", &self.networks.color, 3 * k),
        ];
        let inputs = f + self.view_degree().unwrap_or_default().inputs();
        for (name, mlp, outputs) in networks {
            mlp.check(inputs, outputs)
                .map_err(|error| SceneShapeError(format!("{name} network: {error}")))?;
        }
        Ok(())
    }
}

impl Mlp {
    /// Number of weights and biases.
    #[must_use]
    pub fn parameters(&self) -> usize {
        self.layers.iter().map(|layer| layer.weights.len() + layer.bias.len()).sum()
    }

    pub(crate) fn check(&self, inputs: usize, outputs: usize) -> Result<(), String> {
        let mut width = inputs;
        for (index, layer) in self.layers.iter().enumerate() {
            if layer.inputs != width {
                return Err(format!("layer {index} takes {} inputs after {width} outputs", layer.inputs));
            }
            if layer.weights.len() != layer.inputs * layer.outputs || layer.bias.len() != layer.outputs {
                return Err(format!("layer {index} has the wrong number of parameters"));
            }
            if layer.weights.iter().chain(&layer.bias).any(|value| !value.is_finite()) {
                return Err(format!("layer {index} has a non-finite parameter"));
            }
            width = layer.outputs;
        }
        if width == outputs { Ok(()) } else { Err(format!("{width} outputs where {outputs} are needed")) }
    }
}
