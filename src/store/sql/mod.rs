//! The store in one SQLite file, for a single machine, or in a PostgreSQL database, which several machines may share.
//!
//! Both have one logic; statements that they spell differently have two texts ([`db::Sql`]). Triggers of the schemas maintain totals, so
//! no query counts a whole table.
//!
//! - **SQLite.** WAL with `synchronous = FULL`: a committed change survives a power cut. Writes go through one connection and begin with
//!   `BEGIN IMMEDIATE`, so no transaction ever has to turn from reader into writer, which SQLite refuses without waiting. Reads have
//!   connections of their own. Several processes may share the file.
//! - **PostgreSQL.** Transactions run side by side. Those that write see the newest rows with each statement (`READ COMMITTED`); one that
//!   changes what a project has or may do first locks the project's row of totals (`locks`), and only then others, so quotas hold and
//!   nothing deadlocks. Those that read have one snapshot. Times are the database's.

mod accounts;
mod changes;
mod datasets;
mod db;
mod events;
mod exports;
mod faults;
mod finished_runs;
mod idempotency;
mod job_changes;
mod job_versions;
mod keys;
mod leases;
mod lists;
mod locks;
pub mod migrations;
mod open;
mod priority;
mod projects;
mod publications;
mod queue;
mod retention;
mod rows;
mod series;
mod sessions;
mod shares;
mod stats;
mod upkeep;
mod uploads;
mod viewers;
mod webhooks;
mod workers;

use std::{
    fmt::Display,
    sync::{Arc, Mutex, OnceLock},
};

use jiff::Timestamp;
use serde_json::json;

use super::{
    Artifact, AttemptRecord, BlobRef, Cancellation, ChangeKind, Changes, Claim, Claimant, Deletion,
    Heartbeat, JobChange, JobFilter, JobRecord, JobUpdate, Lease, NewJob, Outcome, PageKey, QueuePolicy,
    RetryOutcome, RetryRequest, StoreError, StoreFuture, WorkerDeath, leases::LeaseWatch,
};
use crate::domain::{
    Clock, Event, EventKind, FailurePoint, JobId, JobState, Phase, Preparation, Progress,
    failure_point::reach,
};
use changes::Listener;
use db::{Pool, Row, Sql, Target, Transaction, query, values};
pub use faults::StoreFaults;
pub use open::{DatabaseLocation, InvalidDatabaseUrl, PostgresUrl, SchemaChange};
use queue::RowLock;
use rows::{JobParts, json as text, micros};

/// HTTP status of the response to a request that created a resource.
const CREATED: u16 = 201;

/// The members of the JSON array `?` as rows with a column.
const MEMBERS: Sql = Sql {
    sqlite: "(SELECT value FROM json_each(?))",
    postgres: "(SELECT jsonb_array_elements_text(CAST(? AS jsonb)))",
};

/// The time of PostgreSQL, in microseconds.
const DATABASE_TIME: &str = "SELECT CAST(extract(epoch FROM clock_timestamp()) * 1000000 AS bigint) AS now";

/// The earliest deadline of a queued job. It is not compared here: PostgreSQL would take a comparison with an unknown time for true of a third
/// of the jobs, and read the whole table until it finds one. The index of SQLite has running jobs too, and is used only if that is said.
const FIRST_DEADLINE: &str = "SELECT min(deadline_at) AS first FROM jobs
    WHERE state IN ('queued', 'running') AND state = 'queued' AND deadline_at IS NOT NULL";

/// A running job, if there is one. The state is no value, since the indexes of running jobs serve only statements that name it.
const ANY_RUNNING: &str = "SELECT 1 FROM jobs WHERE state = 'running' LIMIT 1";

