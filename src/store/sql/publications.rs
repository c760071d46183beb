//! Publications of blobs in a bucket.

use jiff::SignedDuration;
use uuid::Uuid;

use super::{
    Store,
    db::{Row, query, values},
    rows::{blob, instant, micros, parsed, signed},
};
use crate::{
    domain::Digest,
    store::{
        BlobPlace, BlobRef, StoreError, StoreFuture, earlier,
        publications::{Announcement, REMOVER_IS_DEAD, Removable, Removal},
    },
};

/// Makes a blob's row unless there is one.
const ANNOUNCE_NEW: &str = "
    INSERT INTO publications (digest, bytes, published_at) VALUES (?1, ?2, ?3)
    ON CONFLICT (digest) DO NOTHING
    RETURNING id, published_at";

/// Renews a blob's row; changes nothing while the blob is being removed by someone who may be alive.
const ANNOUNCE_AGAIN: &str = "
    UPDATE publications SET
        bytes = ?2,
        removing_since = NULL,
        published_at = CASE WHEN published_at < ?3 THEN ?3 ELSE published_at + 1 END
    WHERE digest = ?1 AND (removing_since IS NULL OR removing_since < ?4)
    RETURNING id, published_at";

/// Renews the row `?1` unless another publisher has since `?3`.
const CONFIRM_ONLY: &str = "
    UPDATE publications
    SET published_at = CASE WHEN published_at < ?2 THEN ?2 ELSE published_at + 1 END
    WHERE id = ?1 AND removing_since IS NULL AND published_at = ?3
    RETURNING id, published_at";

/// Renews the row `?1`.
const CONFIRM: &str = "
    UPDATE publications
    SET published_at = CASE WHEN published_at < ?2 THEN ?2 ELSE published_at + 1 END
    WHERE id = ?1 AND removing_since IS NULL
    RETURNING id, published_at";

/// Reads an announcement of a blob that nobody else has published if `is_new`.
fn announcement(is_new: bool) -> impl Fn(&Row) -> Result<Announcement, StoreError> {
    move |row| {
        let published_at = instant("published_at", row.try_get("published_at")?)?;
        Ok(Announcement { row: row.try_get("id")?, is_new, published_at })
    }
}

fn removal(row: &Row) -> Result<Removal, StoreError> {
    Ok(Removal { row: row.try_get("id")?, blob: blob(row, "digest")? })
}

