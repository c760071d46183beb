//! Finished scenes in formats that other programs read, and files by their hash.

use super::{ArtifactKind, BlobRef, StoreFuture};
use crate::domain::{Digest, ExportFidelity, JobId, ProjectId, SceneFormat};

/// A finished scene in another format.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExportRecord {
    /// The job whose scene it contains.
    pub job: JobId,
    /// The job's file that it was converted from.
    pub source: Digest,
    /// Its format.
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
    /// Its kind.
    pub kind: ArtifactKind,
    /// As in [`super::Artifact::lambda`].
    pub lambda: Option<f64>,
    /// Its content.
    pub blob: BlobRef,
}

/// The part of a store that keeps exports and finds files by their hash. Every method is one transaction.
pub trait Exports: Send + Sync + 'static {
    /// Fails with [`super::StoreError::QuotaExceeded`] if the job's project has used up its quota.
    fn admit_export(&self, job: JobId) -> StoreFuture<'_, ()>;

    /// Adds an export unless the job has one of the same source and format, and returns the one that is stored; `None` if there is no
    /// such job. It counts against the quota of the job's project.
    fn add_export(&self, export: ExportRecord) -> StoreFuture<'_, Option<ExportRecord>>;

    /// The exports of a job's scene.
    fn exports(&self, job: JobId) -> StoreFuture<'_, Vec<ExportRecord>>;

    /// The file with this hash among those of the project's jobs, or of all jobs without `project`. Datasets are not included.
    fn file(&self, digest: Digest, project: Option<ProjectId>) -> StoreFuture<'_, Option<FileRecord>>;
}
