//! Storage and quotas of projects, and references to blobs.
//!
//! Usage is read from totals that the schema's triggers maintain; tests compare them with a recount. The query below names every table
//! that refers to blobs; a test compares it with the schema's foreign keys, which also prevent the deletion of a referenced row.

use std::collections::BTreeSet;

use super::{
    MEMBERS, Store,
    db::{Query, Sql, Transaction, query, values},
    locks,
    rows::{integer, json, optional_integer, parsed},
};
use crate::{
    domain::{Digest, ProjectId},
    store::{BlobRef, Capacity, StoreError, StoreFuture, Usage},
};

/// The members of the JSON array `?` as rows with a `digest`.
const LISTED: Sql = Sql {
    sqlite: "(SELECT value AS digest FROM json_each(?)) AS listed",
    postgres: "jsonb_array_elements_text(CAST(? AS jsonb)) AS listed (digest)",
};

/// Whether nothing refers to a listed blob.
const IS_UNREFERENCED: &str = "
    NOT EXISTS (SELECT 1 FROM scenes WHERE scenes.dataset = listed.digest)
    AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.dataset = listed.digest)
    AND NOT EXISTS (SELECT 1 FROM artifacts WHERE artifacts.digest = listed.digest)
    AND NOT EXISTS (SELECT 1 FROM exports WHERE exports.digest = listed.digest)
    AND NOT EXISTS (SELECT 1 FROM exports WHERE exports.source = listed.digest)";

/// Storage of project `?1`.
const USAGE: &str = "SELECT dataset_bytes + artifact_bytes + export_bytes AS stored_bytes, reserved_bytes
    FROM project_totals WHERE project = ?1";

/// Whether project `?1` refers to blob `?2`.
const HAS_BLOB: &str =
    "SELECT EXISTS (SELECT 1 FROM project_blobs WHERE project = ?1 AND digest = ?2) AS known";

/// How many active jobs project `?1` has and may have.
const ACTIVE_JOBS: &str = "
    SELECT max_active_jobs, queued_jobs + running_jobs AS active
    FROM projects JOIN project_totals ON project = id WHERE id = ?1";

/// Bytes of the largest blob of project `?1` that was first referred to as a dataset.
const LARGEST_DATASET: &str = "
    SELECT COALESCE(MAX(bytes), 0) AS largest
    FROM project_blobs JOIN blobs ON blobs.digest = project_blobs.digest WHERE project = ?1 AND kind = 'dataset'";

/// Bytes of blob `?2`, if project `?1` refers to it.
const OWNED_BLOB: &str = "
    SELECT bytes FROM project_blobs JOIN blobs ON blobs.digest = project_blobs.digest
    WHERE project = ?1 AND project_blobs.digest = ?2";

/// Statements that look for an archive once a quota is used up.
#[cfg(test)]
pub(super) const OF_ARCHIVES: [&str; 2] = [LARGEST_DATASET, OWNED_BLOB];

/// Statements that run under the write lock; their cost must not grow with the number of rows.
#[cfg(test)]
pub(super) const STATEMENTS: [&str; 3] = [USAGE, HAS_BLOB, ACTIVE_JOBS];

/// The project's storage.
async fn usage(connection: &mut Transaction, project: ProjectId) -> Result<Usage, StoreError> {
    let row = query(USAGE).bind(project.to_string()).fetch_optional(connection).await?;
    let Some(row) = row else { return Ok(Usage { stored: 0, reserved: 0 }) };
    Ok(Usage { stored: integer(&row, "stored_bytes")?, reserved: integer(&row, "reserved_bytes")? })
}

/// The limit of a project that has none of its own: the service's, or none for the default project.
pub(super) fn default_limit<T>(project: ProjectId, default: Option<T>) -> Option<T> {
    default.filter(|_| project != ProjectId::DEFAULT)
}

/// The project's quota, which is `default` for projects without one.
async fn quota(
    connection: &mut Transaction,
    default: Option<u64>,
    project: ProjectId,
) -> Result<Option<u64>, StoreError> {
    let row = query("SELECT max_bytes FROM projects WHERE id = ?")
        .bind(project.to_string())
        .fetch_one(connection)
        .await?;
    Ok(optional_integer(&row, "max_bytes")?.or(default_limit(project, default)))
}

/// Refuses `requested` more bytes over the project's quota, which is `default` for projects without one. Part of the transaction that
/// adds them.
pub(super) async fn admit(
    connection: &mut Transaction,
    default: Option<u64>,
    project: ProjectId,
    requested: u64,
) -> Result<(), StoreError> {
    let Some(quota) = quota(connection, default, project).await? else { return Ok(()) };
    let usage = usage(connection, project).await?;
    Capacity { usage, quota: Some(quota) }.admit(0, requested)
}

/// As [`admit`], for a blob; one that the project refers to already counts nothing.
pub(super) async fn admit_blob(
    connection: &mut Transaction,
    default: Option<u64>,
    project: ProjectId,
    blob: BlobRef,
) -> Result<(), StoreError> {
    let row = query(HAS_BLOB)
        .bind_all(values![project.to_string(), blob.digest.to_string()])
        .fetch_one(&mut *connection)
        .await?;
    let known: bool = row.try_get("known")?;
    if known { Ok(()) } else { admit(connection, default, project, blob.bytes).await }
}

