//! Publications of blobs in a bucket.

use jiff::SignedDuration;
use uuid::Uuid;

use super::{
    SqlStore,
    db::{Row, query, values},
    rows::{blob, instant, micros, parsed, signed},
};
use crate::{
    domain::Digest,
    store::{
        BlobPlace, BlobRef, StoreError, StoreFuture,
        blobs::earlier,
        publications::{Announcement, Publications, REMOVER_IS_DEAD, Removable, Removal},
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

impl Publications for SqlStore {
    fn announce(&self, blob: BlobRef) -> StoreFuture<'_, Option<Announcement>> {
        Box::pin(self.write(async move |tx, now| {
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

    fn confirm(&self, announced: Announcement) -> StoreFuture<'_, Option<Announcement>> {
        Box::pin(self.write(async move |tx, now| {
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

    fn older_publications(
        &self,
        age: SignedDuration,
        after: Option<Digest>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<Digest>> {
        Box::pin(self.read(async move |tx| {
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

    fn has_publications(&self) -> StoreFuture<'_, bool> {
        let first = query("SELECT 1 FROM publications LIMIT 1");
        Box::pin(async move { Ok(first.optional(&self.readers, |_| Ok(())).await?.is_some()) })
    }

    fn begin_removal(&self, digest: Digest, which: Removable) -> StoreFuture<'_, Option<Removal>> {
        Box::pin(self.write(async move |tx, now| {
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

    fn abandoned_removals(&self) -> StoreFuture<'_, Vec<Removal>> {
        Box::pin(self.write(async move |tx, now| {
            query(
                "UPDATE publications SET removing_since = ?1 WHERE removing_since < ?2
                 RETURNING id, digest, bytes",
            )
            .bind_all(values![micros(now), micros(earlier(now, REMOVER_IS_DEAD))])
            .all(tx, removal)
            .await
        }))
    }

    fn end_removal(&self, removal: Removal) -> StoreFuture<'_, ()> {
        Box::pin(self.write(async move |tx, _| {
            query("DELETE FROM publications WHERE id = ? AND removing_since IS NOT NULL")
                .bind(removal.row)
                .run(tx)
                .await
        }))
    }

    fn claim_place(&self, place: BlobPlace) -> StoreFuture<'_, String> {
        Box::pin(self.write(async move |tx, _| {
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

    fn move_blobs(&self, place: BlobPlace) -> StoreFuture<'_, ()> {
        Box::pin(self.write(async move |tx, _| {
            query("UPDATE blob_place SET id = ?, place = ?")
                .bind_all(values![Uuid::now_v7().simple().to_string(), place.as_str()])
                .execute(&mut *tx)
                .await?;
            query("DELETE FROM publications").run(tx).await
        }))
    }
}
