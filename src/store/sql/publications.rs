//! Publications of blobs in a bucket.

use jiff::{SignedDuration, Timestamp};
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

/// Renews a blob's row, or makes it; changes nothing while the blob is being removed by someone who may be alive.
const ANNOUNCE: &str = "
    INSERT INTO publications (digest, bytes, published_at) VALUES (?1, ?2, ?3)
    ON CONFLICT (digest) DO UPDATE SET
        bytes = excluded.bytes,
        removing_since = NULL,
        published_at = CASE WHEN publications.published_at < ?3 THEN ?3 ELSE publications.published_at + 1 END
    WHERE publications.removing_since IS NULL OR publications.removing_since < ?4
    RETURNING id, published_at";

fn removal(row: &Row) -> Result<Removal, StoreError> {
    Ok(Removal { row: row.try_get("id")?, blob: blob(row, "digest")? })
}

impl Publications for SqlStore {
    fn announce(&self, blob: BlobRef) -> StoreFuture<'_, Option<Announcement>> {
        Box::pin(self.write(async move |tx, now| {
            let known = query("SELECT id FROM publications WHERE digest = ?")
                .bind(blob.digest.to_string())
                .fetch_optional(&mut *tx)
                .await?;
            let row = query(ANNOUNCE)
                .bind_all(values![blob.digest.to_string(), signed(blob.bytes), micros(now)])
                .bind(micros(earlier(now, REMOVER_IS_DEAD)))
                .fetch_optional(&mut *tx)
                .await?;
            let Some(row) = row else { return Ok(None) };
            Ok(Some(Announcement { row: row.try_get("id")?, is_new: known.is_none() }))
        }))
    }

    fn confirm(&self, announced: Announcement) -> StoreFuture<'_, Option<Timestamp>> {
        Box::pin(self.write(async move |tx, now| {
            query(
                "UPDATE publications
                 SET published_at = CASE WHEN published_at < ?2 THEN ?2 ELSE published_at + 1 END
                 WHERE id = ?1 AND removing_since IS NULL RETURNING published_at",
            )
            .bind_all(values![announced.row, micros(now)])
            .optional(tx, |row| instant("published_at", row.try_get("published_at")?))
            .await
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