/// Refuses another job if the project has its maximum of queued and running ones, which is `default` for projects without one. Part of the
/// transaction that adds it.
pub(super) async fn admit_job(
    connection: &mut Transaction,
    default: Option<u32>,
    project: ProjectId,
) -> Result<(), StoreError> {
    let row = query(ACTIVE_JOBS).bind(project.to_string()).fetch_one(connection).await?;
    let active: u32 = integer(&row, "active")?;
    let max: Option<u32> = optional_integer(&row, "max_active_jobs")?.or(default_limit(project, default));
    if max.is_some_and(|max| active >= max) {
        return Err(StoreError::TooManyJobs { active });
    }
    Ok(())
}

/// The digests of a JSON array that nothing refers to, in any order.
pub(super) fn unreferenced_among(digests: String) -> Query {
    let mut list = query("SELECT digest FROM ");
    list.push(LISTED).push(" WHERE ").push(IS_UNREFERENCED);
    list.bind(digests)
}

/// Those of the blobs that nothing refers to, in their order.
pub(super) async fn unreferenced(
    connection: &mut Transaction,
    digests: &[Digest],
) -> Result<Vec<Digest>, StoreError> {
    if digests.is_empty() {
        return Ok(Vec::new());
    }
    let found: Vec<Digest> = unreferenced_among(json(&digests)?)
        .all(connection, |row| parsed("digest", row.try_get("digest")?))
        .await?;
    let found: BTreeSet<Digest> = found.into_iter().collect();
    Ok(digests.iter().filter(|digest| found.contains(digest)).copied().collect())
}

impl Store {
    /// The project's storage.
    pub fn usage(&self, project: ProjectId) -> StoreFuture<'_, Usage> {
        self.call("usage").run(self.read(async move |tx| usage(tx, project).await))
    }

    /// The project's storage and quota.
    pub fn capacity(&self, project: ProjectId) -> StoreFuture<'_, Capacity> {
        self.call("capacity").run(self.read(async move |tx| {
            let quota = quota(tx, self.policy.limits.quota_bytes, project).await?;
            if quota.is_none() {
                return Ok(Capacity::default());
            }
            Ok(Capacity { usage: usage(tx, project).await?, quota })
        }))
    }

    /// Bytes of the project's largest dataset, 0 if it has none; a longer upload cannot be one that the project has. Reads all blobs of the
    /// project.
    pub fn largest_dataset(&self, project: ProjectId) -> StoreFuture<'_, u64> {
        self.call("largest_dataset").run(async move {
            let row = query(LARGEST_DATASET).bind(project.to_string()).fetch_one(&self.readers).await?;
            integer(&row, "largest")
        })
    }

    /// The blob with this content, if something of the project refers to it.
    pub fn owned_archive(&self, project: ProjectId, content: Digest) -> StoreFuture<'_, Option<BlobRef>> {
        self.call("owned_archive").run(async move {
            query(OWNED_BLOB)
                .bind_all(values![project.to_string(), content.to_string()])
                .optional(&self.readers, |row| Ok(BlobRef { digest: content, bytes: integer(row, "bytes")? }))
                .await
        })
    }

    /// Removes the rows of those blobs that nothing refers to, and returns their digests.
    pub fn forget_blobs<'a>(&'a self, digests: &'a [Digest]) -> StoreFuture<'a, Vec<Digest>> {
        self.call("forget_blobs").run(async move {
            // Most are in use; looking first keeps the write lock free.
            let unused = self.read(async move |tx| unreferenced(tx, digests).await).await?;
            if unused.is_empty() {
                return Ok(unused);
            }
            self.write(async move |tx, _| {
                let mut free = Vec::new();
                for digest in unused {
                    if locks::blob_to_delete(tx, digest).await? {
                        free.push(digest);
                    }
                }
                // Looked up again once nothing new can refer to them.
                let forgotten = unreferenced(tx, &free).await?;
                let mut delete = query("DELETE FROM blobs WHERE digest IN ");
                delete.push(MEMBERS);
                delete.bind(json(&forgotten)?).run(tx).await?;
                Ok(forgotten)
            })
            .await
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sql::open::temporary_store;

    #[tokio::test]
    async fn the_query_names_every_table_that_refers_to_blobs() {
        let (_folder, store) = temporary_store().await;
        let rows = query(
            "SELECT tables.name, keys.\"from\" AS place FROM sqlite_schema AS tables, pragma_foreign_key_list(tables.name) AS keys
             WHERE tables.type = 'table' AND keys.\"table\" = 'blobs'",
        )
        .fetch_all(&store.readers)
        .await
        .expect("the schema");
        assert!(rows.len() >= 3);
        for row in rows {
            let (table, column): (String, String) =
                (row.try_get("name").expect("a table"), row.try_get("place").expect("a column"));
            assert!(
                IS_UNREFERENCED.contains(&format!("FROM {table} WHERE {table}.{column} = listed.digest)")),
                "blobs of {table}.{column} would be deleted as nobody's"
            );
        }
    }
}
