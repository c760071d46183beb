//! The job table in one SQLite file, for a single machine.
//!
//! WAL with `synchronous = FULL`: a committed change survives a power cut. Writes go through one connection
//! and begin with `BEGIN IMMEDIATE`, so no transaction ever has to turn from reader into writer, which SQLite
//! refuses without waiting. Reads have connections of their own. Several processes may share the file. Totals that grow
//! with the history are kept by triggers of the schema and never counted.

mod accounts;
mod datasets;
#[cfg(test)]
mod durability_tests;
mod events;
mod exports;
mod idempotency;
mod job_changes;
mod keys;
mod leases;
mod lists;
mod open;
mod priority;
mod queue;
mod rows;
mod series;
mod stats;
mod uploads;
mod webhooks;

use std::sync::{Arc, Mutex};

use jiff::Timestamp;
use serde_json::json;
use sqlx::{Row as _, Sqlite, SqliteConnection, SqlitePool, Transaction};

use super::{
    Artifact, AttemptRecord, BlobRef, Cancellation, Claim, Deletion, Heartbeat, JobFilter, JobRecord, Lease,
    NewJob, Outcome, PageKey, QueuePolicy, RetryOutcome, RetryRequest, Store, StoreError, StoreFuture,
    WorkerDeath, leases::LeaseWatch,
};
use crate::domain::{Clock, Event, EventKind, JobId, JobState, Phase, Progress};
pub use open::SchemaChange;
use rows::{json as text, micros};

