//! What a transaction locks on PostgreSQL, where others run at the same time. On SQLite a writer holds the whole database, and nothing here
//! does anything.
//!
//! The order is always the same, so that no two transactions wait for each other: the row of an `Idempotency-Key`, then the totals of
//! projects in the order of their identities, all in one statement, then rows of jobs, then of blobs.

use super::{
    MEMBERS,
    db::{Query, Transaction, query},
    rows::json,
};
use crate::{
    domain::{Digest, JobId, ProjectId},
    store::StoreError,
};

/// Locks the totals of the projects that `which` selects.
async fn projects(tx: &mut Transaction, fill: impl FnOnce(&mut Query)) -> Result<(), StoreError> {
    if tx.is_postgres() {
        let mut lock = query("SELECT 1 FROM project_totals WHERE project IN (");
        fill(&mut lock);
        lock.push(") ORDER BY project");
        lock.for_update().fetch_all(tx).await?;
    }
    Ok(())
}

/// Locks a project's totals.
pub(super) async fn project(tx: &mut Transaction, project: ProjectId) -> Result<(), StoreError> {
    projects(tx, |lock| {
        lock.push_bind(project.to_string());
    })
    .await
}

/// Locks the totals of the project of a row of `table` with this identity.
pub(super) async fn project_of(
    tx: &mut Transaction,
    selected: &'static str,
    id: impl ToString,
) -> Result<(), StoreError> {
    projects(tx, |lock| {
        lock.push(selected).push_bind(id.to_string());
    })
    .await
}

/// Locks the totals of a job's project.
pub(super) async fn job(tx: &mut Transaction, job: JobId) -> Result<(), StoreError> {
    project_of(tx, "SELECT project FROM jobs WHERE id = ", job).await
}

/// Locks the totals of the projects of these jobs.
pub(super) async fn jobs(tx: &mut Transaction, jobs: &[JobId]) -> Result<(), StoreError> {
    let jobs = json(&jobs)?;
    projects(tx, |lock| {
        lock.push("SELECT project FROM jobs WHERE id IN ").push(MEMBERS);
        *lock = lock.clone().bind(jobs);
    })
    .await
}

/// Locks the totals of the projects that a condition on a time selects.
pub(super) async fn projects_by_time(
    tx: &mut Transaction,
    selected: &'static str,
    micros: i64,
) -> Result<(), StoreError> {
    projects(tx, |lock| {
        lock.push(selected).push_bind(micros);
    })
    .await
}

/// Keeps a blob's row from being deleted; returns false if it was.
pub(super) async fn blob(tx: &mut Transaction, digest: Digest) -> Result<bool, StoreError> {
    if !tx.is_postgres() {
        return Ok(true);
    }
    let row = query("SELECT 1 FROM blobs WHERE digest = ? FOR KEY SHARE").bind(digest.to_string());
    Ok(row.fetch_optional(tx).await?.is_some())
}

/// Takes a blob's row for deletion; returns false if another transaction uses it.
pub(super) async fn blob_to_delete(tx: &mut Transaction, digest: Digest) -> Result<bool, StoreError> {
    if !tx.is_postgres() {
        return Ok(true);
    }
    // A file may have no row; then nothing can be in use.
    let used = query("SELECT 1 FROM blobs WHERE digest = ?").bind(digest.to_string());
    if used.fetch_optional(&mut *tx).await?.is_none() {
        return Ok(true);
    }
    let row = query("SELECT 1 FROM blobs WHERE digest = ? FOR UPDATE SKIP LOCKED").bind(digest.to_string());
    Ok(row.fetch_optional(tx).await?.is_some())
}
