//! Projects: what is stored belongs to one, and so do keys.
//!
//! Invariants: a project stays, so that what belongs to it always has an owner; [`ProjectId::DEFAULT`] is always there. Usage is kept as
//! totals, whose cost to read does not grow with what is stored.

use jiff::Timestamp;
use serde::Serialize;
use thiserror::Error;
use uuid::Builder;

use crate::domain::{
    JobState, MAX_NAME, MAX_PRIORITY, ProjectId, ProjectLimits, RandomError, RandomSource, valid_name,
};

/// A project to be added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewProject {
    /// Its identity, chosen by the caller; projects are listed in the order of these.
    pub id: ProjectId,
    pub name: String,
    pub limits: ProjectLimits,
}

/// Why a project cannot be created or changed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ProjectError {
    /// The name is empty, too long or has control characters.
    #[error("a project's name has 1 to {MAX_NAME} characters, none of them a control character")]
    Name,
    /// The database cannot store the number.
    #[error("max_bytes: {0} is above the maximum of 9223372036854775807")]
    MaxBytes(u64),
    /// The priority is out of range.
    #[error("max_priority: {0} is outside -{MAX_PRIORITY}..={MAX_PRIORITY}")]
    MaxPriority(i32),
    /// No random bytes could be drawn.
    #[error(transparent)]
    RandomSource(#[from] RandomError),
}

/// Limits that can be stored.
fn checked(limits: ProjectLimits) -> Result<ProjectLimits, ProjectError> {
    if let Some(bytes) = limits.quota_bytes.filter(|bytes| i64::try_from(*bytes).is_err()) {
        return Err(ProjectError::MaxBytes(bytes));
    }
    let is_outside = |max: &i32| !(-MAX_PRIORITY..=MAX_PRIORITY).contains(max);
    match limits.max_priority.filter(is_outside) {
        Some(priority) => Err(ProjectError::MaxPriority(priority)),
        None => Ok(limits),
    }
}

impl NewProject {
    /// A project with an identity of this moment.
    ///
    /// # Errors
    /// [`ProjectError`].
    pub fn generate(
        entropy: &dyn RandomSource,
        now: Timestamp,
        name: &str,
        limits: ProjectLimits,
    ) -> Result<Self, ProjectError> {
        let name = valid_name(name).ok_or(ProjectError::Name)?.to_owned();
        let limits = checked(limits)?;
        let mut tail = [0; 10];
        entropy.fill(&mut tail)?;
        let millis = u64::try_from(now.as_millisecond()).unwrap_or(0);
        let id = ProjectId(Builder::from_unix_timestamp_millis(millis, &tail).into_uuid());
        Ok(Self { id, name, limits })
    }
}

/// A project as it stands, and as the API shows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ProjectRecord {
    /// As in [`NewProject::id`].
    pub id: ProjectId,
    /// As in [`NewProject::name`].
    pub name: String,
    /// As in [`NewProject::limits`].
    #[serde(flatten)]
    pub limits: ProjectLimits,
    /// Row version, incremented by every change.
    #[serde(skip)]
    pub version: u64,
    pub created_at: Timestamp,
}

/// Name and limits of a project, as they are to be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProjectChange {
    pub name: String,
    pub limits: ProjectLimits,
}

impl ProjectChange {
    /// The change, if it can be stored.
    ///
    /// # Errors
    /// [`ProjectError`].
    pub fn checked(self) -> Result<Self, ProjectError> {
        let name = valid_name(&self.name).ok_or(ProjectError::Name)?.to_owned();
        Ok(Self { name, limits: checked(self.limits)? })
    }
}

/// Result of a request to change a project.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProjectUpdate {
    /// The project as it is now.
    Updated(ProjectRecord),
    /// It has another version than the expected one.
    VersionMismatch,
}

/// Bytes of a project's blobs by kind. A blob counts once, as what it was stored as first.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct StoredBytes {
    /// Archives of datasets.
    pub datasets: u64,
    /// Files of finished jobs.
    pub artifacts: u64,
    /// Finished scenes in other formats.
    pub exports: u64,
}

impl StoredBytes {
    /// All together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.datasets.saturating_add(self.artifacts).saturating_add(self.exports)
    }
}

/// What a project uses.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectUsage {
    /// The project, with its own limits.
    pub project: ProjectRecord,
    /// The limits in force, with the service's where it has none of its own.
    pub limits: ProjectLimits,
    /// What is stored.
    pub stored: StoredBytes,
    /// Total length of open uploads.
    pub reserved: u64,
    /// Jobs by state, for every state.
    pub jobs: Vec<(JobState, u64)>,
    /// Seconds that attempts held a worker with its processor and adapter, ever, up to now.
    pub worker_seconds: f64,
}
