//! Finished scenes in formats that other programs read, and files by their hash.

use super::{ArtifactKind, BlobRef};
use crate::domain::{Digest, ExportFidelity, JobId, SceneFormat};

/// A finished scene in another format.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExportRecord {
    /// The job whose scene it contains.
    pub job: JobId,
    /// The job's file that it was converted from.
    pub source: Digest,
    pub format: SceneFormat,
    /// Its content.
    pub blob: BlobRef,
    /// How many Gaussians it has.
    pub gaussians: u64,
    /// Highest degree of its spherical harmonics.
    pub sh_degree: u8,
    /// Fidelity to the source, if it could be measured.
    pub fidelity: Option<ExportFidelity>,
}

/// A file of a job, or an export of its scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FileRecord {
    /// The job; the newest, if several have the same file.
    pub job: JobId,
    pub kind: ArtifactKind,
    /// As in [`super::Artifact::lambda`].
    pub lambda: Option<f64>,
    /// Its content.
    pub blob: BlobRef,
}