impl Store {
    /// Records that a blob is published now; `None` while its object is being deleted.
    pub fn announce(&self, blob: BlobRef) -> StoreFuture<'_, Option<Announcement>> {
        self.call("announce").run(self.write(async move |tx, now| {
            let row = values![blob.digest.to_string(), signed(blob.bytes), micros(now)];
            let new =
                query(ANNOUNCE_NEW).bind_all(row.clone()).optional(&mut *tx, announcement(true)).await?;
            if new.is_some() {
                return Ok(new);
            }
            query(ANNOUNCE_AGAIN)
                .bind_all(row)
                .bind(micros(earlier(now, REMOVER_IS_DEAD)))
                .optional(tx, announcement(false))
                .await
        }))
    }

    /// Renews an announced publication, which is not new any more if another publisher has announced or renewed the blob since; `None` if it
    /// was removed since, and has to be announced again.
    pub fn confirm(&self, announced: Announcement) -> StoreFuture<'_, Option<Announcement>> {
        self.call("confirm").run(self.write(async move |tx, now| {
            let row = values![announced.row, micros(now)];
            let only = query(CONFIRM_ONLY)
                .bind_all(row.clone())
                .bind(micros(announced.published_at))
                .optional(&mut *tx, announcement(announced.is_new))
                .await?;
            if only.is_some() {
                return Ok(only);
            }
            query(CONFIRM).bind_all(row).optional(tx, announcement(false)).await
        }))
    }

    /// Up to `limit` blobs after `after`, in the order of their digests, that were last published longer ago than `age`.
    pub fn older_publications(
        &self,
        age: SignedDuration,
        after: Option<Digest>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<Digest>> {
        self.call("older_publications").run(self.read(async move |tx| {
            let now = self.now(&mut *tx).await?;
            query(
                "SELECT digest FROM publications
                 WHERE digest > ? AND published_at < ? AND removing_since IS NULL ORDER BY digest LIMIT ?",
            )
            .bind(after.map(|digest| digest.to_string()).unwrap_or_default())
            .bind_all(values![micros(earlier(now, age)), limit])
            .all(tx, |row| parsed("digest", row.try_get("digest")?))
            .await
        }))
    }

    /// Whether any blob is, or may be, in the bucket.
    pub fn has_publications(&self) -> StoreFuture<'_, bool> {
        let first = query("SELECT 1 FROM publications LIMIT 1");
        self.call("has_publications")
            .run(async move { Ok(first.optional(&self.readers, |_| Ok(())).await?.is_some()) })
    }

    /// Marks a blob for removal; `None` if there is no such publication, or another removes it.
    pub fn begin_removal(&self, digest: Digest, which: Removable) -> StoreFuture<'_, Option<Removal>> {
        self.call("begin_removal").run(self.write(async move |tx, now| {
            let (first, last) = match which {
                Removable::OlderThan(age) => (i64::MIN, micros(earlier(now, age)).saturating_sub(1)),
                Removable::PublishedAt(at) => (micros(at), micros(at)),
            };
            query(
                "UPDATE publications SET removing_since = ?2
                 WHERE digest = ?1 AND removing_since IS NULL AND published_at BETWEEN ?3 AND ?4
                 RETURNING id, digest, bytes",
            )
            .bind_all(values![digest.to_string(), micros(now), first, last])
            .optional(tx, removal)
            .await
        }))
    }

    /// Takes over what dead removers have left.
    pub fn abandoned_removals(&self) -> StoreFuture<'_, Vec<Removal>> {
        self.call("abandoned_removals").run(self.write(async move |tx, now| {
            query(
                "UPDATE publications SET removing_since = ?1 WHERE removing_since < ?2
                 RETURNING id, digest, bytes",
            )
            .bind_all(values![micros(now), micros(earlier(now, REMOVER_IS_DEAD))])
            .all(tx, removal)
            .await
        }))
    }

    /// Forgets a blob whose object is deleted.
    pub fn end_removal(&self, removal: Removal) -> StoreFuture<'_, ()> {
        self.call("end_removal").run(self.write(async move |tx, _| {
            query("DELETE FROM publications WHERE id = ? AND removing_since IS NOT NULL")
                .bind(removal.row)
                .run(tx)
                .await
        }))
    }

    /// Decides where the database's blobs are, once and for all, and returns its identity.
    ///
    /// # Errors
    /// [`StoreError::BlobsInFolder`] or [`StoreError::BlobsInBucket`] if that was decided otherwise.
    pub fn claim_place(&self, place: BlobPlace) -> StoreFuture<'_, String> {
        self.call("claim_place").run(self.write(async move |tx, _| {
            query("UPDATE blob_place SET place = ? WHERE place IS NULL")
                .bind(place.as_str())
                .execute(&mut *tx)
                .await?;
            let row = query("SELECT id, place FROM blob_place").fetch_one(tx).await?;
            let found: String = row.try_get("place")?;
            match place {
                _ if found == place.as_str() => Ok(row.try_get("id")?),
                BlobPlace::Bucket => Err(StoreError::BlobsInFolder),
                BlobPlace::Folder => Err(StoreError::BlobsInBucket),
            }
        }))
    }

    /// Decides anew where a copy of a database has its blobs, which are to be published there, and gives the copy an identity of its own,
    /// so that the bucket of the original refuses it.
    pub fn move_blobs(&self, place: BlobPlace) -> StoreFuture<'_, ()> {
        self.call("move_blobs").run(self.write(async move |tx, _| {
            query("UPDATE blob_place SET id = ?, place = ?")
                .bind_all(values![Uuid::now_v7().simple().to_string(), place.as_str()])
                .execute(&mut *tx)
                .await?;
            query("DELETE FROM publications").run(tx).await
        }))
    }
}