/// Projects, keys, datasets, uploads, jobs with their queue, exports, webhooks and viewers, on SQLite or PostgreSQL.
///
/// A method that changes rows does so in one transaction, or in several short ones that each leave a consistent state. Clones share
/// the connections and the observation of leases.
#[derive(Clone)]
pub struct Store {
    writer: Pool,
    readers: Pool,
    clock: Arc<dyn Clock>,
    time: TimeSource,
    policy: QueuePolicy,
    leases: Arc<Mutex<LeaseWatch>>,
    listener: Arc<OnceLock<Listener>>,
    /// Which calls fail, in tests.
    faults: Option<Arc<dyn StoreFaults>>,
}

/// Whose wall clock gives the times that are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TimeSource {
    /// This process's.
    Process,
    /// The database's, which all machines share.
    Database,
}

impl Store {
    /// Closes every connection; what was committed is on disk.
    pub async fn close(&self) {
        if let Some(listener) = self.listener.get() {
            listener.stop();
        }
        self.readers.close().await;
        self.writer.close().await;
    }

    /// The time of what is written now.
    async fn now(&self, on: impl Into<Target<'_>>) -> Result<Timestamp, StoreError> {
        match self.time {
            TimeSource::Process => Ok(self.clock.now()),
            TimeSource::Database => {
                rows::instant("time", query(DATABASE_TIME).fetch_one(on).await?.try_get("now")?)
            }
        }
    }

    /// Runs `work` in a transaction to write in, and commits it unless `work` fails.
    async fn write<T>(
        &self,
        work: impl AsyncFnOnce(&mut Transaction, Timestamp) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        let mut tx = self.writer.begin_write().await?;
        // On SQLite the clock is read only once the transaction holds the write lock, so that times never run backwards.
        let now = self.now(&mut tx).await?;
        let value = work(&mut tx, now).await?;
        tx.commit().await?;
        Ok(value)
    }

    /// Runs `work` on one snapshot of the database.
    async fn read<T>(
        &self,
        work: impl AsyncFnOnce(&mut Transaction) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        work(&mut self.readers.begin().await?).await
    }

