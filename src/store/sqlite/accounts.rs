//! Usage and quotas of owners, and references to blobs, in SQLite.
//!
//! Usage is read from totals that the schema's triggers maintain; tests compare them with a recount. The query below names every table
//! that refers to blobs; a test compares it with the schema's foreign keys, which also prevent the deletion of a referenced row.

use sqlx::{Row as _, SqliteConnection};

use super::{
    SqliteStore,
    rows::{optional_unsigned, unsigned},
};
use crate::{
    domain::{Digest, KeyId},
    store::{Accounts, BlobRef, Capacity, StoreError, StoreFuture, Usage},
};

/// Whether anything refers to blob `?1`.
const IS_REFERENCED: &str = "
    SELECT EXISTS (SELECT 1 FROM scenes WHERE dataset = ?1)
        OR EXISTS (SELECT 1 FROM jobs WHERE dataset = ?1)
        OR EXISTS (SELECT 1 FROM artifacts WHERE digest = ?1)
        OR EXISTS (SELECT 1 FROM exports WHERE digest = ?1)
        OR EXISTS (SELECT 1 FROM exports WHERE source = ?1) AS referenced";

/// Usage of account `?1`.
const USAGE: &str = "SELECT stored_bytes, reserved_bytes FROM owner_totals WHERE owner = ?1";

/// Whether account `?1` refers to blob `?2`.
const HAS_BLOB: &str = "SELECT EXISTS (SELECT 1 FROM owner_blobs WHERE owner = ?1 AND digest = ?2) AS known";

/// How many active jobs key `?1` has and may have.
const ACTIVE_JOBS: &str = "
    SELECT max_active_jobs, IFNULL((SELECT active_jobs FROM owner_totals WHERE owner = keys.id), 0) AS active
    FROM keys WHERE id = ?1";

/// Statements that run under the write lock; their cost must not grow with the number of rows.
#[cfg(test)]
pub(super) const STATEMENTS: [&str; 4] = [USAGE, HAS_BLOB, ACTIVE_JOBS, IS_REFERENCED];

/// The owner as totals name it; no owner is the empty string.
fn account(owner: Option<KeyId>) -> String {
    owner.map_or_else(String::new, |owner| owner.to_string())
}

/// The owner's usage.
async fn usage(connection: &mut SqliteConnection, owner: Option<KeyId>) -> Result<Usage, StoreError> {
    let row = sqlx::query(USAGE).bind(account(owner)).fetch_optional(connection).await?;
    let Some(row) = row else { return Ok(Usage { stored: 0, reserved: 0 }) };
    Ok(Usage { stored: unsigned(&row, "stored_bytes")?, reserved: unsigned(&row, "reserved_bytes")? })
}

/// The owner's quota, which is `default` for keys without one.
async fn quota(
    connection: &mut SqliteConnection,
    default: Option<u64>,
    owner: Option<KeyId>,
) -> Result<Option<u64>, StoreError> {
    let Some(key) = owner else { return Ok(None) };
    let row = sqlx::query("SELECT max_bytes FROM keys WHERE id = ?")
        .bind(key.to_string())
        .fetch_one(connection)
        .await?;
    Ok(optional_unsigned(&row, "max_bytes")?.or(default))
}

/// Refuses `requested` more bytes over the owner's quota, which is `default` for keys without one. Part of the transaction that
/// adds them.
pub(super) async fn admit(
    connection: &mut SqliteConnection,
    default: Option<u64>,
    owner: Option<KeyId>,
    requested: u64,
) -> Result<(), StoreError> {
    let Some(quota) = quota(connection, default, owner).await? else { return Ok(()) };
    let usage = usage(connection, owner).await?;
    Capacity { usage, quota: Some(quota), ..Capacity::default() }.admit(0, requested)
}

/// As [`admit`], for a blob; one that the owner refers to already counts nothing.
pub(super) async fn admit_blob(
    connection: &mut SqliteConnection,
    default: Option<u64>,
    owner: Option<KeyId>,
    blob: BlobRef,
) -> Result<(), StoreError> {
    let row = sqlx::query(HAS_BLOB)
        .bind(account(owner))
        .bind(blob.digest.to_string())
        .fetch_one(&mut *connection)
        .await?;
    let known: bool = row.try_get("known")?;
    if known { Ok(()) } else { admit(connection, default, owner, blob.bytes).await }
}

