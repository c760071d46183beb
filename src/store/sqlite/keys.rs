//! API keys.

use std::num::NonZeroU32;

use sqlx::{Row as _, sqlite::SqliteRow};

use super::{SqliteStore, rows, rows::micros};
use crate::{
    domain::{KeyHash, KeyId, KeyLimits, Scope},
    store::{KeyRecord, Keys, NewKey, StoreError, StoreFuture},
};

impl Keys for SqliteStore {
    fn create_key(&self, new: NewKey) -> StoreFuture<'_, KeyRecord> {
        Box::pin(self.write(async move |tx, now| {
            let row = sqlx::query(
                "INSERT INTO keys (id, name, prefix, hash, scopes, max_bytes, max_active_jobs, requests_per_minute,
                     max_priority, created_at)
                 VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING *",
            )
            .bind(new.id.to_string())
            .bind(&new.name)
            .bind(&new.prefix)
            .bind(new.hash.expose())
            .bind(scopes_text(&new.scopes))
            // SQLite has no larger integer, and no disk holds more.
            .bind(new.limits.quota_bytes.map(|bytes| i64::try_from(bytes).unwrap_or(i64::MAX)))
            .bind(new.limits.max_active_jobs)
            .bind(new.limits.requests_per_minute.map(NonZeroU32::get))
            .bind(new.limits.max_priority)
            .bind(micros(now))
            .fetch_one(tx)
            .await?;
            key(&row)
        }))
    }

    fn key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        Box::pin(async move {
            let row = sqlx::query("SELECT * FROM keys WHERE id = ?")
                .bind(id.to_string())
                .fetch_optional(&self.readers)
                .await?;
            row.as_ref().map(key).transpose()
        })
    }

    fn keys(&self, with_revoked: bool, before: Option<KeyId>, limit: u32) -> StoreFuture<'_, Vec<KeyRecord>> {
        Box::pin(async move {
            let rows = sqlx::query(
                "SELECT * FROM keys WHERE (?1 OR revoked_at IS NULL) AND (?2 IS NULL OR id < ?2)
                 ORDER BY id DESC LIMIT ?3",
            )
            .bind(with_revoked)
            .bind(before.map(|id| id.to_string()))
            .bind(limit)
            .fetch_all(&self.readers)
            .await?;
            rows.iter().map(key).collect()
        })
    }

    fn revoke_key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        Box::pin(self.write(async move |tx, now| {
            let row =
                sqlx::query("UPDATE keys SET revoked_at = COALESCE(revoked_at, ?) WHERE id = ? RETURNING *")
                    .bind(micros(now))
                    .bind(id.to_string())
                    .fetch_optional(tx)
                    .await?;
            row.as_ref().map(key).transpose()
        }))
    }

    fn authenticate(&self, hash: KeyHash) -> StoreFuture<'_, Option<KeyRecord>> {
        Box::pin(async move {
            let row = sqlx::query("SELECT * FROM keys WHERE hash = ? AND revoked_at IS NULL")
                .bind(hash.expose())
                .fetch_optional(&self.readers)
                .await?;
            let Some(row) = row else { return Ok(None) };
            // An index compares only up to the first difference; the whole hash is compared in constant time.
            if !hash.is(row.try_get("hash")?) {
                return Ok(None);
            }
            key(&row).map(Some)
        })
    }

    fn has_keys(&self) -> StoreFuture<'_, bool> {
        Box::pin(async move {
            let row =
                sqlx::query("SELECT EXISTS (SELECT 1 FROM keys) AS found").fetch_one(&self.readers).await?;
            Ok(row.try_get("found")?)
        })
    }

    fn touch_key(&self, id: KeyId) -> StoreFuture<'_, ()> {
        Box::pin(self.write(async move |tx, now| {
            sqlx::query("UPDATE keys SET last_used_at = MAX(COALESCE(last_used_at, 0), ?) WHERE id = ?")
                .bind(micros(now))
                .bind(id.to_string())
                .execute(tx)
                .await?;
            Ok(())
        }))
    }
}

fn scopes_text(scopes: &[Scope]) -> String {
    scopes.iter().map(|scope| scope.name()).collect::<Vec<_>>().join(" ")
}

fn key(row: &SqliteRow) -> Result<KeyRecord, StoreError> {
    let scopes: String = row.try_get("scopes")?;
    let scopes = scopes.split_whitespace().map(str::parse).collect::<Result<Vec<Scope>, String>>();
    Ok(KeyRecord {
        id: rows::parsed("key", row.try_get("id")?)?,
        name: row.try_get("name")?,
        prefix: row.try_get("prefix")?,
        scopes: scopes.map_err(|fault| StoreError::Corrupt { what: "scopes", fault })?,
        limits: KeyLimits {
            quota_bytes: rows::optional_unsigned(row, "max_bytes")?,
            max_active_jobs: rows::optional_unsigned(row, "max_active_jobs")?,
            requests_per_minute: rows::optional_unsigned(row, "requests_per_minute")?
                .and_then(NonZeroU32::new),
            max_priority: row.try_get("max_priority")?,
        },
        created_at: rows::instant("created_at", row.try_get("created_at")?)?,
        last_used_at: rows::optional_instant(row, "last_used_at")?,
        revoked_at: rows::optional_instant(row, "revoked_at")?,
    })
}
