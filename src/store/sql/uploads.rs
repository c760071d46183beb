//! Uploads.

use jiff::Timestamp;

use super::{
    MEMBERS, Store, accounts,
    db::{Row, Transaction, query, values},
    locks,
    rows::{instant, integer, json, micros, optional_instant, optional_parsed, parsed},
};
use crate::{
    domain::{ProjectId, UploadId},
    store::{
        NewUpload, StoreError, StoreFuture, UploadRecord,
        uploads::{MAX_OPEN_UPLOADS, UploadWriter, WRITER_LIFE},
    },
};

/// Uploads per transaction of garbage collection, so that other writers never wait for long.
const BATCH: u32 = 100;

fn upload(row: &Row) -> Result<UploadRecord, StoreError> {
    Ok(UploadRecord {
        id: upload_id(row)?,
        project: parsed("project", row.try_get("project")?)?,
        length: integer(row, "length")?,
        received: integer(row, "received")?,
        metadata: row.try_get("metadata")?,
        dataset_id: optional_parsed(row, "scene")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
        expires_at: instant("expires_at", row.try_get("expires_at")?)?,
        ended_at: optional_instant(row, "ended_at")?,
    })
}

fn upload_id(row: &Row) -> Result<UploadId, StoreError> {
    parsed("id", row.try_get("id")?)
}

/// The start and the name of a row of `upload_parts`.
fn part(row: &Row) -> Result<(u64, String), StoreError> {
    Ok((integer(row, "start")?, row.try_get("name")?))
}

/// A count of bytes as columns hold it.
fn column(what: &'static str, bytes: u64) -> Result<i64, StoreError> {
    i64::try_from(bytes).map_err(|_| StoreError::Corrupt { what, error: bytes.to_string() })
}

async fn select(connection: &mut Transaction, id: UploadId) -> Result<Option<UploadRecord>, StoreError> {
    query("SELECT * FROM uploads WHERE id = ?").bind(id.to_string()).optional(connection, upload).await
}

/// Refuses another upload of a project that has as many open ones as it may: they may all be empty, and take none of the quota.
async fn expect_room(tx: &mut Transaction, project: ProjectId) -> Result<(), StoreError> {
    let row = query("SELECT count(*) AS open FROM uploads WHERE project = ? AND ended_at IS NULL")
        .bind(project.to_string())
        .fetch_one(tx)
        .await?;
    let open: u32 = integer(&row, "open")?;
    if open < MAX_OPEN_UPLOADS { Ok(()) } else { Err(StoreError::TooManyUploads { open }) }
}

/// Ends up to [`BATCH`] uploads that expire before `now`.
async fn expire_some(tx: &mut Transaction, now: Timestamp) -> Result<Vec<UploadId>, StoreError> {
    let due: Vec<UploadId> = query(
        "SELECT id FROM uploads WHERE ended_at IS NULL AND expires_at <= ? ORDER BY expires_at LIMIT ?",
    )
    .bind_all(values![micros(now), BATCH])
    .all(&mut *tx, upload_id)
    .await?;
    if due.is_empty() {
        return Ok(due);
    }
    locks::uploads(tx, &due).await?;
    let mut ended =
        query("UPDATE uploads SET ended_at = ? WHERE ended_at IS NULL AND expires_at <= ? AND id IN ");
    ended.push(MEMBERS).push(" RETURNING id");
    ended.bind_all(values![micros(now), micros(now), json(&due)?]).all(tx, upload_id).await
}

impl Store {
    /// Starts an upload and reserves its bytes.
    ///
    /// # Errors
    /// [`StoreError::QuotaExceeded`], [`StoreError::TooManyUploads`].
    pub fn create_upload(&self, new: NewUpload) -> StoreFuture<'_, UploadRecord> {
        self.call("create_upload").run(self.write(async move |tx, now| {
            locks::project(tx, new.project).await?;
            expect_room(tx, new.project).await?;
            accounts::admit(tx, self.policy.limits.quota_bytes, new.project, new.length).await?;
            query(
                "INSERT INTO uploads (id, project, length, metadata, created_at, expires_at) VALUES (?, ?, ?, ?, ?, ?)",
            )
            .bind_all(values![new.id.to_string(), new.project.to_string()])
            .bind_all(values![column("upload length", new.length)?, &new.metadata, micros(now)])
            .bind(micros(new.expires_at))
            .execute(&mut *tx)
            .await?;
            Ok(select(tx, new.id).await?.ok_or(sqlx::Error::RowNotFound)?)
        }))
    }

    /// The upload.
    pub fn upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadRecord>> {
        self.call("upload").run(self.read(async move |tx| select(tx, id).await))
    }

    /// Records that `received` bytes are on disk, and extends the expiry; false if the upload has ended. The caller holds the lock of the
    /// upload's file, so the count has one writer.
    pub fn advance_upload(
        &self,
        id: UploadId,
        received: u64,
        expires_at: Timestamp,
    ) -> StoreFuture<'_, bool> {
        self.call("advance_upload").run(self.write(async move |tx, _| {
            let done =
                query("UPDATE uploads SET received = ?, expires_at = ? WHERE id = ? AND ended_at IS NULL")
                    .bind_all(values![column("upload offset", received)?, micros(expires_at), id.to_string()])
                    .execute(tx)
                    .await?;
            Ok(done == 1)
        }))
    }

    /// Deletes an open upload and releases its bytes; false if there is none.
    pub fn delete_upload(&self, id: UploadId) -> StoreFuture<'_, bool> {
        self.call("delete_upload").run(self.write(async move |tx, _| {
            locks::projects(tx, "SELECT project FROM uploads WHERE id = ", id.to_string()).await?;
            let done = query("DELETE FROM uploads WHERE id = ? AND ended_at IS NULL")
                .bind(id.to_string())
                .execute(tx)
                .await?;
            Ok(done == 1)
        }))
    }

    /// Bytes of open uploads that are still to be received.
    pub fn outstanding_bytes(&self) -> StoreFuture<'_, u64> {
        self.call("outstanding_bytes").run(async move {
            let row = query(
                "SELECT CAST(COALESCE(SUM(length - received), 0) AS BIGINT) AS bytes FROM uploads WHERE ended_at IS NULL",
            )
            .fetch_one(&self.readers)
            .await?;
            integer(&row, "bytes")
        })
    }

    /// Ends the expired uploads and returns them. Deletes the rows of uploads that ended before `forget`.
    pub fn expire_uploads(&self, forget: Timestamp) -> StoreFuture<'_, Vec<UploadId>> {
        self.call("expire_uploads").run(async move {
            // This is called at intervals, by whoever collects garbage.
            self.fold_changes().await?;
            let mut expired = Vec::new();
            loop {
                let some = self.write(async move |tx, now| expire_some(tx, now).await).await?;
                if some.is_empty() {
                    break;
                }
                expired.extend(some);
            }
            let forget_some = async || {
                self.write(async move |tx, _| {
                    let some =
                        "DELETE FROM uploads WHERE id IN (SELECT id FROM uploads WHERE ended_at < ? LIMIT ?)";
                    Ok(query(some).bind_all(values![micros(forget), BATCH]).execute(tx).await?)
                })
                .await
            };
            while forget_some().await? > 0 {}
            Ok(expired)
        })
    }

    /// Every open upload: their files must stay.
    pub fn open_uploads(&self) -> StoreFuture<'_, Vec<UploadId>> {
        self.call("open_uploads")
            .run(query("SELECT id FROM uploads WHERE ended_at IS NULL").all(&self.readers, upload_id))
    }
}

