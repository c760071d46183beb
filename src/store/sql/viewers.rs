//! Viewers.

use std::time::Duration;

use super::{
    Store,
    db::{Row, query, values},
    rows::{before, micros},
};
use crate::{
    domain::ViewerToken,
    store::{StoreError, StoreFuture, VIEWER_LIFE, ViewerRecord},
};

/// Age of a row that is of no use any more.
const FORGOTTEN: Duration = Duration::from_secs(3600);

fn viewer(row: &Row) -> Result<ViewerRecord, StoreError> {
    Ok(ViewerRecord {
        url: row.try_get("url")?,
        version: row.try_get("version")?,
        identity: row.try_get("identity")?,
        token: ViewerToken::stored(row.try_get("token")?),
    })
}

impl Store {
    /// Records that a viewer is alive now, and forgets those that were not for an hour.
    pub fn announce_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()> {
        self.call("announce_viewer").run(self.write(async move |tx, now| {
            query(
                "INSERT INTO viewers (url, version, identity, token, seen_at) VALUES (?, ?, ?, ?, ?)
                 ON CONFLICT (url) DO UPDATE SET version = excluded.version, identity = excluded.identity,
                     token = excluded.token, seen_at = excluded.seen_at",
            )
            .bind_all(values![viewer.url.as_str(), viewer.version.as_str(), viewer.identity.as_str()])
            .bind_all(values![viewer.token.expose(), micros(now)])
            .execute(&mut *tx)
            .await?;
            query("DELETE FROM viewers WHERE seen_at < ?").bind(micros(before(now, FORGOTTEN))).run(tx).await
        }))
    }

    /// The viewers that were announced within [`VIEWER_LIFE`], by their URLs.
    pub fn live_viewers(&self) -> StoreFuture<'_, Vec<ViewerRecord>> {
        self.call("live_viewers").run(self.read(async move |tx| {
            let now = self.now(&mut *tx).await?;
            query("SELECT url, version, identity, token FROM viewers WHERE seen_at >= ? ORDER BY url")
                .bind(micros(before(now, VIEWER_LIFE)))
                .all(tx, viewer)
                .await
        }))
    }

    /// Forgets a viewer that stops, unless another process has taken its URL over.
    pub fn withdraw_viewer<'a>(&'a self, viewer: &'a ViewerRecord) -> StoreFuture<'a, ()> {
        self.call("withdraw_viewer").run(self.write(async move |tx, _| {
            query("DELETE FROM viewers WHERE url = ? AND token = ?")
                .bind_all(values![viewer.url.as_str(), viewer.token.expose()])
                .run(tx)
                .await
        }))
    }
}
