//! The store in one SQLite file, for a single machine.
//!
//! WAL with `synchronous = FULL`: a committed change survives a power cut. Writes go through one connection
//! and begin with `BEGIN IMMEDIATE`, so no transaction ever has to turn from reader into writer, which SQLite
//! refuses without waiting. Reads have connections of their own. Several processes may share the file. Triggers of the schema
//! maintain totals, so no query counts a whole table.

mod accounts;
mod datasets;
mod events;
mod exports;
mod idempotency;
mod job_changes;
mod keys;
mod leases;
mod lists;
mod open;
mod priority;
mod projects;
mod queue;
mod rows;
mod series;
mod stats;
mod upkeep;
mod uploads;
mod webhooks;

use std::{
    fmt::Display,
    sync::{Arc, Mutex},
};

use jiff::Timestamp;
use serde_json::json;
use sqlx::{SqliteConnection, SqlitePool, sqlite::SqliteRow};

use super::{
    Artifact, AttemptRecord, BlobRef, Cancellation, Claim, Deletion, Heartbeat, JobFilter, JobRecord, Lease,
    NewJob, Outcome, PageKey, QueuePolicy, RetryOutcome, RetryRequest, Store, StoreError, StoreFuture,
    WorkerDeath, leases::LeaseWatch,
};
use crate::domain::{Clock, Event, EventKind, JobId, JobState, Phase, Progress};
pub use open::SchemaChange;
use rows::{JobParts, json as text, micros};

/// HTTP status of the response to a request that created a resource.
const CREATED: u16 = 201;

/// [`Store`] on SQLite.
pub struct SqliteStore {
    writer: SqlitePool,
    readers: SqlitePool,
    clock: Arc<dyn Clock>,
    policy: QueuePolicy,
    leases: Mutex<LeaseWatch>,
}

impl SqliteStore {
    /// Closes every connection; what was committed is on disk.
    pub async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }

    /// Runs `work` in a transaction that holds the write lock, and commits it unless `work` fails.
    async fn write<T>(
        &self,
        work: impl AsyncFnOnce(&mut SqliteConnection, Timestamp) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        let mut tx = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        // The clock is read only once the transaction holds the write lock, so that times never run backwards.
        let now = self.clock.now();
        let value = work(&mut tx, now).await?;
        tx.commit().await?;
        Ok(value)
    }

    /// Runs `work` on one snapshot of the database.
    async fn read<T>(
        &self,
        work: impl AsyncFnOnce(&mut SqliteConnection) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        work(&mut *self.readers.begin().await?).await
    }

    async fn insert_job(
        &self,
        tx: &mut SqliteConnection,
        new: NewJob,
        now: Timestamp,
    ) -> Result<JobRecord, StoreError> {
        if let Some(intent) = &new.intent {
            let (id, keep) = (new.id.to_string(), self.policy.idempotency_ttl);
            idempotency::remember(tx, intent, CREATED, &id, keep, now).await?;
        }
        let limits = self.policy.limits;
        accounts::admit_job(tx, limits.max_active_jobs, new.project).await?;
        accounts::admit_blob(tx, limits.quota_bytes, new.project, new.dataset).await?;
        // A retry keeps the priority that was admitted for the job before.
        if new.retry_of.is_none() {
            priority::admit(tx, limits.max_priority, new.project, new.key, new.priority).await?;
        }
        if let Some(dataset) = new.dataset_id
            && !exists(tx, "SELECT 1 FROM scenes WHERE id = ?", dataset).await?
        {
            return Err(StoreError::NoDataset(dataset));
        }
        insert_blob(tx, new.dataset, now).await?;
        sqlx::query(
            "INSERT INTO jobs (id, project, owner, name, metadata, scene, retry_of, deadline_at, dataset, options, state, phase,
                 progress, priority, run_after, max_attempts, from_checkpoint, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 'queued', 'queued', ?, ?, 0, ?, ?, ?)",
        )
        .bind(new.id.to_string())
        .bind(new.project.to_string())
        .bind(new.key.map(|key| key.to_string()))
        .bind(&new.name)
        .bind(text(&new.metadata)?)
        .bind(new.dataset_id.map(|id| id.to_string()))
        .bind(new.retry_of.map(|job| job.to_string()))
        .bind(new.deadline_at.map(micros))
        .bind(new.dataset.digest.to_string())
        .bind(text(&new.options)?)
        .bind(text(&Progress::default())?)
        .bind(new.priority)
        .bind(self.policy.max_attempts)
        .bind(new.from_checkpoint)
        .bind(micros(now))
        .execute(&mut *tx)
        .await?;
        let data = json!({ "state": JobState::Queued });
        events::append(tx, new.id, EventKind::State, 0, &data, now).await?;
        select_job(tx, new.id).await?.ok_or(StoreError::Database(sqlx::Error::RowNotFound))
    }

    /// Whether a claim could find a job, so that idle polling takes no write lock.
    async fn anything_due(&self) -> Result<bool, StoreError> {
        let mut reader = self.readers.acquire().await?;
        Ok(queue::next(&mut reader, &self.policy, self.clock.now()).await?.is_some())
    }
}

