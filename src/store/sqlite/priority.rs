//! The highest priority that an owner's jobs may have.

use sqlx::{Row as _, SqliteConnection};

use crate::{
    domain::{DEFAULT_MAX_PRIORITY, KeyId, Scope},
    store::StoreError,
};

/// Refuses a priority above the owner's maximum, which is `default` for keys without one. Administrators and services without keys
/// have no maximum. Part of the transaction that adds the job.
pub(super) async fn admit(
    connection: &mut SqliteConnection,
    default: Option<i32>,
    owner: Option<KeyId>,
    requested: i32,
) -> Result<(), StoreError> {
    let Some(key) = owner else { return Ok(()) };
    let row = sqlx::query("SELECT max_priority, scopes FROM keys WHERE id = ?")
        .bind(key.to_string())
        .fetch_one(connection)
        .await?;
    let scopes: String = row.try_get("scopes")?;
    if scopes.split_whitespace().any(|scope| scope == Scope::Admin.name()) {
        return Ok(());
    }
    let own: Option<i32> = row.try_get("max_priority")?;
    let max = own.or(default).unwrap_or(DEFAULT_MAX_PRIORITY);
    if requested > max { Err(StoreError::PriorityTooHigh { requested, max }) } else { Ok(()) }
}
