//! What a transaction locks on PostgreSQL, where others run at the same time. On SQLite a writer holds the whole database, and nothing here
//! does anything.
//!
//! The order is always the same, so that no two transactions wait for each other: the row of an `Idempotency-Key`, then the totals of
//! projects in the order of their identities, all in one statement, then rows of jobs, then of blobs. Whoever locks the table of keys locks
//! nothing else.

use super::{
    MEMBERS,
    db::{Sql, Transaction, Value, query},
    rows::json,
};
use crate::{
    domain::{Digest, JobId, ProjectId, UploadId},
    store::StoreError,
};

/// Locks the totals of the projects that `selected` and then `last`, where a value goes, select.
async fn totals(
    tx: &mut Transaction,
    selected: &'static str,
    last: impl Into<Sql>,
    value: Value,
) -> Result<(), StoreError> {
    if tx.is_postgres() {
        let mut lock = query("SELECT 1 FROM project_totals WHERE project IN (");
        lock.push(selected).push(last).push(") ORDER BY project");
        lock.bind(value).for_update().fetch_all(tx).await?;
    }
    Ok(())
}

/// Locks a project's totals.
pub(super) async fn project(tx: &mut Transaction, project: ProjectId) -> Result<(), StoreError> {
    projects(tx, "", project.to_string()).await
}

/// Locks the totals of the projects that a condition selects, which ends where the value goes.
pub(super) async fn projects(
    tx: &mut Transaction,
    selected: &'static str,
    value: impl Into<Value>,
) -> Result<(), StoreError> {
    totals(tx, selected, "?", value.into()).await
}

/// Locks the totals of a job's project.
pub(super) async fn job(tx: &mut Transaction, job: JobId) -> Result<(), StoreError> {
    projects(tx, "SELECT project FROM jobs WHERE id = ", job.to_string()).await
}

/// Locks the totals of the projects of these jobs.
pub(super) async fn jobs(tx: &mut Transaction, jobs: &[JobId]) -> Result<(), StoreError> {
    totals(tx, "SELECT project FROM jobs WHERE id IN ", MEMBERS, json(&jobs)?.into()).await
}

/// Locks the totals of the projects of these uploads.
pub(super) async fn uploads(tx: &mut Transaction, uploads: &[UploadId]) -> Result<(), StoreError> {
    totals(tx, "SELECT project FROM uploads WHERE id IN ", MEMBERS, json(&uploads)?.into()).await
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

/// Keeps others from adding and changing keys.
pub(super) async fn keys(tx: &mut Transaction) -> Result<(), StoreError> {
    if tx.is_postgres() {
        query("LOCK TABLE keys IN SHARE ROW EXCLUSIVE MODE").execute(tx).await?;
    }
    Ok(())
}