/// Records a blob unless it is known.
async fn insert_blob(
    connection: &mut SqliteConnection,
    blob: BlobRef,
    now: Timestamp,
) -> Result<(), StoreError> {
    let bytes = i64::try_from(blob.bytes)
        .map_err(|_| StoreError::Corrupt { what: "blob length", fault: blob.bytes.to_string() })?;
    sqlx::query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, ?, ?) ON CONFLICT DO NOTHING")
        .bind(blob.digest.to_string())
        .bind(bytes)
        .bind(micros(now))
        .execute(connection)
        .await?;
    Ok(())
}

async fn select_job(connection: &mut SqliteConnection, id: JobId) -> Result<Option<JobRecord>, StoreError> {
    let row = sqlx::query(
        "SELECT jobs.*, blobs.bytes FROM jobs JOIN blobs ON blobs.digest = jobs.dataset WHERE jobs.id = ?",
    )
    .bind(id.to_string())
    .fetch_optional(&mut *connection)
    .await?;
    let Some(row) = row else { return Ok(None) };
    job_record(connection, &row).await.map(Some)
}

/// The job of a row of `jobs` joined with its dataset's `bytes`.
async fn job_record(connection: &mut SqliteConnection, row: &SqliteRow) -> Result<JobRecord, StoreError> {
    let id = rows::job_id(row)?;
    let parts = JobParts {
        artifacts: select_artifacts(connection, id).await?,
        attempts: queue::latest_attempts(connection, id).await?,
        queue_position: queue::position(connection, row).await?,
    };
    rows::job(row, parts)
}

async fn select_artifacts(connection: &mut SqliteConnection, id: JobId) -> Result<Vec<Artifact>, StoreError> {
    let rows = sqlx::query(
        "SELECT artifacts.kind, artifacts.lambda, artifacts.digest, blobs.bytes
         FROM artifacts JOIN blobs ON blobs.digest = artifacts.digest WHERE job_id = ?
         ORDER BY kind, place",
    )
    .bind(id.to_string())
    .fetch_all(connection)
    .await?;
    rows.iter().map(rows::artifact).collect()
}

/// Whether the query finds a row for `id`.
async fn exists(
    connection: &mut SqliteConnection,
    query: &'static str,
    id: impl Display,
) -> Result<bool, StoreError> {
    Ok(sqlx::query(query).bind(id.to_string()).fetch_optional(connection).await?.is_some())
}

async fn job_exists(connection: &mut SqliteConnection, id: JobId) -> Result<bool, StoreError> {
    exists(connection, "SELECT 1 FROM jobs WHERE id = ?", id).await
}

impl Store for SqliteStore {
    fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord> {
        Box::pin(self.write(async move |tx, now| self.insert_job(tx, new, now).await))
    }

    fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>> {
        Box::pin(self.read(async move |tx| select_job(tx, id).await))
    }

    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>> {
        Box::pin(self.read(async move |tx| {
            let rows = lists::jobs(filter, before, limit).build().fetch_all(&mut *tx).await?;
            let mut records = Vec::with_capacity(rows.len());
            for row in &rows {
                records.push(job_record(tx, row).await?);
            }
            Ok(records)
        }))
    }

    fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>> {
        Box::pin(self.read(async move |tx| {
            if !job_exists(tx, id).await? {
                return Ok(None);
            }
            let rows = sqlx::query("SELECT * FROM events WHERE job_id = ? AND seq > ? ORDER BY seq LIMIT ?")
                .bind(id.to_string())
                .bind(rows::signed(after))
                .bind(limit)
                .fetch_all(tx)
                .await?;
            rows.iter().map(rows::event).collect::<Result<_, _>>().map(Some)
        }))
    }

    fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<(JobId, u64)>> {
        Box::pin(async move {
            let rows =
                sqlx::query("SELECT id, last_seq FROM jobs WHERE id IN (SELECT value FROM json_each(?))")
                    .bind(text(&jobs)?)
                    .fetch_all(&self.readers)
                    .await?;
            rows.iter().map(rows::newest_event).collect()
        })
    }

    fn attempts(&self, id: JobId) -> StoreFuture<'_, Vec<AttemptRecord>> {
        Box::pin(async move {
            let rows = sqlx::query("SELECT * FROM attempts WHERE job_id = ? ORDER BY number")
                .bind(id.to_string())
                .fetch_all(&self.readers)
                .await?;
            rows.iter().map(rows::attempt).collect()
        })
    }

    fn cancel(&self, id: JobId) -> StoreFuture<'_, Option<Cancellation>> {
        Box::pin(async move {
            // A job whose worker is dead is cancelled at once, without another worker.
            let expired = self.expired_of(id).await?;
            self.write(async move |tx, now| {
                queue::reap(tx, &self.policy, &expired, now).await?;
                job_changes::fail_expired(tx, now).await?;
                queue::cancel(tx, id, now).await
            })
            .await
        })
    }

    fn retry_job(&self, id: JobId, request: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>> {
        Box::pin(self.write(async move |tx, now| {
            Ok(match job_changes::retry_of(tx, id, request).await? {
                None => None,
                Some(Err(state)) => Some(RetryOutcome::NotRetryable(state)),
                Some(Ok(new)) => Some(RetryOutcome::Created(Box::new(self.insert_job(tx, new, now).await?))),
            })
        }))
    }

    fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>> {
        Box::pin(async move {
            // A job whose worker is dead can be deleted at once, as it can be cancelled.
            let expired = self.expired_of(id).await?;
            self.write(async move |tx, now| {
                queue::reap(tx, &self.policy, &expired, now).await?;
                job_changes::delete(tx, id, version).await
            })
            .await
        })
    }

    fn fail_expired(&self) -> StoreFuture<'_, u64> {
        Box::pin(async move {
            let late = sqlx::query("SELECT 1 FROM jobs WHERE state = 'queued' AND deadline_at <= ? LIMIT 1")
                .bind(micros(self.clock.now()))
                .fetch_optional(&self.readers)
                .await?;
            if late.is_none() {
                return Ok(0);
            }
            self.write(async move |tx, now| job_changes::fail_expired(tx, now).await).await
        })
    }

    fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<JobId>> {
        Box::pin(async move {
            let rows = sqlx::query(
                "SELECT id FROM jobs WHERE id IN (SELECT value FROM json_each(?))
                     AND (state IN ('queued', 'running') OR (state IN ('failed', 'cancelled') AND finished_at > ?))",
            )
            .bind(text(&jobs)?)
            .bind(micros(rows::before(self.clock.now(), self.policy.checkpoint_ttl)))
            .fetch_all(&self.readers)
            .await?;
            rows.iter().map(rows::job_id).collect()
        })
    }

    fn claim<'a>(&'a self, worker: &'a str) -> StoreFuture<'a, Option<Claim>> {
        Box::pin(async move {
            let claimed = self.claim_next(worker).await;
            self.track_lease(claimed.map(Option::unzip))
        })
    }

    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat> {
        Box::pin(async move {
            let renewed =
                self.write(async move |tx, now| queue::heartbeat(tx, &self.policy, lease, now).await).await;
            self.track_lease(renewed.map(|(row, heartbeat)| (Some(row), heartbeat)))
        })
    }

    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> StoreFuture<'a, ()> {
        Box::pin(
            self.write(async move |tx, now| {
                queue::report(tx, &self.policy, lease, phase, progress, now).await
            }),
        )
    }

    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState> {
        Box::pin(self.write(async move |tx, now| queue::finish(tx, &self.policy, lease, outcome, now).await))
    }

    fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64> {
        Box::pin(
            self.write(async move |tx, now| queue::expire_worker(tx, &self.policy, worker, death, now).await),
        )
    }

    fn expire_leases(&self) -> StoreFuture<'_, u64> {
        Box::pin(async move {
            let expired = self.reap_expired().await;
            self.track_lease(expired.map(|count| (None, count)))
        })
    }

    fn ping(&self) -> StoreFuture<'_, ()> {
        Box::pin(async move {
            sqlx::query("SELECT 1").fetch_one(&self.readers).await?;
            Ok(())
        })
    }
}
