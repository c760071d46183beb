//! The trained context model in floats: tri-planes and the small networks that predict the distribution of an anchor's attributes
//! (METHOD.md §4.4).
//!
//! Training hands it to the encoder. The codec converts it to the integers that a file stores and that alone decide what is decoded
//! (`FORMAT.md`).
//!
//! Units: means and standard deviations in base quantization steps of their attribute group; step adjustments and standard deviations
//! as base-2 logarithms.

use serde::{Deserialize, Serialize};

use super::Mlp;

/// Anchors whose plane samples are inputs of a network with neighbors: the anchor itself and its three nearest.
pub const NEIGHBORS: usize = 4;

/// Planes of a scene, in this order: (x, y), (y, z), (x, z); the first coordinate runs along a row.
pub const PLANE_AXES: [[usize; 2]; 3] = [[0, 1], [1, 2], [0, 2]];

/// Triangle waves of the position prior per axis, in addition to the contracted coordinate.
pub const POSITION_OCTAVES: usize = 5;

/// Values of the position prior: for each axis the coordinate, then its triangle waves.
pub const POSITION_INPUTS: usize = 3 * (1 + POSITION_OCTAVES);

/// Largest base-2 logarithm of a quantization step over its base step, either way.
pub const STEP_OCTAVES: f32 = 3.5;

/// A kind of attribute of an anchor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AttributeGroup {
    /// F channels.
    Features,
    /// Six channels.
    Scalings,
    /// 3 K channels: offset-major, then axis.
    Offsets,
}

impl AttributeGroup {
    /// Every group, in the order of a file.
    pub const ALL: [Self; 3] = [Self::Features, Self::Scalings, Self::Offsets];

    /// This group's element of an array that has one for each group, in the order of a file.
    #[must_use]
    pub fn of<T>(self, groups: &[T; 3]) -> &T {
        &groups[self as usize]
    }

    /// The same, to change it.
    pub fn of_mut<T>(self, groups: &mut [T; 3]) -> &mut T {
        &mut groups[self as usize]
    }

    /// Outputs of this group's network: a mean for each channel, a base-2 logarithm of a standard deviation for each, then one
    /// step adjustment.
    #[must_use]
    pub fn outputs(channels: usize) -> usize {
        2 * channels + 1
    }
}

/// The inputs of a group's network for an anchor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ContextKind {
    /// Its position prior.
    Position,
    /// Its samples of the three planes, then its position prior.
    TriPlane,
    /// Those of its [`NEIGHBORS`], itself first, then its position prior.
    TriPlaneKnn,
}

impl ContextKind {
    /// Anchors whose plane samples are inputs of a network of this kind.
    #[must_use]
    pub fn sampled(self) -> usize {
        match self {
            ContextKind::Position => 0,
            ContextKind::TriPlane => 1,
            ContextKind::TriPlaneKnn => NEIGHBORS,
        }
    }

    /// Inputs of such a network where planes have `channels` channels: anchor by anchor, plane by plane, channel by channel,
    /// then [`POSITION_INPUTS`].
    #[must_use]
    pub fn inputs(self, channels: usize) -> usize {
        self.sampled() * 3 * channels + POSITION_INPUTS
    }
}

/// A transposed convolution of 3 x 3 taps and stride 2 that doubles the edge of a plane: a value at (x, y) of input `i` adds
/// `weights[i][o][v][u]` times itself to (2 x + u - 1, 2 y + v - 1) of output `o`, where that exists.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UpLayer {
    /// Channels in.
    pub inputs: usize,
    /// Channels out.
    pub outputs: usize,
    /// `[inputs][outputs][3][3]`.
    pub weights: Vec<f32>,
    /// `[outputs]`.
    pub bias: Vec<f32>,
}

/// Three planes as they are stored: latents and the layers that upsample them. ReLU between layers, none after the last; without
/// layers the latents are the planes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Planes {
    /// Texels along the edge of a latent.
    pub edge: usize,
    /// Channels of a latent.
    pub channels: usize,
    /// `[3][channels][edge][edge]`, rows along the second coordinate; stored as the nearest multiples of 1/16.
    pub latents: Vec<f32>,
    /// The up-sampling layers, shared by the three planes.
    pub layers: Vec<UpLayer>,
}

impl Planes {
    /// Texels along the edge of a plane.
    #[must_use]
    pub fn plane_edge(&self) -> usize {
        self.edge << self.layers.len()
    }

    /// Channels of a plane.
    #[must_use]
    pub fn plane_channels(&self) -> usize {
        self.layers.last().map_or(self.channels, |layer| layer.outputs)
    }
}

/// Networks of one kind for the three groups, in the order of [`AttributeGroup::ALL`]; `None` if not trained.
pub type GroupNetworks = [Option<Mlp>; 3];

/// Planes with the networks that were trained on them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlaneContext {
    /// The planes.
    pub planes: Planes,
    /// Networks of [`ContextKind::TriPlane`].
    pub own: GroupNetworks,
    /// Networks of [`ContextKind::TriPlaneKnn`].
    pub neighbors: GroupNetworks,
}

/// The mapping from cells to planes: a coordinate is (cell - center) / half, then contracted, so that the box from
/// center - half to center + half takes the middle half of a plane's edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContextFrame {
    /// The cell at the middle.
    pub center: [i32; 3],
    /// Cells from the middle to where contraction begins, at least 1 on each axis.
    pub half: [u32; 3],
}

/// The contexts that an encoder may choose from for each group. It may also choose none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ContextCandidates {
    /// Where planes and position priors lie.
    pub frame: ContextFrame,
    /// Base-2 logarithm of the step adjustment of a group with static tables: the one with the mean squared error of the trained
    /// steps.
    pub static_steps: [f32; 3],
    /// Networks of [`ContextKind::Position`].
    pub position: GroupNetworks,
    /// Planes to choose from, at most one of which goes into a file.
    pub planes: Vec<PlaneContext>,
}