/// HTTP status of an answer to a request that made something.
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

    async fn begin(&self) -> Result<(Transaction<'static, Sqlite>, Timestamp), StoreError> {
        let transaction = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        // The clock is read only once the transaction holds the write lock, so that times never run backwards.
        Ok((transaction, self.clock.now()))
    }

    async fn insert_job(&self, new: NewJob) -> Result<JobRecord, StoreError> {
        let (mut tx, now) = self.begin().await?;
        let record = self.insert_job_in(&mut tx, new, now).await?;
        tx.commit().await?;
        Ok(record)
    }

    async fn insert_job_in(
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
        accounts::admit_job(tx, limits.max_active_jobs, new.owner).await?;
        accounts::admit_blob(tx, limits.max_bytes, new.owner, new.dataset).await?;
        // A job that repeats another has the priority that was admitted then.
        if new.retry_of.is_none() {
            priority::admit(tx, limits.max_priority, new.owner, new.priority).await?;
        }
        if let Some(scene) = new.scene {
            let known = sqlx::query("SELECT 1 FROM scenes WHERE id = ?").bind(scene.to_string());
            if known.fetch_optional(&mut *tx).await?.is_none() {
                return Err(StoreError::NoScene(scene));
            }
        }
        insert_blob(tx, new.dataset, now).await?;
        sqlx::query(
            "INSERT INTO jobs (id, owner, scene, retry_of, deadline_at, dataset, options, state, phase, progress, priority,
                 run_after, max_attempts, from_checkpoint, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?, 'queued', 'queued', ?, ?, 0, ?, ?, ?)",
        )
        .bind(new.id.to_string())
        .bind(new.owner.map(|owner| owner.to_string()))
        .bind(new.scene.map(|scene| scene.to_string()))
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

    async fn insert_retry(
        &self,
        id: JobId,
        repeat: RetryRequest,
    ) -> Result<Option<RetryOutcome>, StoreError> {
        let (mut tx, now) = self.begin().await?;
        let made = match job_changes::retry_of(&mut tx, id, repeat).await? {
            None => return Ok(None),
            Some(Err(state)) => return Ok(Some(RetryOutcome::NotRetryable(state))),
            Some(Ok(new)) => self.insert_job_in(&mut tx, new, now).await?,
        };
        tx.commit().await?;
        Ok(Some(RetryOutcome::Created(Box::new(made))))
    }

    async fn remove_job(&self, id: JobId, version: Option<u64>) -> Result<Option<Deletion>, StoreError> {
        // As with a cancellation, a worker that is gone keeps nobody from deleting its job.
        let expired = self.expired_of(id).await?;
        let (mut tx, now) = self.begin().await?;
        queue::reap(&mut tx, &self.policy, &expired, now).await?;
        let answer = job_changes::delete(&mut tx, id, version).await?;
        tx.commit().await?;
        Ok(answer)
    }

    async fn give_up(&self) -> Result<u64, StoreError> {
        let late = sqlx::query("SELECT 1 FROM jobs WHERE state = 'queued' AND deadline_at <= ? LIMIT 1")
            .bind(micros(self.clock.now()))
            .fetch_optional(&self.readers)
            .await?;
        if late.is_none() {
            return Ok(0);
        }
        let (mut tx, now) = self.begin().await?;
        let count = job_changes::fail_expired(&mut tx, now).await?;
        tx.commit().await?;
        Ok(count)
    }

    async fn cancel_job(&self, id: JobId) -> Result<Option<Cancellation>, StoreError> {
        // A job whose worker is gone need not wait for another worker to learn that it is cancelled.
        let expired = self.expired_of(id).await?;
        let (mut tx, now) = self.begin().await?;
        queue::reap(&mut tx, &self.policy, &expired, now).await?;
        job_changes::fail_expired(&mut tx, now).await?;
        let answer = queue::cancel(&mut tx, id, now).await?;
        tx.commit().await?;
        Ok(answer)
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> Result<Vec<JobRecord>, StoreError> {
        // One snapshot for the jobs and their artifacts.
        let mut tx = self.readers.begin().await?;
        let rows = lists::jobs(filter, before, limit).build().fetch_all(&mut *tx).await?;
        let mut records = Vec::with_capacity(rows.len());
        for row in &rows {
            let artifacts = select_artifacts(&mut tx, rows::job_id(row)?).await?;
            records.push(rows::job(row, artifacts)?);
        }
        Ok(records)
    }

    async fn read_events(&self, id: JobId, after: u64, limit: u32) -> Result<Option<Vec<Event>>, StoreError> {
        let mut tx = self.readers.begin().await?;
        let known = sqlx::query("SELECT 1 FROM jobs WHERE id = ?")
            .bind(id.to_string())
            .fetch_optional(&mut *tx)
            .await?
            .is_some();
        if !known {
            return Ok(None);
        }
        let rows = sqlx::query("SELECT * FROM events WHERE job_id = ? AND seq > ? ORDER BY seq LIMIT ?")
            .bind(id.to_string())
            .bind(i64::try_from(after).unwrap_or(i64::MAX))
            .bind(limit)
            .fetch_all(&mut *tx)
            .await?;
        rows.iter().map(rows::event).collect::<Result<_, _>>().map(Some)
    }

    /// Whether a claim could find anything, so that idle polling takes no write lock.
    async fn anything_due(&self) -> Result<bool, StoreError> {
        let now = micros(self.clock.now());
        let row = sqlx::query(
            "SELECT EXISTS (SELECT 1 FROM jobs WHERE state = 'queued' AND (run_after <= ?1 OR waits_since > ?1)) AS due",
        )
        .bind(now)
        .fetch_one(&self.readers)
        .await?;
        Ok(row.try_get("due")?)
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
    let artifacts = select_artifacts(connection, id).await?;
    rows::job(&row, artifacts).map(Some)
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

impl Store for SqliteStore {
    fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord> {
        Box::pin(self.insert_job(new))
    }

    fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            select_job(&mut tx, id).await
        })
    }

    fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>> {
        Box::pin(self.list(filter, before, limit))
    }

    fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>> {
        Box::pin(self.read_events(id, after, limit))
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
        Box::pin(self.cancel_job(id))
    }

    fn retry_job(&self, id: JobId, repeat: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>> {
        Box::pin(self.insert_retry(id, repeat))
    }

    fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>> {
        Box::pin(self.remove_job(id, version))
    }

    fn fail_expired(&self) -> StoreFuture<'_, u64> {
        Box::pin(self.give_up())
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
            self.watched(claimed.map(Option::unzip))
        })
    }

    fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat> {
        Box::pin(async move {
            let renewed = self.renew(lease).await;
            self.watched(renewed.map(|(row, heartbeat)| (Some(row), heartbeat)))
        })
    }

    fn report<'a>(&'a self, lease: &'a Lease, phase: Phase, progress: &'a Progress) -> StoreFuture<'a, ()> {
        Box::pin(async move {
            let (mut tx, now) = self.begin().await?;
            queue::report(&mut tx, &self.policy, lease, phase, progress, now).await?;
            tx.commit().await?;
            Ok(())
        })
    }

    fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState> {
        Box::pin(async move {
            let (mut tx, now) = self.begin().await?;
            let state = queue::finish(&mut tx, &self.policy, lease, outcome, now).await?;
            tx.commit().await?;
            Ok(state)
        })
    }

    fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64> {
        Box::pin(async move {
            let (mut tx, now) = self.begin().await?;
            let count = queue::expire_worker(&mut tx, &self.policy, worker, death, now).await?;
            tx.commit().await?;
            Ok(count)
        })
    }

    fn expire_leases(&self) -> StoreFuture<'_, u64> {
        Box::pin(async move {
            let expired = self.reap_expired().await;
            self.watched(expired.map(|count| (None, count)))
        })
    }

    fn ping(&self) -> StoreFuture<'_, ()> {
        Box::pin(async move {
            sqlx::query("SELECT 1").fetch_one(&self.readers).await?;
            Ok(())
        })
    }
}