    async fn insert_job(
        &self,
        tx: &mut Transaction,
        mut new: NewJob,
        now: Timestamp,
    ) -> Result<JobRecord, StoreError> {
        if let Some(intent) = &new.intent {
            // Before anything is locked: it waits for another request with the same key.
            let (id, keep) = (new.id.to_string(), self.policy.idempotency_ttl);
            idempotency::remember(tx, intent, CREATED, &id, keep, now).await?;
        }
        locks::project(tx, new.project).await?;
        // By the archive that was sent: another may take its place.
        let sent = new.dataset;
        if new.needs > Preparation::None
            && let Some(posed) =
                queue::posed_dataset(tx, new.project, new.dataset.digest, &new.options.camera_search())
                    .await?
        {
            new = NewJob {
                photographs: Some(new.dataset.digest),
                dataset: posed,
                needs: Preparation::None,
                ..new
            };
        }
        workers::admit(tx, new.needs, now).await?;
        let limits = self.policy.limits;
        accounts::admit_job(tx, limits.max_active_jobs, new.project).await?;
        accounts::admit_blob(tx, limits.quota_bytes, new.project, new.dataset).await?;
        if new.retry_of.is_none() {
            priority::admit(tx, limits.max_priority, new.project, new.key, new.priority).await?;
        } else if let Some(max) = priority::highest(tx, limits.max_priority, new.project, new.key).await? {
            // The job before may be an administrator's, or older than the limit.
            new.priority = new.priority.min(max);
        }
        if let Some(dataset) = new.dataset_id
            && !exists(tx, "SELECT 1 FROM scenes WHERE id = ?", dataset).await?
        {
            return Err(StoreError::NoDataset(dataset));
        }
        insert_blob(tx, new.dataset, now).await?;
        if let Some(own) = &new.own_dataset {
            new.dataset_id = Some(datasets::of_job(tx, new.project, sent, own, now).await?);
        }
        query(
            "INSERT INTO jobs (id, project, owner, name, metadata, scene, retry_of, deadline_at, dataset, options, state, phase,
                 progress, priority, run_after, max_attempts, resume_from, created_at, needs, photographs)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 'queued', 'queued', ?, ?, 0, ?, ?, ?, ?, ?)",
        )
        .bind_all(values![new.id.to_string(), new.project.to_string(), new.key.map(|key| key.to_string())])
        .bind_all(values![&new.name, text(&new.metadata)?, new.dataset_id.map(|id| id.to_string())])
        .bind_all(values![new.retry_of.map(|job| job.to_string()), new.deadline_at.map(micros)])
        .bind_all(values![new.dataset.digest.to_string(), text(&new.options)?, text(&Progress::default())?])
        .bind_all(values![new.priority, self.policy.max_attempts])
        .bind_all(values![new.resume_from.map(|job| job.to_string()), micros(now)])
        .bind_all(values![rows::preparation_place(new.needs), new.photographs.map(|of| of.to_string())])
        .execute(&mut *tx)
        .await?;
        let data = json!({ "state": JobState::Queued });
        events::append(tx, new.id, EventKind::State, 0, &data, now).await?;
        select_job(tx, new.id).await?.ok_or(StoreError::Database(sqlx::Error::RowNotFound))
    }

    /// Fails queued jobs whose deadline has passed, and counts them.
    async fn fail_overdue(&self) -> Result<u64, StoreError> {
        let first: Option<i64> = query(FIRST_DEADLINE).fetch_one(&self.readers).await?.try_get("first")?;
        // Most often there is none, and nobody has to ask for the time.
        let Some(first) = first else { return Ok(0) };
        if first > micros(self.now(&self.readers).await?) {
            return Ok(0);
        }
        self.write(async move |tx, now| job_changes::fail_expired(tx, now).await).await
    }

    /// Whether a claim could find a job, so that idle polling takes no write lock.
    async fn anything_due(&self, can: Preparation) -> Result<bool, StoreError> {
        let now = self.now(&self.readers).await?;
        Ok(queue::next(&self.readers, &self.policy, can, now, RowLock::None).await?.is_some())
    }
}

/// Records a blob unless it is known.
async fn insert_blob(connection: &mut Transaction, blob: BlobRef, now: Timestamp) -> Result<(), StoreError> {
    let bytes = i64::try_from(blob.bytes)
        .map_err(|_| StoreError::Corrupt { what: "blob length", error: blob.bytes.to_string() })?;
    loop {
        query("INSERT INTO blobs (digest, bytes, created_at) VALUES (?, ?, ?) ON CONFLICT DO NOTHING")
            .bind_all(values![blob.digest.to_string(), bytes, micros(now)])
            .execute(&mut *connection)
            .await?;
        // PostgreSQL may be deleting the row that was found; one that is locked stays.
        if locks::blob(connection, blob.digest).await? {
            return Ok(());
        }
    }
}

async fn select_job(connection: &mut Transaction, id: JobId) -> Result<Option<JobRecord>, StoreError> {
    let row = query(
        "SELECT jobs.*, blobs.bytes FROM jobs JOIN blobs ON blobs.digest = jobs.dataset WHERE jobs.id = ?",
    )
    .bind(id.to_string())
    .fetch_optional(&mut *connection)
    .await?;
    let Some(row) = row else { return Ok(None) };
    job_record(connection, &row).await.map(Some)
}

/// The job of a row of `jobs` joined with its dataset's `bytes`.
async fn job_record(connection: &mut Transaction, row: &Row) -> Result<JobRecord, StoreError> {
    let id = rows::job_id(row)?;
    let parts = JobParts {
        artifacts: select_artifacts(connection, id).await?,
        attempts: queue::latest_attempts(connection, id).await?,
        queue_position: queue::position(connection, row).await?,
    };
    rows::job(row, parts)
}

