//! Datasets, in the table `scenes`.

use super::{
    CREATED, Store, accounts,
    db::{Row, Sql, Transaction, query, values},
    idempotency, insert_blob, lists, locks,
    rows::{blob, from_json, instant, integer, json, micros, parsed},
};
use crate::{
    domain::{DatasetId, Digest, ProjectId},
    store::{
        BlobRef, DatasetCreation, DatasetDeletion, DatasetPageKey, DatasetRecord, JobDataset, NewDataset,
        StoreError, StoreFuture,
    },
};
use jiff::Timestamp;

/// HTTP status of the response to a request for a resource that exists already.
const FOUND: u16 = 200;

/// Clears the reference of every job of the scene `?`.
pub(super) const CLEAR_SCENE: &str = "UPDATE jobs SET scene = NULL, version = version + 1 WHERE scene = ?";

/// Deletes the dataset `?1` unless it is kept or has jobs.
pub(super) const REMOVE_UNUSED: &str =
    "DELETE FROM scenes WHERE id = ?1 AND kept = ?2 AND NOT EXISTS (SELECT 1 FROM jobs WHERE scene = ?1)";

/// A row of `scenes` joined with its dataset's `bytes`.
fn dataset(row: &Row) -> Result<DatasetRecord, StoreError> {
    Ok(DatasetRecord {
        id: parsed("id", row.try_get("id")?)?,
        project: parsed("project", row.try_get("project")?)?,
        name: row.try_get("name")?,
        dataset: blob(row, "dataset")?,
        summary: from_json("summary", row.try_get("summary")?)?,
        kept: row.try_get("kept")?,
        version: integer(row, "version")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
    })
}

async fn select(connection: &mut Transaction, id: DatasetId) -> Result<Option<DatasetRecord>, StoreError> {
    query(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset WHERE scenes.id = ?",
    )
    .bind(id.to_string())
    .optional(connection, dataset)
    .await
}

async fn select_by_archive(
    connection: &mut Transaction,
    project: ProjectId,
    archive: Digest,
) -> Result<Option<DatasetRecord>, StoreError> {
    query(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset
         WHERE scenes.dataset = ?1 AND scenes.project = ?2",
    )
    .bind_all(values![archive.to_string(), project.to_string()])
    .optional(connection, dataset)
    .await
}

/// The dataset of the archive that a job came with: the project's, or a new one that nothing but its jobs keeps. The totals of the project
/// are locked.
pub(super) async fn of_job(
    tx: &mut Transaction,
    project: ProjectId,
    archive: BlobRef,
    own: &JobDataset,
    now: Timestamp,
) -> Result<DatasetId, StoreError> {
    if let Some(known) = select_by_archive(tx, project, archive.digest).await? {
        return Ok(known.id);
    }
    insert_blob(tx, archive, now).await?;
    query(
        "INSERT INTO scenes (id, project, dataset, name, summary, created_at, kept) VALUES (?, ?, ?, NULL, ?, ?, ?)",
    )
    .bind_all(values![own.id.to_string(), project.to_string(), archive.digest.to_string()])
    .bind_all(values![json(&own.summary)?, micros(now), false])
    .execute(tx)
    .await?;
    Ok(own.id)
}

/// The dataset of a job, if it still is the archive that its cameras were found in.
pub(super) async fn of_photographs(
    tx: &mut Transaction,
    id: Option<DatasetId>,
    photographs: Digest,
) -> Result<Option<DatasetRecord>, StoreError> {
    let Some(id) = id else { return Ok(None) };
    Ok(select(tx, id).await?.filter(|dataset| dataset.dataset.digest == photographs))
}

/// Deletes a dataset that nothing but its jobs kept, and that has none any more. The totals of its project are locked.
pub(super) async fn remove_unused(tx: &mut Transaction, id: DatasetId) -> Result<(), StoreError> {
    query(REMOVE_UNUSED).bind_all(values![id.to_string(), false]).execute(tx).await?;
    Ok(())
}

/// Keeps a dataset that came with a job, under the name that the request states.
async fn keep(
    tx: &mut Transaction,
    id: DatasetId,
    name: Option<String>,
) -> Result<DatasetRecord, StoreError> {
    query("UPDATE scenes SET kept = ?, name = ?, version = version + 1 WHERE id = ?")
        .bind_all(values![true, name, id.to_string()])
        .execute(&mut *tx)
        .await?;
    select(tx, id).await?.ok_or_else(|| sqlx::Error::RowNotFound.into())
}