/// Refuses another job if the owner has its maximum of queued and running ones, which is `default` for keys without one. Part of the
/// transaction that adds it.
pub(super) async fn admit_job(
    connection: &mut SqliteConnection,
    default: Option<u32>,
    owner: Option<KeyId>,
) -> Result<(), StoreError> {
    let Some(key) = owner else { return Ok(()) };
    let row = sqlx::query(ACTIVE_JOBS).bind(key.to_string()).fetch_one(connection).await?;
    let active: u32 = unsigned(&row, "active")?;
    let max: Option<u32> = optional_unsigned(&row, "max_active_jobs")?.or(default);
    if max.is_some_and(|max| active >= max) {
        return Err(StoreError::TooManyJobs { active });
    }
    Ok(())
}

/// Those of the blobs that nothing refers to.
async fn unreferenced(
    connection: &mut SqliteConnection,
    digests: &[Digest],
) -> Result<Vec<Digest>, StoreError> {
    let mut unreferenced = Vec::new();
    for digest in digests {
        let row = sqlx::query(IS_REFERENCED).bind(digest.to_string()).fetch_one(&mut *connection).await?;
        if !row.try_get::<bool, _>("referenced")? {
            unreferenced.push(*digest);
        }
    }
    Ok(unreferenced)
}

impl Accounts for SqliteStore {
    fn usage(&self, owner: Option<KeyId>) -> StoreFuture<'_, Usage> {
        Box::pin(self.read(async move |tx| usage(tx, owner).await))
    }

    fn capacity(&self, owner: Option<KeyId>) -> StoreFuture<'_, Capacity> {
        Box::pin(self.read(async move |tx| {
            let quota = quota(tx, self.policy.limits.quota_bytes, owner).await?;
            if quota.is_none() {
                return Ok(Capacity::default());
            }
            let row = sqlx::query(
                "SELECT IFNULL(MAX(bytes), 0) AS largest FROM blobs WHERE digest IN (
                     SELECT dataset FROM scenes WHERE owner IS ?1 UNION SELECT dataset FROM jobs WHERE owner IS ?1)",
            )
            .bind(owner.map(|owner| owner.to_string()))
            .fetch_one(&mut *tx)
            .await?;
            let usage = usage(tx, owner).await?;
            Ok(Capacity { usage, quota, largest_dataset: unsigned(&row, "largest")? })
        }))
    }

    fn owned_archive(&self, owner: Option<KeyId>, content: Digest) -> StoreFuture<'_, Option<BlobRef>> {
        Box::pin(async move {
            let row = sqlx::query(
                "SELECT bytes FROM blobs WHERE digest = ?1
                     AND (EXISTS (SELECT 1 FROM scenes WHERE dataset = ?1 AND owner IS ?2)
                          OR EXISTS (SELECT 1 FROM jobs WHERE dataset = ?1 AND owner IS ?2))",
            )
            .bind(content.to_string())
            .bind(owner.map(|owner| owner.to_string()))
            .fetch_optional(&self.readers)
            .await?;
            row.map(|row| Ok(BlobRef { digest: content, bytes: unsigned(&row, "bytes")? })).transpose()
        })
    }

    fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> StoreFuture<'a, Vec<Digest>> {
        Box::pin(async move {
            // Most are in use; looking first keeps the write lock free.
            let unused = self.read(async move |tx| unreferenced(tx, digests).await).await?;
            if unused.is_empty() {
                return Ok(unused);
            }
            self.write(async move |tx, _| {
                let unused = unreferenced(tx, &unused).await?;
                for digest in &unused {
                    sqlx::query("DELETE FROM blobs WHERE digest = ?")
                        .bind(digest.to_string())
                        .execute(&mut *tx)
                        .await?;
                }
                Ok(unused)
            })
            .await
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sqlite::open::temporary_store;

    #[tokio::test]
    async fn the_query_names_every_table_that_refers_to_blobs() {
        let (_folder, store) = temporary_store().await;
        let rows = sqlx::query(
            "SELECT tables.name, keys.\"from\" FROM sqlite_schema AS tables, pragma_foreign_key_list(tables.name) AS keys
             WHERE tables.type = 'table' AND keys.\"table\" = 'blobs'",
        )
        .fetch_all(&store.readers)
        .await
        .expect("the schema");
        assert!(rows.len() >= 3);
        for row in rows {
            let (table, column): (String, String) = (row.get(0), row.get(1));
            assert!(
                IS_REFERENCED.contains(&format!("FROM {table} WHERE {column} = ?1")),
                "blobs of {table}.{column} would be deleted as nobody's"
            );
        }
    }
}
