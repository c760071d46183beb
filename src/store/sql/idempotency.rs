//! Requests with an `Idempotency-Key`.

use std::time::Duration;

use super::{
    Store,
    db::{Transaction, query, values},
    rows::{self, before, micros},
};
use crate::{
    domain::ProjectId,
    store::{IdempotentRequest, PriorRequest, StoreError, StoreFuture},
};
use jiff::Timestamp;

/// Records, within the transaction that creates `resource`, that `intent` created it.
///
/// # Errors
/// [`StoreError::IdempotencyKeyUsed`] if its key was used before; the transaction must then be rolled back.
pub(super) async fn remember(
    connection: &mut Transaction,
    intent: &IdempotentRequest,
    status: u16,
    resource: &str,
    keep: Duration,
    now: Timestamp,
) -> Result<(), StoreError> {
    query("DELETE FROM idempotency WHERE created_at <= ?")
        .bind(micros(before(now, keep)))
        .execute(&mut *connection)
        .await?;
    // On PostgreSQL this waits for another transaction that is using the key.
    let added = query(
        "INSERT INTO idempotency (project, key, fingerprint, status, resource, created_at) VALUES (?, ?, ?, ?, ?, ?)
         ON CONFLICT DO NOTHING",
    )
    .bind_all(values![intent.project.to_string(), &intent.key, intent.fingerprint.to_string()])
    .bind_all(values![i64::from(status), resource, micros(now)])
    .execute(&mut *connection)
    .await?;
    if added == 1 {
        return Ok(());
    }
    let earlier = select(connection, intent.project, &intent.key).await?.ok_or(sqlx::Error::RowNotFound)?;
    Err(StoreError::IdempotencyKeyUsed(Box::new(earlier)))
}

/// Changes what [`remember`] recorded in the same transaction.
pub(super) async fn amend(
    connection: &mut Transaction,
    intent: &IdempotentRequest,
    status: u16,
    resource: &str,
) -> Result<(), StoreError> {
    query("UPDATE idempotency SET status = ?, resource = ? WHERE project = ? AND key = ?")
        .bind_all(values![status, resource, intent.project.to_string(), &intent.key])
        .run(connection)
        .await
}

async fn select(
    connection: &mut Transaction,
    project: ProjectId,
    key: &str,
) -> Result<Option<PriorRequest>, StoreError> {
    query("SELECT * FROM idempotency WHERE project = ? AND key = ?")
        .bind_all(values![project.to_string(), key])
        .optional(connection, rows::prior_request)
        .await
}

impl Store {
    /// The project's earlier request with this key, unless [`crate::store::QueuePolicy::idempotency_ttl`] has passed since.
    pub fn prior_request<'a>(
        &'a self,
        project: ProjectId,
        key: &'a str,
    ) -> StoreFuture<'a, Option<PriorRequest>> {
        self.call("prior_request").run(async move {
            let now = self.now(&self.readers).await?;
            query("SELECT * FROM idempotency WHERE project = ? AND key = ? AND created_at > ?")
                .bind_all(values![project.to_string(), key, micros(before(now, self.policy.idempotency_ttl))])
                .optional(&self.readers, rows::prior_request)
                .await
        })
    }
}
