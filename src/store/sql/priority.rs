//! The highest priority that a project's jobs may have.

use super::db::{Transaction, query};
use crate::{
    domain::{DEFAULT_MAX_PRIORITY, KeyId, ProjectId, Scope},
    store::StoreError,
};

/// Refuses a priority above the [`highest`]. Part of the transaction that adds the job.
pub(super) async fn admit(
    connection: &mut Transaction,
    default: Option<i32>,
    project: ProjectId,
    key: Option<KeyId>,
    requested: i32,
) -> Result<(), StoreError> {
    match highest(connection, default, project, key).await? {
        Some(max) if requested > max => Err(StoreError::PriorityTooHigh { requested, max }),
        _ => Ok(()),
    }
}

/// The highest priority of jobs that a key may add to a project, which is `default` for projects without one. Administrators and services
/// without keys have none.
pub(super) async fn highest(
    connection: &mut Transaction,
    default: Option<i32>,
    project: ProjectId,
    key: Option<KeyId>,
) -> Result<Option<i32>, StoreError> {
    let Some(key) = key else { return Ok(None) };
    let row = query("SELECT scopes FROM keys WHERE id = ?")
        .bind(key.to_string())
        .fetch_one(&mut *connection)
        .await?;
    let scopes: String = row.try_get("scopes")?;
    if scopes.split_whitespace().any(|scope| scope == Scope::Admin.name()) {
        return Ok(None);
    }
    let row = query("SELECT max_priority FROM projects WHERE id = ?")
        .bind(project.to_string())
        .fetch_one(connection)
        .await?;
    let own: Option<i32> = super::rows::optional_integer(&row, "max_priority")?;
    Ok(Some(own.or(default).unwrap_or(DEFAULT_MAX_PRIORITY)))
}
