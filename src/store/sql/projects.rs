//! Projects.

use super::{
    Store, accounts,
    db::{Row, Transaction, query, values},
    lists, locks,
    rows::{self, integer, micros, optional_integer},
};
use crate::{
    domain::{JobState, ProjectId, ProjectLimits},
    store::{
        NewProject, ProjectChange, ProjectRecord, ProjectUpdate, ProjectUsage, StoreError, StoreFuture,
        StoredBytes,
    },
};
use jiff::Timestamp;

/// A number of bytes as columns hold it: a database has no larger integer, and no disk holds more.
fn bytes_column(bytes: Option<u64>) -> Option<i64> {
    bytes.map(rows::signed)
}

/// Adds a project within its caller's transaction.
pub(super) async fn insert(
    connection: &mut Transaction,
    new: &NewProject,
    now: Timestamp,
) -> Result<ProjectRecord, StoreError> {
    let row = query(
        "INSERT INTO projects (id, name, max_bytes, max_active_jobs, max_running_jobs, max_priority, created_at)
         VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING *",
    )
    .bind_all(values![new.id.to_string(), &new.name, bytes_column(new.limits.quota_bytes)])
    .bind_all(values![new.limits.max_active_jobs, new.limits.max_running_jobs, new.limits.max_priority])
    .bind(micros(now))
    .fetch_one(connection)
    .await?;
    project(&row)
}

async fn select(connection: &mut Transaction, id: ProjectId) -> Result<Option<ProjectRecord>, StoreError> {
    query("SELECT * FROM projects WHERE id = ?").bind(id.to_string()).optional(connection, project).await
}

/// A row of `projects`.
fn project(row: &Row) -> Result<ProjectRecord, StoreError> {
    Ok(ProjectRecord {
        id: rows::parsed("project", row.try_get("id")?)?,
        name: row.try_get("name")?,
        limits: ProjectLimits {
            quota_bytes: optional_integer(row, "max_bytes")?,
            max_active_jobs: optional_integer(row, "max_active_jobs")?,
            max_running_jobs: optional_integer(row, "max_running_jobs")?,
            max_priority: optional_integer(row, "max_priority")?,
        },
        version: integer(row, "version")?,
        created_at: rows::instant("created_at", row.try_get("created_at")?)?,
    })
}

/// A row of `projects` joined with `project_totals`, and the time of its running attempts.
fn usage(row: &Row, defaults: ProjectLimits) -> Result<ProjectUsage, StoreError> {
    let project = project(row)?;
    let id = project.id;
    let defaults = ProjectLimits {
        quota_bytes: accounts::default_limit(id, defaults.quota_bytes),
        max_active_jobs: accounts::default_limit(id, defaults.max_active_jobs),
        ..defaults
    };
    let jobs = [
        (JobState::Queued, "queued_jobs"),
        (JobState::Running, "running_jobs"),
        (JobState::Succeeded, "succeeded_jobs"),
        (JobState::Failed, "failed_jobs"),
        (JobState::Cancelled, "cancelled_jobs"),
    ];
    let jobs = jobs.into_iter().map(|(state, column)| Ok((state, integer(row, column)?)));
    let micros: u64 = integer::<u64>(row, "worker_micros")? + integer::<u64>(row, "running_micros")?;
    Ok(ProjectUsage {
        limits: project.limits.or(defaults),
        project,
        stored: StoredBytes {
            datasets: integer(row, "dataset_bytes")?,
            artifacts: integer(row, "artifact_bytes")?,
            exports: integer(row, "export_bytes")?,
        },
        reserved: integer(row, "reserved_bytes")?,
        jobs: jobs.collect::<Result<_, StoreError>>()?,
        worker_seconds: micros as f64 / 1e6,
    })
}

impl Store {
    /// Adds a project.
    pub fn create_project(&self, new: NewProject) -> StoreFuture<'_, ProjectRecord> {
        self.call("create_project").run(self.write(async move |tx, now| insert(tx, &new, now).await))
    }

    /// The project.
    pub fn project(&self, id: ProjectId) -> StoreFuture<'_, Option<ProjectRecord>> {
        self.call("project").run(self.read(async move |tx| select(tx, id).await))
    }

    /// Up to `limit` projects, newest first, older than `before`.
    pub fn projects(&self, before: Option<ProjectId>, limit: u32) -> StoreFuture<'_, Vec<ProjectRecord>> {
        let list = query("SELECT * FROM projects WHERE id < COALESCE(?, 'g') ORDER BY id DESC LIMIT ?");
        self.call("projects")
            .run(list.bind(before.map(|id| id.to_string())).bind(limit).all(&self.readers, project))
    }

    /// Changes name and limits if it has the expected version; `None` if there is no such project.
    pub fn update_project(
        &self,
        id: ProjectId,
        version: Option<u64>,
        change: ProjectChange,
    ) -> StoreFuture<'_, Option<ProjectUpdate>> {
        self.call("update_project").run(self.write(async move |tx, _| {
            locks::project(tx, id).await?;
            let Some(record) = select(tx, id).await? else { return Ok(None) };
            if version.is_some_and(|version| version != record.version) {
                return Ok(Some(ProjectUpdate::VersionMismatch));
            }
            let row = query(
                "UPDATE projects SET name = ?, max_bytes = ?, max_active_jobs = ?, max_running_jobs = ?, max_priority = ?,
                     version = version + 1
                 WHERE id = ? RETURNING *",
            )
            .bind_all(values![&change.name, bytes_column(change.limits.quota_bytes)])
            .bind_all(values![change.limits.max_active_jobs, change.limits.max_running_jobs])
            .bind_all(values![change.limits.max_priority, id.to_string()])
            .fetch_one(tx)
            .await?;
            Ok(Some(ProjectUpdate::Updated(project(&row)?)))
        }))
    }

    /// Usage of one project, or of up to `limit` projects, newest first, older than `before`.
    pub fn project_usage(
        &self,
        project: Option<ProjectId>,
        before: Option<ProjectId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<ProjectUsage>> {
        self.call("project_usage").run(async move {
            let now = self.now(&self.readers).await?;
            let list = lists::usage(project, before, limit, now);
            list.all(&self.readers, |row| usage(row, self.policy.limits)).await
        })
    }
}