impl Store {
    async fn insert_dataset(
        &self,
        tx: &mut Transaction,
        new: NewDataset,
        now: Timestamp,
    ) -> Result<DatasetCreation, StoreError> {
        if let Some(intent) = &new.intent {
            // Before anything is locked: it waits for another request with the same key.
            let (id, keep) = (new.id.to_string(), self.policy.idempotency_ttl);
            idempotency::remember(tx, intent, CREATED, &id, keep, now).await?;
        }
        locks::project(tx, new.project).await?;
        let known = select_by_archive(tx, new.project, new.dataset.digest).await?;
        let id = known.as_ref().map_or(new.id, |known| known.id);
        if known.is_none() {
            // The bytes reserved for the upload become the dataset's.
            if let Some(upload) = new.upload {
                query("UPDATE uploads SET ended_at = ? WHERE id = ? AND ended_at IS NULL")
                    .bind_all(values![micros(now), upload.to_string()])
                    .execute(&mut *tx)
                    .await?;
            }
            accounts::admit_blob(tx, self.policy.limits.quota_bytes, new.project, new.dataset).await?;
            insert_blob(tx, new.dataset, now).await?;
            query(
                "INSERT INTO scenes (id, project, dataset, name, summary, created_at) VALUES (?, ?, ?, ?, ?, ?)",
            )
            .bind_all(values![id.to_string(), new.project.to_string(), new.dataset.digest.to_string()])
            .bind_all(values![&new.name, json(&new.summary)?, micros(now)])
            .execute(&mut *tx)
            .await?;
        }
        if let Some(upload) = new.upload {
            query("UPDATE uploads SET ended_at = COALESCE(ended_at, ?), scene = ? WHERE id = ?")
                .bind_all(values![micros(now), id.to_string(), upload.to_string()])
                .execute(&mut *tx)
                .await?;
        }
        if let (Some(intent), Some(known)) = (&new.intent, &known) {
            let status = if known.kept { FOUND } else { CREATED };
            idempotency::amend(tx, intent, status, &id.to_string()).await?;
        }
        Ok(match known {
            Some(known) if known.kept => DatasetCreation::Existing(known),
            Some(known) => DatasetCreation::Created(keep(tx, known.id, new.name).await?),
            None => DatasetCreation::Created(select(tx, id).await?.ok_or(sqlx::Error::RowNotFound)?),
        })
    }

    /// Adds a dataset, unless its project has one with the same archive. One that came with a job is kept from then on.
    ///
    /// # Errors
    /// [`StoreError::QuotaExceeded`], [`StoreError::IdempotencyKeyUsed`].
    pub fn create_dataset(&self, new: NewDataset) -> StoreFuture<'_, DatasetCreation> {
        self.create("create_dataset", |store| {
            Box::pin(store.write(async move |tx, now| store.insert_dataset(tx, new, now).await))
        })
    }

    /// The dataset.
    pub fn dataset(&self, id: DatasetId) -> StoreFuture<'_, Option<DatasetRecord>> {
        self.call("dataset").run(self.read(async move |tx| select(tx, id).await))
    }

    /// The dataset of the project with this archive.
    pub fn dataset_by_archive(
        &self,
        project: ProjectId,
        archive: Digest,
    ) -> StoreFuture<'_, Option<DatasetRecord>> {
        self.call("dataset_by_archive")
            .run(self.read(async move |tx| select_by_archive(tx, project, archive).await))
    }

    /// Up to `limit` datasets of one project or of all, newest first, older than `before`.
    pub fn datasets(
        &self,
        project: Option<ProjectId>,
        before: Option<DatasetPageKey>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DatasetRecord>> {
        self.call("datasets").run(lists::datasets(project, before, limit).all(&self.readers, dataset))
    }

    /// Deletes the dataset if it has the requested version and no queued or running job trains on it; `None` if there is no such
    /// dataset. Finished jobs keep its archive.
    pub fn delete_dataset(
        &self,
        id: DatasetId,
        version: Option<u64>,
    ) -> StoreFuture<'_, Option<DatasetDeletion>> {
        self.call("delete_dataset").run(self.write(async move |tx, _| {
            locks::projects(tx, "SELECT project FROM scenes WHERE id = ", id.to_string()).await?;
            let Some(record) = select(tx, id).await? else { return Ok(None) };
            if version.is_some_and(|version| version != record.version) {
                return Ok(Some(DatasetDeletion::VersionMismatch));
            }
            let row = query(Sql {
                sqlite: "SELECT COUNT(*) AS active FROM jobs INDEXED BY jobs_active_by_scene
                 WHERE scene = ? AND state IN ('queued', 'running')",
                postgres: "SELECT COUNT(*) AS active FROM jobs WHERE scene = ? AND state IN ('queued', 'running')",
            })
            .bind(id.to_string())
            .fetch_one(&mut *tx)
            .await?;
            let active: u64 = integer(&row, "active")?;
            if active > 0 {
                return Ok(Some(DatasetDeletion::InUse(active)));
            }
            // The schema would clear the reference too, but not raise the version of those rows.
            query(CLEAR_SCENE).bind(id.to_string()).execute(&mut *tx).await?;
            query("DELETE FROM scenes WHERE id = ?").bind(id.to_string()).execute(tx).await?;
            Ok(Some(DatasetDeletion::Deleted))
        }))
    }
}
