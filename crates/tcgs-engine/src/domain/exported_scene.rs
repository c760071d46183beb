//! A finished scene in a format that other programs read.

use serde::{Deserialize, Serialize};

/// How close renders of an export are to those of its source scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExportFidelity {
    /// Mean PSNR in dB of the export's renders against the source's.
    pub psnr: f64,
    /// How many views were compared, at least one.
    pub views: u32,
}

/// A finished scene in another format.
#[derive(Debug, Clone, PartialEq)]
pub struct ExportedScene {
    /// The file.
    pub bytes: Vec<u8>,
    /// How many Gaussians it has.
    pub gaussians: u64,
    /// Highest degree of its spherical harmonics.
    pub sh_degree: u8,
    /// Its fidelity to the scene, if it could be measured.
    pub fidelity: Option<ExportFidelity>,
}