async fn select_artifacts(connection: &mut Transaction, id: JobId) -> Result<Vec<Artifact>, StoreError> {
    query(
        "SELECT artifacts.kind, artifacts.lambda, artifacts.digest, blobs.bytes
         FROM artifacts JOIN blobs ON blobs.digest = artifacts.digest WHERE job_id = ?
         ORDER BY kind, place",
    )
    .bind(id.to_string())
    .all(connection, rows::artifact)
    .await
}

/// Whether the query finds a row for `id`.
async fn exists(
    connection: &mut Transaction,
    statement: &'static str,
    id: impl Display,
) -> Result<bool, StoreError> {
    Ok(query(statement).bind(id.to_string()).fetch_optional(connection).await?.is_some())
}

async fn job_exists(connection: &mut Transaction, id: JobId) -> Result<bool, StoreError> {
    exists(connection, "SELECT 1 FROM jobs WHERE id = ?", id).await
}

impl Store {
    /// The time by which the store judges deadlines and expiries: the database's, where machines share it.
    pub fn time(&self) -> StoreFuture<'_, Timestamp> {
        self.call("time").run(self.now(&self.readers))
    }

    /// Adds a job in state `queued`, with its dataset's blob row, its first event and its request's `Idempotency-Key`.
    ///
    /// # Errors
    /// [`StoreError::IdempotencyKeyUsed`], [`StoreError::QuotaExceeded`], [`StoreError::TooManyJobs`],
    /// [`StoreError::PriorityTooHigh`], [`StoreError::NoWorker`], [`StoreError::NoDataset`].
    pub fn create_job(&self, new: NewJob) -> StoreFuture<'_, JobRecord> {
        self.create("create_job", |store| {
            Box::pin(store.write(async move |tx, now| {
                let created = store.insert_job(tx, new, now).await?;
                reach(FailurePoint::BeforeCreate);
                Ok(created)
            }))
        })
    }

    /// The job.
    pub fn job(&self, id: JobId) -> StoreFuture<'_, Option<JobRecord>> {
        self.call("job").run(self.read(async move |tx| select_job(tx, id).await))
    }

    /// Up to `limit` jobs that pass the filter, newest first, older than `before`.
    pub fn jobs<'a>(
        &'a self,
        filter: &'a JobFilter,
        before: Option<PageKey>,
        limit: u32,
    ) -> StoreFuture<'a, Vec<JobRecord>> {
        self.call("jobs").run(self.read(async move |tx| {
            let rows = lists::jobs(filter, before, limit).fetch_all(&mut *tx).await?;
            let mut records = Vec::with_capacity(rows.len());
            for row in &rows {
                records.push(job_record(tx, row).await?);
            }
            Ok(records)
        }))
    }

    /// Up to `limit` events with numbers above `after`, oldest first; `None` if there is no such job.
    pub fn events(&self, id: JobId, after: u64, limit: u32) -> StoreFuture<'_, Option<Vec<Event>>> {
        self.call("events").run(self.read(async move |tx| {
            if !job_exists(tx, id).await? {
                return Ok(None);
            }
            query("SELECT * FROM events WHERE job_id = ? AND seq > ? ORDER BY seq LIMIT ?")
                .bind_all(values![id.to_string(), rows::signed(after), limit])
                .all(tx, rows::event)
                .await
                .map(Some)
        }))
    }

    /// The number of the newest event of each of these jobs; omits jobs that do not exist.
    pub fn newest_events<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<(JobId, u64)>> {
        self.call("newest_events").run(async move {
            let mut newest = query("SELECT id, last_seq FROM jobs WHERE id IN ");
            newest.push(MEMBERS);
            newest.bind(text(&jobs)?).all(&self.readers, rows::newest_event).await
        })
    }

    /// Every attempt at the job, oldest first.
    pub fn attempts(&self, id: JobId) -> StoreFuture<'_, Vec<AttemptRecord>> {
        let attempts = query("SELECT * FROM attempts WHERE job_id = ? ORDER BY number");
        self.call("attempts").run(attempts.bind(id.to_string()).all(&self.readers, rows::attempt))
    }

    /// Cancels a queued job at once, or requests that the worker of a running one stop; `None` if there is no such job.
    pub fn cancel(&self, id: JobId) -> StoreFuture<'_, Option<Cancellation>> {
        self.call("cancel").run(async move {
            // A job whose worker is dead is cancelled at once, without another worker.
            self.reap(self.expired_of(id).await?).await?;
            self.fail_overdue().await?;
            self.write(async move |tx, now| queue::cancel(tx, id, now).await).await
        })
    }

    /// Changes a job's name and labels, if it has the requested version; `None` if there is no such job.
    pub fn change_job(
        &self,
        id: JobId,
        change: JobChange,
        version: Option<u64>,
    ) -> StoreFuture<'_, Option<JobUpdate>> {
        self.call("change_job")
            .run(self.write(async move |tx, _| job_changes::change(tx, id, change, version).await))
    }

    /// Queues a new job of this one's dataset for the same project, with its options or others. It must have failed or been cancelled, or
    /// have succeeded with other options; `None` if there is no such job. Errors as in [`Store::create_job`].
    pub fn retry_job(&self, id: JobId, request: RetryRequest) -> StoreFuture<'_, Option<RetryOutcome>> {
        self.call("retry_job").run(self.write(async move |tx, now| {
            Ok(match job_changes::retry_of(tx, id, request).await? {
                None => None,
                Some(Err(refused)) => Some(refused),
                Some(Ok(new)) => Some(RetryOutcome::Created(Box::new(self.insert_job(tx, new, now).await?))),
            })
        }))
    }

    /// Deletes a job that has ended, with its events, attempts and references to blobs, if it has the requested version; `None` if there
    /// is no such job.
    pub fn delete_job(&self, id: JobId, version: Option<u64>) -> StoreFuture<'_, Option<Deletion>> {
        self.call("delete_job").run(async move {
            // A job whose worker is dead can be deleted at once, as it can be cancelled.
            self.reap(self.expired_of(id).await?).await?;
            self.write(async move |tx, _| job_changes::delete(tx, id, version).await).await
        })
    }

    /// Fails queued jobs whose deadline has passed, and counts them. Running ones learn it from [`Store::heartbeat`].
    pub fn fail_expired(&self) -> StoreFuture<'_, u64> {
        self.call("fail_expired").run(self.fail_overdue())
    }

    /// Those of the jobs whose checkpoints may still be used: by themselves, by a retry that is queued or running, also if they are
    /// deleted, or by one that is made within [`QueuePolicy::checkpoint_ttl`] after they failed or were cancelled.
    pub fn resumable<'a>(&'a self, jobs: &'a [JobId]) -> StoreFuture<'a, Vec<JobId>> {
        self.call("resumable").run(async move {
            let now = self.now(&self.readers).await?;
            let mut resumable = query("SELECT id FROM jobs WHERE id IN ");
            resumable.push(MEMBERS).push(
                " AND (state IN ('queued', 'running') OR (state IN ('failed', 'cancelled') AND finished_at > ?))
                 UNION SELECT resume_from FROM jobs WHERE resume_from IN ",
            );
            resumable.push(MEMBERS).push(" AND state IN ('queued', 'running') ORDER BY id");
            let jobs = text(&jobs)?;
            resumable
                .bind_all(values![&jobs, micros(rows::before(now, self.policy.checkpoint_ttl)), &jobs])
                .all(&self.readers, rows::job_id)
                .await
        })
    }

    /// Grants `worker` a job that is due and needs no preparation that the worker cannot do: of projects that run fewer jobs than they may, those with the highest priority; of these, one of
    /// the project with the fewest running jobs, or of those the one whose latest claim is longest ago; the oldest first. Expires leases
    /// first, as [`Store::expire_leases`].
    pub fn claim<'a>(&'a self, worker: impl Into<Claimant<'a>>) -> StoreFuture<'a, Option<Claim>> {
        let Claimant { id, can } = worker.into();
        self.call("claim").run(async move {
            let claimed = self.claim_next(id, can).await;
            self.track_lease(claimed.map(Option::unzip))
        })
    }

    /// Makes `dataset`, an archive that is already published, the dataset of the job: it has the cameras of the job's photographs.
    pub fn use_posed_dataset<'a>(&'a self, lease: &'a Lease, dataset: BlobRef) -> StoreFuture<'a, ()> {
        self.call("use_posed_dataset")
            .run(self.write(async move |tx, now| queue::use_posed_dataset(tx, lease, dataset, now).await))
    }

    /// Makes these the job's preview and the photograph beside it, instead of those before.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`].
    pub fn set_preview<'a>(&'a self, lease: &'a Lease, pictures: [BlobRef; 2]) -> StoreFuture<'a, ()> {
        self.call("set_preview")
            .run(self.write(async move |tx, now| queue::set_preview(tx, lease, pictures, now).await))
    }

    /// Renews a lease, and returns whether the job is to stop.
    pub fn heartbeat<'a>(&'a self, lease: &'a Lease) -> StoreFuture<'a, Heartbeat> {
        self.call("heartbeat").run(async move {
            let renewed =
                self.write(async move |tx, now| queue::heartbeat(tx, &self.policy, lease, now).await).await;
            self.track_lease(renewed.map(|(row, heartbeat)| (Some(row), heartbeat)))
        })
    }

    /// Records the attempt's phase and progress. Every change of phase adds an event; progress at most one per
    /// [`QueuePolicy::progress_event_every`].
    pub fn report<'a>(
        &'a self,
        lease: &'a Lease,
        phase: Phase,
        progress: &'a Progress,
    ) -> StoreFuture<'a, ()> {
        self.call("report").run(
            self.write(async move |tx, now| {
                queue::report(tx, &self.policy, lease, phase, progress, now).await
            }),
        )
    }

    /// Ends the attempt, and returns the job's new state.
    pub fn finish<'a>(&'a self, lease: &'a Lease, outcome: Outcome) -> StoreFuture<'a, JobState> {
        self.call("finish").run(self.write(async move |tx, now| {
            let state = queue::finish(tx, &self.policy, lease, outcome, now).await?;
            if state == JobState::Succeeded {
                reach(FailurePoint::BeforeCommit);
            }
            Ok(state)
        }))
    }

    /// Ends all attempts of a worker that is known to be dead, and counts them.
    pub fn expire_worker<'a>(&'a self, worker: &'a str, death: WorkerDeath) -> StoreFuture<'a, u64> {
        self.call("expire_worker").run(
            self.write(async move |tx, now| queue::expire_worker(tx, &self.policy, worker, death, now).await),
        )
    }

    /// Ends all attempts whose leases expired under this process's observation, and counts them. To be called often: renewals between two
    /// calls are not observed.
    pub fn expire_leases(&self) -> StoreFuture<'_, u64> {
        self.call("expire_leases").run(async move {
            let expired = self.reap_expired().await;
            self.track_lease(expired.map(|count| (None, count)))
        })
    }

    /// Changes of a kind from now on, as far as the database tells of them.
    pub fn changes(&self, kind: ChangeKind) -> Changes {
        self.listener.get_or_init(|| Listener::start(&self.readers)).changes(kind)
    }

    /// Whether any job is running.
    pub fn has_running_job(&self) -> StoreFuture<'_, bool> {
        self.call("has_running_job")
            .run(async move { Ok(query(ANY_RUNNING).optional(&self.readers, |_| Ok(())).await?.is_some()) })
    }

    /// One round trip to the database.
    pub fn ping(&self) -> StoreFuture<'_, ()> {
        self.call("ping").run(async move {
            query("SELECT 1").fetch_one(&self.readers).await?;
            Ok(())
        })
    }
}
