//! Sessions of browsers, which stand for keys.

use super::{
    Store,
    db::{query, values},
    keys,
    rows::micros,
};
use crate::{
    domain::KeyHash,
    store::{KeyRecord, NewSession, SESSIONS_PER_KEY, StoreFuture},
};

/// The oldest sessions of a key beyond the newest so many.
const SURPLUS: &str = "DELETE FROM sessions WHERE hash IN
    (SELECT hash FROM sessions WHERE key_id = ? ORDER BY created_at DESC, hash LIMIT 1000 OFFSET ?)";

impl Store {
    /// Adds a session. Removes those that have expired, and the oldest of its key beyond [`SESSIONS_PER_KEY`].
    pub fn create_session(&self, new: NewSession) -> StoreFuture<'_, ()> {
        self.call("create_session").run(self.write(async move |tx, now| {
            query("DELETE FROM sessions WHERE expires_at <= ?").bind(micros(now)).run(&mut *tx).await?;
            let key = new.key.to_string();
            query("INSERT INTO sessions (hash, key_id, created_at, expires_at) VALUES (?, ?, ?, ?)")
                .bind_all(values![new.hash.expose(), &key, micros(now), micros(new.expires_at)])
                .run(&mut *tx)
                .await?;
            query(SURPLUS).bind_all(values![&key, SESSIONS_PER_KEY]).run(tx).await
        }))
    }

    /// The key of a session, unless the session or the key has ended.
    pub fn session_key(&self, hash: KeyHash) -> StoreFuture<'_, Option<KeyRecord>> {
        self.call("session_key").run(async move {
            let now = self.now(&self.readers).await?;
            let row = query(
                "SELECT keys.*, sessions.hash AS session FROM sessions JOIN keys ON keys.id = sessions.key_id
                 WHERE sessions.hash = ?1 AND sessions.expires_at > ?2 AND keys.revoked_at IS NULL
                     AND COALESCE(keys.expires_at > ?2, true)",
            )
            .bind_all(values![hash.expose(), micros(now)])
            .fetch_optional(&self.readers)
            .await?;
            let Some(row) = row else { return Ok(None) };
            // As for keys, the whole hash is compared in constant time.
            if !hash.is(row.try_get("session")?) {
                return Ok(None);
            }
            keys::key(&row).map(Some)
        })
    }

    /// Ends a session, if there is one.
    pub fn delete_session(&self, hash: KeyHash) -> StoreFuture<'_, ()> {
        self.call("delete_session").run(self.write(async move |tx, _| {
            query("DELETE FROM sessions WHERE hash = ?").bind(hash.expose()).run(tx).await
        }))
    }
}
