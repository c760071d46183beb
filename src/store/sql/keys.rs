//! API keys.

use std::num::NonZeroU32;

use super::{
    Store,
    db::{Row, Transaction, query, values},
    exists, lists, locks, projects, rows,
    rows::micros,
};
use crate::{
    domain::{KeyHash, KeyId, ProjectId, Scope},
    store::{KeyChange, KeyProject, KeyRecord, NewKey, StoreError, StoreFuture},
};
use jiff::Timestamp;

/// Adds a key within its caller's transaction, with its project if that is new.
pub(super) async fn insert(
    connection: &mut Transaction,
    new: NewKey,
    now: Timestamp,
) -> Result<KeyRecord, StoreError> {
    let project = match new.project {
        KeyProject::Existing(id) => {
            if !exists(connection, "SELECT 1 FROM projects WHERE id = ?", id).await? {
                return Err(StoreError::NoProject(id));
            }
            id
        }
        KeyProject::New(project) => projects::insert(connection, &project, now).await?.id,
    };
    let row = query(
        "INSERT INTO keys (id, project, name, prefix, hash, scopes, requests_per_minute, expires_at, created_at)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING *",
    )
    .bind_all(values![new.id.to_string(), project.to_string(), &new.name, &new.prefix, new.hash.expose()])
    .bind_all(values![scopes_text(&new.scopes), new.requests_per_minute.map(NonZeroU32::get)])
    .bind_all(values![new.expires_at.map(micros), micros(now)])
    .fetch_one(connection)
    .await?;
    key(&row)
}

impl Store {
    /// Adds a key, with its project if that is new.
    ///
    /// # Errors
    /// [`StoreError::NoProject`].
    pub fn create_key(&self, new: NewKey) -> StoreFuture<'_, KeyRecord> {
        self.call("create_key").run(self.write(async move |tx, now| insert(tx, new, now).await))
    }

    /// Adds a key unless there is one, valid or not; then returns `None`.
    ///
    /// # Errors
    /// [`StoreError::NoProject`].
    pub fn create_first_key(&self, new: NewKey) -> StoreFuture<'_, Option<KeyRecord>> {
        self.call("create_first_key").run(self.write(async move |tx, now| {
            locks::keys(tx).await?;
            let row = query("SELECT 1 FROM keys LIMIT 1").fetch_optional(&mut *tx).await?;
            if row.is_some() { Ok(None) } else { insert(tx, new, now).await.map(Some) }
        }))
    }

    /// A key, revoked or not.
    pub fn key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        let found = query("SELECT * FROM keys WHERE id = ?").bind(id.to_string());
        self.call("key").run(found.optional(&self.readers, key))
    }

    /// Up to `limit` keys of one project or of all, newest first, older than `before`; revoked ones only if they are asked for.
    pub fn keys(
        &self,
        project: Option<ProjectId>,
        with_revoked: bool,
        before: Option<KeyId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<KeyRecord>> {
        self.call("keys").run(lists::keys(project, with_revoked, before, limit).all(&self.readers, key))
    }

    /// Changes a key, and returns it; `None` if there is no such key, or it is revoked.
    pub fn update_key(&self, id: KeyId, change: KeyChange) -> StoreFuture<'_, Option<KeyRecord>> {
        self.call("update_key").run(self.write(async move |tx, _| {
            // In one statement, so that concurrent changes of other fields are kept.
            let mut update = query("UPDATE keys SET name = COALESCE(?, name)").bind(&change.name);
            let rate = change.requests_per_minute.map(|rate| rate.map(NonZeroU32::get));
            update.push_if(", requests_per_minute = ", rate);
            update.push_if(", expires_at = ", change.expires_at.map(|at| at.map(micros)));
            update.push(" WHERE revoked_at IS NULL AND id = ").push_bind(id.to_string()).push(" RETURNING *");
            update.optional(tx, key).await
        }))
    }

    /// Revokes a key from the next request on, and returns it; `None` if there is no such key. No change if it is already
    /// revoked.
    pub fn revoke_key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        self.call("revoke_key").run(self.write(async move |tx, now| {
            query("UPDATE keys SET revoked_at = COALESCE(revoked_at, ?) WHERE id = ? RETURNING *")
                .bind_all(values![micros(now), id.to_string()])
                .optional(tx, key)
                .await
        }))
    }

    /// The key with this hash, unless it is revoked or has expired.
    pub fn authenticate(&self, hash: KeyHash) -> StoreFuture<'_, Option<KeyRecord>> {
        self.call("authenticate").run(async move {
            let now = self.now(&self.readers).await?;
            let row = query(
                "SELECT * FROM keys WHERE hash = ? AND revoked_at IS NULL AND COALESCE(expires_at > ?, true)",
            )
            .bind_all(values![hash.expose(), micros(now)])
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

    /// Whether there is a key, valid or not.
    pub fn has_keys(&self) -> StoreFuture<'_, bool> {
        self.call("has_keys").run(async move {
            let row = query("SELECT EXISTS (SELECT 1 FROM keys) AS found").fetch_one(&self.readers).await?;
            Ok(row.try_get("found")?)
        })
    }

    /// Records a use of the key.
    pub fn touch_key(&self, id: KeyId) -> StoreFuture<'_, ()> {
        self.call("touch_key").run(self.write(async move |tx, now| {
            query("UPDATE keys SET last_used_at = ?1 WHERE id = ?2 AND COALESCE(last_used_at, 0) < ?1")
                .bind_all(values![micros(now), id.to_string()])
                .run(tx)
                .await
        }))
    }
}

fn scopes_text(scopes: &[Scope]) -> String {
    scopes.iter().map(|scope| scope.name()).collect::<Vec<_>>().join(" ")
}

pub(super) fn key(row: &Row) -> Result<KeyRecord, StoreError> {
    let scopes: String = row.try_get("scopes")?;
    let scopes = scopes.split_whitespace().map(str::parse).collect::<Result<Vec<Scope>, String>>();
    Ok(KeyRecord {
        id: rows::parsed("key", row.try_get("id")?)?,
        name: row.try_get("name")?,
        prefix: row.try_get("prefix")?,
        scopes: scopes.map_err(|error| StoreError::Corrupt { what: "scopes", error })?,
        project_id: rows::parsed("project", row.try_get("project")?)?,
        requests_per_minute: rows::optional_integer(row, "requests_per_minute")?.and_then(NonZeroU32::new),
        created_at: rows::instant("created_at", row.try_get("created_at")?)?,
        last_used_at: rows::optional_instant(row, "last_used_at")?,
        expires_at: rows::optional_instant(row, "expires_at")?,
        revoked_at: rows::optional_instant(row, "revoked_at")?,
    })
}
