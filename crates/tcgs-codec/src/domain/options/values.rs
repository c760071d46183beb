//! The values of training options that belong to no other module: schedule, model, parts, background, cells.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use crate::domain::choice::named_choice;

named_choice! {
    /// A schedule: how many steps, how large a model.
    pub enum Preset {
        /// Minutes on a software adapter.
        Preview = "preview",
        /// For a GPU.
        Standard = "standard",
        /// 30 000 steps, as published.
        Paper = "paper",
    }
}

named_choice! {
    /// The color behind the scene.
    pub enum Background {
        /// (1, 1, 1).
        White = "white",
        /// (0, 0, 0).
        Black = "black",
    }
}

impl Background {
    /// As 8-bit RGB.
    #[must_use]
    pub fn rgb8(self) -> [u8; 3] {
        match self {
            Background::White => [255; 3],
            Background::Black => [0; 3],
        }
    }

    /// As RGB in [0, 1].
    #[must_use]
    pub fn rgb(self) -> [f32; 3] {
        self.rgb8().map(|value| f32::from(value) / 255.0)
    }
}

named_choice! {
    /// What is trained.
    pub enum ModelKind {
        /// Anchors with compression-aware training, written as `.tcgs`.
        Tcgs = "tcgs",
        /// The Scaffold-GS baseline.
        Scaffold = "scaffold",
        /// The plain 3D Gaussian splatting baseline.
        Gaussians3d = "3dgs",
    }
}

named_choice! {
    /// A part of the method that can be switched off.
    pub enum Component {
        /// The tri-plane context.
        TriPlane = "triplane",
        /// The neighbors' context.
        Knn = "knn",
        /// The planes' down and up sampling, a part of runs of 30 000 steps and more only, if not asked for.
        PlaneCompression = "plane-compression",
        /// The wavelet constraint.
        Wavelet = "wavelet",
        /// The offset masks.
        Masks = "masks",
        /// The decorrelating transform of features, and the removal of channels and offset slots that no picture needs.
        Basis = "basis",
        /// Spherical harmonics of the view direction among the networks' inputs, a part of runs of 500 steps and more.
        Harmonics = "harmonics",
        /// The regression of an anchor's attributes on each other in the file.
        Regression = "regression",
    }
}

named_choice! {
    /// When a run ends: after all of its steps.
    #[derive(Default)]
    pub enum Until {
        /// After all of its steps.
        #[default]
        Full = "full",
        /// The same. Jobs, checkpoints and files of earlier versions, which could end a run early, still say so.
        Converged = "converged",
    }
}

/// How large a cell of the anchors' lattice is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Voxel {
    /// A fraction of the points' spacing: right whatever the unit of the scene.
    #[default]
    Auto,
    /// As the published code chooses it: a squared distance taken for a length (METHOD.md §2.1).
    Published,
    /// So many world units.
    #[serde(untagged)]
    Edge(f64),
}

impl fmt::Display for Voxel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Voxel::Auto => f.write_str("auto"),
            Voxel::Published => f.write_str("published"),
            Voxel::Edge(edge) => edge.fmt(f),
        }
    }
}

impl FromStr for Voxel {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Voxel::Auto),
            "published" => Ok(Voxel::Published),
            _ => text
                .parse()
                .map(Voxel::Edge)
                .map_err(|_| format!("'{text}' is not auto, published or a length")),
        }
    }
}
