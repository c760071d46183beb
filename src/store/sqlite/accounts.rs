//! Accounts of owners and of blobs in SQLite.
//!
//! What an owner has is read from totals that the schema's triggers keep; tests compare them with a recount. Every table that refers
//! to blobs has its part in the query below; a test compares it with the schema's foreign keys. Those keys also keep a row from
//! being deleted that anything refers to, whatever a query has forgotten.

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
const IS_REFERRED_TO: &str = "
    SELECT EXISTS (SELECT 1 FROM scenes WHERE dataset = ?1)
        OR EXISTS (SELECT 1 FROM jobs WHERE dataset = ?1)
        OR EXISTS (SELECT 1 FROM artifacts WHERE digest = ?1)
        OR EXISTS (SELECT 1 FROM exports WHERE digest = ?1)
        OR EXISTS (SELECT 1 FROM exports WHERE source = ?1) AS referred_to";

/// What the things of account `?1` take.
const USAGE: &str = "SELECT stored_bytes, reserved_bytes FROM owner_totals WHERE owner = ?1";

/// Whether the things of account `?1` refer to blob `?2`.
const HAS_BLOB: &str = "SELECT EXISTS (SELECT 1 FROM owner_blobs WHERE owner = ?1 AND digest = ?2) AS known";

/// How many active jobs key `?1` has and may have.
const ACTIVE_JOBS: &str = "
    SELECT max_active_jobs, IFNULL((SELECT active_jobs FROM owner_totals WHERE owner = keys.id), 0) AS active
    FROM keys WHERE id = ?1";

/// What is asked while the database is locked for writing; it must not grow with what is stored.
#[cfg(test)]
pub(super) const STATEMENTS: [&str; 4] = [USAGE, HAS_BLOB, ACTIVE_JOBS, IS_REFERRED_TO];

/// The owner as totals name them: nobody has a name too.
fn account(owner: Option<KeyId>) -> String {
    owner.map_or_else(String::new, |owner| owner.to_string())
}

/// What the owner's things take.
async fn usage(connection: &mut SqliteConnection, owner: Option<KeyId>) -> Result<Usage, StoreError> {
    let row = sqlx::query(USAGE).bind(account(owner)).fetch_optional(connection).await?;
    let Some(row) = row else { return Ok(Usage { stored: 0, reserved: 0 }) };
    Ok(Usage { stored: unsigned(&row, "stored_bytes")?, reserved: unsigned(&row, "reserved_bytes")? })
}

/// How much the owner may store, which is `default` for keys that do not say.
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

/// Refuses `asked` more bytes if they are over the owner's quota, which is `default` for keys without one. Part of the transaction
/// that adds them.
pub(super) async fn admit(
    connection: &mut SqliteConnection,
    default: Option<u64>,
    owner: Option<KeyId>,
    asked: u64,
) -> Result<(), StoreError> {
    let Some(quota) = quota(connection, default, owner).await? else { return Ok(()) };
    let usage = usage(connection, owner).await?;
    Capacity { usage, quota: Some(quota), ..Capacity::default() }.admit(0, asked)
}

/// As [`admit`], of a blob: one that the owner's things refer to already takes no further room.
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

/// Refuses another job if the owner has as many queued and running as they may, which is `default` for keys that do not say. Part of
/// the transaction that adds it.
pub(super) async fn admit_job(
    connection: &mut SqliteConnection,
    default: Option<u32>,
    owner: Option<KeyId>,
) -> Result<(), StoreError> {
    let Some(key) = owner else { return Ok(()) };
    let row = sqlx::query(ACTIVE_JOBS).bind(key.to_string()).fetch_one(connection).await?;
    let active: u32 = unsigned(&row, "active")?;
    let most: Option<u32> = optional_unsigned(&row, "max_active_jobs")?.or(default);
    if most.is_some_and(|most| active >= most) {
        return Err(StoreError::TooManyJobs { active });
    }
    Ok(())
}

async fn is_referred_to(connection: &mut SqliteConnection, digest: Digest) -> Result<bool, StoreError> {
    let row = sqlx::query(IS_REFERRED_TO).bind(digest.to_string()).fetch_one(connection).await?;
    Ok(row.try_get("referred_to")?)
}

impl Accounts for SqliteStore {
    fn usage(&self, owner: Option<KeyId>) -> StoreFuture<'_, Usage> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            usage(&mut tx, owner).await
        })
    }

    fn capacity(&self, owner: Option<KeyId>) -> StoreFuture<'_, Capacity> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            let quota = quota(&mut tx, self.policy.limits.max_bytes, owner).await?;
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
            let usage = usage(&mut tx, owner).await?;
            Ok(Capacity { usage, quota, largest_dataset: unsigned(&row, "largest")? })
        })
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
            let mut unused = Vec::new();
            // Most are in use; looking first keeps the one writer free.
            let mut reader = self.readers.begin().await?;
            for digest in digests {
                if !is_referred_to(&mut reader, *digest).await? {
                    unused.push(*digest);
                }
            }
            drop(reader);
            if unused.is_empty() {
                return Ok(unused);
            }
            let (mut tx, _) = self.begin().await?;
            let mut forgotten = Vec::with_capacity(unused.len());
            for digest in unused {
                if !is_referred_to(&mut tx, digest).await? {
                    sqlx::query("DELETE FROM blobs WHERE digest = ?")
                        .bind(digest.to_string())
                        .execute(&mut *tx)
                        .await?;
                    forgotten.push(digest);
                }
            }
            tx.commit().await?;
            Ok(forgotten)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{domain::SystemClock, store::QueuePolicy};

    #[tokio::test]
    async fn every_table_that_refers_to_blobs_is_asked() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.db");
        let store = SqliteStore::open(&path, Arc::new(SystemClock), QueuePolicy::default()).await;
        let rows = sqlx::query(
            "SELECT tables.name, keys.\"from\" FROM sqlite_schema AS tables, pragma_foreign_key_list(tables.name) AS keys
             WHERE tables.type = 'table' AND keys.\"table\" = 'blobs'",
        )
        .fetch_all(&store.expect("a database").readers)
        .await
        .expect("the schema");
        assert!(rows.len() >= 3);
        for row in rows {
            let (table, column): (String, String) = (row.get(0), row.get(1));
            assert!(
                IS_REFERRED_TO.contains(&format!("FROM {table} WHERE {column} = ?1")),
                "blobs of {table}.{column} would be deleted as nobody's"
            );
        }
    }
}
