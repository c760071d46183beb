//! How high the priority of an owner's jobs may be.

use sqlx::{Row as _, SqliteConnection};

use crate::{
    domain::{DEFAULT_MAX_PRIORITY, KeyId, Scope},
    store::StoreError,
};

/// Refuses a priority above the owner's ceiling, which is `default` for keys without one. Administrators have none, nor has
/// whoever asks a service without keys. Part of the transaction that adds the job.
pub(super) async fn admit(
    connection: &mut SqliteConnection,
    default: Option<i32>,
    owner: Option<KeyId>,
    asked: i32,
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
    let most = own.or(default).unwrap_or(DEFAULT_MAX_PRIORITY);
    if asked > most { Err(StoreError::PriorityTooHigh { asked, most }) } else { Ok(()) }
}
