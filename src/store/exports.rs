//! Finished scenes in formats that other programs read, and files by their hash.

use super::{ArtifactKind, BlobRef, StoreFuture};
use crate::domain::{Digest, JobId, KeyId, SceneFormat};

/// How alike pictures of an export and of the scene that it was made of are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExportFidelity {
    /// Mean PSNR of the one's pictures against the other's, in dB.
    pub psnr: f64,
    /// How many views were compared, more than none.
    pub views: u32,
}

/// A finished scene in another format.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExportRecord {
    /// The job whose scene it is.
    pub job: JobId,
    /// The job's file that it was made of.
    pub source: Digest,
    /// Its format.
    pub format: SceneFormat,
    /// Where it is.
    pub blob: BlobRef,
    /// How many Gaussians it has.
    pub gaussians: u64,
    /// Highest degree of its spherical harmonics.
    pub sh_degree: u8,
    /// What the other format cost, if it could be measured.
    pub fidelity: Option<ExportFidelity>,
}

/// A file that a job made, or that was made of its scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FileRecord {
    /// The job; the newest, if several made the same.
    pub job: JobId,
    /// What it is.
    pub kind: ArtifactKind,
    /// As in [`super::Artifact::lambda`].
    pub lambda: Option<f64>,
    /// Where it is.
    pub blob: BlobRef,
}

/// Part of a [`super::Store`]: exports, and files by hash. Every method is one transaction.
pub trait Exports: Send + Sync + 'static {
    /// Refuses with [`super::StoreError::QuotaExceeded`] if the job's owner has no room left for an export, however small.
    fn admit_export(&self, job: JobId) -> StoreFuture<'_, ()>;

    /// Keeps an export, unless there is one like it, and gives back the one that is kept; `None` if the job is gone. It counts
    /// against the quota of the job's owner, and is refused if that has no room for it.
    fn add_export(&self, export: ExportRecord) -> StoreFuture<'_, Option<ExportRecord>>;

    /// The exports of a job's scene.
    fn exports(&self, job: JobId) -> StoreFuture<'_, Vec<ExportRecord>>;

    /// The file with this hash among those of the owner's jobs, or of everybody's. Datasets are not among them.
    fn file(&self, digest: Digest, owner: Option<KeyId>) -> StoreFuture<'_, Option<FileRecord>>;
}
