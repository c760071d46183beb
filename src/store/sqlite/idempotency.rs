//! Requests with an `Idempotency-Key` in SQLite.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::{
    SqliteStore,
    rows::{self, before, micros},
};
use crate::{
    domain::ProjectId,
    store::{Idempotency, IdempotentRequest, PriorRequest, StoreError, StoreFuture},
};

/// Records, within the transaction that creates `resource`, that `intent` created it.
///
/// # Errors
/// [`StoreError::IdempotencyKeyUsed`] if its key was used before; the transaction must then be rolled back.
pub(super) async fn remember(
    connection: &mut SqliteConnection,
    intent: &IdempotentRequest,
    status: u16,
    resource: &str,
    keep: Duration,
    now: Timestamp,
) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM idempotency WHERE created_at <= ?")
        .bind(micros(before(now, keep)))
        .execute(&mut *connection)
        .await?;
    if let Some(earlier) = select(connection, intent.project, &intent.key).await? {
        return Err(StoreError::IdempotencyKeyUsed(Box::new(earlier)));
    }
    sqlx::query(
        "INSERT INTO idempotency (project, key, fingerprint, status, resource, created_at) VALUES (?, ?, ?, ?, ?, ?)",
    )
    .bind(intent.project.to_string())
    .bind(&intent.key)
    .bind(intent.fingerprint.to_string())
    .bind(i64::from(status))
    .bind(resource)
    .bind(micros(now))
    .execute(connection)
    .await?;
    Ok(())
}

async fn select(
    connection: &mut SqliteConnection,
    project: ProjectId,
    key: &str,
) -> Result<Option<PriorRequest>, StoreError> {
    let row = sqlx::query("SELECT * FROM idempotency WHERE project = ? AND key = ?")
        .bind(project.to_string())
        .bind(key)
        .fetch_optional(connection)
        .await?;
    row.as_ref().map(rows::prior_request).transpose()
}

impl Idempotency for SqliteStore {
    fn prior_request<'a>(
        &'a self,
        project: ProjectId,
        key: &'a str,
    ) -> StoreFuture<'a, Option<PriorRequest>> {
        Box::pin(async move {
            let row =
                sqlx::query("SELECT * FROM idempotency WHERE project = ? AND key = ? AND created_at > ?")
                    .bind(project.to_string())
                    .bind(key)
                    .bind(micros(before(self.clock.now(), self.policy.idempotency_ttl)))
                    .fetch_optional(&self.readers)
                    .await?;
            row.as_ref().map(rows::prior_request).transpose()
        })
    }
}