/// When a lock that is renewed now ends.
fn lock_end(now: Timestamp) -> i64 {
    micros(now.checked_add(WRITER_LIFE).unwrap_or(Timestamp::MAX))
}

impl Store {
    /// Locks an upload for a new writer; `None` if another has locked it, or there is none.
    pub fn lock_upload(&self, id: UploadId) -> StoreFuture<'_, Option<UploadWriter>> {
        self.call("lock_upload").run(self.write(async move |tx, now| {
            query(
                "UPDATE uploads SET writer = writer + 1, writer_until = ?2
                 WHERE id = ?1 AND (writer_until IS NULL OR writer_until < ?3 OR writer_until > ?4) RETURNING writer",
            )
            .bind_all(values![id.to_string(), lock_end(now), micros(now)])
            // No lock ends so late, unless the clock was set back. Another may have been taken a moment after this one's time.
            .bind(micros(now.checked_add(WRITER_LIFE * 2).unwrap_or(Timestamp::MAX)))
            .optional(tx, |row| Ok(UploadWriter { id, number: row.try_get("writer")? }))
            .await
        }))
    }

    /// Renews a writer's lock; false if it has lost it.
    pub fn renew_upload_lock(&self, writer: UploadWriter) -> StoreFuture<'_, bool> {
        self.call("renew_upload_lock").run(self.write(async move |tx, now| {
            let done = query(
                "UPDATE uploads SET writer_until = ? WHERE id = ? AND writer = ? AND writer_until IS NOT NULL",
            )
            .bind_all(values![lock_end(now), writer.id.to_string(), writer.number])
            .execute(tx)
            .await?;
            Ok(done == 1)
        }))
    }

    /// Releases a writer's lock, if it has it.
    pub fn unlock_upload(&self, writer: UploadWriter) -> StoreFuture<'_, ()> {
        self.call("unlock_upload").run(self.write(async move |tx, _| {
            query("UPDATE uploads SET writer_until = NULL WHERE id = ? AND writer = ?")
                .bind_all(values![writer.id.to_string(), writer.number])
                .run(tx)
                .await
        }))
    }

    /// Records a part from byte `start` to byte `received`, and extends the expiry; false if the upload has ended or the writer has lost
    /// the lock.
    pub fn add_upload_part<'a>(
        &'a self,
        writer: UploadWriter,
        start: u64,
        name: &'a str,
        received: u64,
        expires_at: Timestamp,
    ) -> StoreFuture<'a, bool> {
        self.call("add_upload_part").run(self.write(async move |tx, now| {
            let done = query(
                "UPDATE uploads SET received = ?1, expires_at = ?2, writer_until = ?3
                 WHERE id = ?4 AND writer = ?5 AND writer_until IS NOT NULL AND ended_at IS NULL",
            )
            .bind_all(values![column("upload offset", received)?, micros(expires_at), lock_end(now)])
            .bind_all(values![writer.id.to_string(), writer.number])
            .execute(&mut *tx)
            .await?;
            if done == 0 {
                return Ok(false);
            }
            if received > start {
                query("INSERT INTO upload_parts (upload, start, name) VALUES (?, ?, ?)")
                    .bind_all(values![writer.id.to_string(), column("upload offset", start)?, name])
                    .execute(tx)
                    .await?;
            }
            Ok(true)
        }))
    }

    /// Whether there is such an upload, open or ended.
    pub fn is_upload(&self, id: UploadId) -> StoreFuture<'_, bool> {
        self.call("is_upload").run(self.read(async move |tx| Ok(select(tx, id).await?.is_some())))
    }

    /// The starts and names of an upload's parts, in order.
    pub fn upload_parts(&self, id: UploadId) -> StoreFuture<'_, Vec<(u64, String)>> {
        let parts = query("SELECT start, name FROM upload_parts WHERE upload = ? ORDER BY start");
        self.call("upload_parts").run(parts.bind(id.to_string()).all(&self.readers, part))
    }
}
