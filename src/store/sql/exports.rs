//! Exports, and files by their hash.

use super::{
    Store, accounts,
    db::{Transaction, query, values},
    insert_blob, locks,
    rows::{self, micros},
};
use crate::{
    domain::{Digest, JobId, ProjectId},
    store::{ExportRecord, FileRecord, StoreError, StoreFuture},
};
use jiff::Timestamp;

async fn of_job(connection: &mut Transaction, job: JobId) -> Result<Vec<ExportRecord>, StoreError> {
    query(
        "SELECT exports.*, blobs.bytes FROM exports JOIN blobs ON blobs.digest = exports.digest WHERE job_id = ?
         ORDER BY created_at, source, format",
    )
    .bind(job.to_string())
    .all(connection, rows::export)
    .await
}

/// The job's project, if there is such a job.
async fn project_of(connection: &mut Transaction, job: JobId) -> Result<Option<ProjectId>, StoreError> {
    let row = query("SELECT project FROM jobs WHERE id = ?").bind(job.to_string());
    let Some(row) = row.fetch_optional(connection).await? else { return Ok(None) };
    rows::optional_parsed(&row, "project")
}

impl Store {
    async fn insert_export(
        &self,
        tx: &mut Transaction,
        export: ExportRecord,
        now: Timestamp,
    ) -> Result<Option<ExportRecord>, StoreError> {
        locks::job(tx, export.job).await?;
        let Some(project) = project_of(tx, export.job).await? else { return Ok(None) };
        let same = |kept: &ExportRecord| (kept.source, kept.format) == (export.source, export.format);
        if let Some(kept) = of_job(tx, export.job).await?.into_iter().find(same) {
            return Ok(Some(kept));
        }
        accounts::admit_blob(tx, self.policy.limits.quota_bytes, project, export.blob).await?;
        insert_blob(tx, export.blob, now).await?;
        query(
            "INSERT INTO exports (job_id, source, format, digest, gaussians, sh_degree, likeness_psnr, likeness_views,
                 created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        )
        .bind_all(values![export.job.to_string(), export.source.to_string(), export.format.name()])
        .bind_all(values![export.blob.digest.to_string(), rows::signed(export.gaussians)])
        .bind_all(values![export.sh_degree, export.fidelity.map(|fidelity| fidelity.psnr)])
        .bind_all(values![export.fidelity.map(|fidelity| fidelity.views), micros(now)])
        .execute(tx)
        .await?;
        Ok(Some(export))
    }

    /// Fails with [`StoreError::QuotaExceeded`] if the job's project has used up its quota.
    pub fn admit_export(&self, job: JobId) -> StoreFuture<'_, ()> {
        self.call("admit_export").run(self.read(async move |tx| {
            let Some(project) = project_of(tx, job).await? else { return Ok(()) };
            accounts::admit(tx, self.policy.limits.quota_bytes, project, 1).await
        }))
    }

    /// Adds an export unless the job has one of the same source and format, and returns the one that is stored; `None` if there is no
    /// such job. It counts against the quota of the job's project.
    pub fn add_export(&self, export: ExportRecord) -> StoreFuture<'_, Option<ExportRecord>> {
        self.create("add_export", move |store| {
            Box::pin(store.write(async move |tx, now| store.insert_export(tx, export, now).await))
        })
    }

    /// The exports of a job's scene.
    pub fn exports(&self, job: JobId) -> StoreFuture<'_, Vec<ExportRecord>> {
        self.call("exports").run(self.read(async move |tx| of_job(tx, job).await))
    }

    /// The file with this hash among those of the project's jobs, or of all jobs without `project`. Datasets are not included.
    pub fn file(&self, digest: Digest, project: Option<ProjectId>) -> StoreFuture<'_, Option<FileRecord>> {
        let file = query(
            "SELECT files.*, blobs.bytes FROM (
                 SELECT job_id, kind, lambda, digest FROM artifacts WHERE digest = ?1
                 UNION ALL
                 SELECT job_id, format AS kind,
                     (SELECT lambda FROM artifacts
                      WHERE artifacts.job_id = exports.job_id AND artifacts.digest = source
                      ORDER BY place LIMIT 1) AS lambda, digest
                 FROM exports WHERE digest = ?1
             ) AS files
             JOIN blobs ON blobs.digest = files.digest
             JOIN jobs ON jobs.id = files.job_id
             WHERE ?2 IS NULL OR jobs.project = ?2
             ORDER BY jobs.created_at DESC, jobs.id DESC LIMIT 1",
        );
        let file = file.bind(digest.to_string()).bind(project.map(|project| project.to_string()));
        self.call("file").run(file.optional(&self.readers, rows::file))
    }
}
