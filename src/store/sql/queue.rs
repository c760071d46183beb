//! The queue: claims, leases and the ends of attempts. Each function runs within its caller's transaction.

use super::{
    db::{Pool, Row, Sql, Target, Transaction, query, values},
    events::append,
    insert_blob, locks,
    rows::{self, after, json as text, micros, name},
    select_job,
};
use crate::{
    domain::{
        CameraSearchOptions, Digest, EventKind, JobId, JobMetrics, JobState, Phase, Preparation, Problem,
        Progress, ProjectId,
    },
    store::{
        ArtifactKind, AttemptRecord, BlobRef, Cancellation, Claim, Heartbeat, Lease, MAX_QUEUE_POSITION,
        Outcome, QueuePolicy, SHOWN_ATTEMPTS, StoreError, WorkerDeath,
        leases::LeaseRow,
        retry::{AttemptEnd, AttemptState, NextState, decide},
    },
};
use jiff::Timestamp;
use serde_json::{Value, json};

/// The leases of all running jobs.
pub(super) async fn leases(pool: &Pool) -> Result<Vec<LeaseRow>, StoreError> {
    query("SELECT id, attempt, lease_until FROM jobs WHERE state = 'running'").all(pool, rows::lease).await
}

/// Ends the attempts whose leases have expired, unless they were renewed meanwhile, and counts them.
pub(super) async fn reap(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    expired: &[(LeaseRow, WorkerDeath)],
    now: Timestamp,
) -> Result<u64, StoreError> {
    let jobs: Vec<JobId> = expired.iter().map(|(lease, _)| lease.job).collect();
    locks::jobs(connection, &jobs).await?;
    let mut count = 0;
    for (lease, death) in expired {
        let lost = query(
            "SELECT * FROM jobs WHERE id = ? AND attempt = ? AND lease_until = ? AND state = 'running'",
        )
        .for_update()
        .bind_all(values![lease.job.to_string(), lease.attempt, lease.until])
        .fetch_all(&mut *connection)
        .await?;
        count += end_lost(connection, policy, &lost, *death, now).await?;
    }
    Ok(count)
}

/// Ends every attempt of one worker.
pub(super) async fn expire_worker(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    worker: &str,
    death: WorkerDeath,
    now: Timestamp,
) -> Result<u64, StoreError> {
    let selected = "SELECT project FROM jobs WHERE state = 'running' AND lease_owner = ";
    locks::projects(connection, selected, worker).await?;
    let lost = query("SELECT * FROM jobs WHERE state = 'running' AND lease_owner = ?")
        .for_update()
        .bind(worker)
        .fetch_all(&mut *connection)
        .await?;
    end_lost(connection, policy, &lost, death, now).await
}

async fn end_lost(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    lost: &[Row],
    death: WorkerDeath,
    now: Timestamp,
) -> Result<u64, StoreError> {
    for row in lost {
        end_attempt(connection, policy, &rows::attempt_state(row, now)?, AttemptEnd::Lost(death), now)
            .await?;
    }
    Ok(lost.len() as u64)
}

/// The next job that is due at `?1` and needs at most the preparation `?3`, where projects without a limit of their own run at most `?2` jobs. Each project offers its best one,
/// found through an index, so the cost grows with the projects that have queued jobs, not with those.
const NEXT: Sql = Sql {
    sqlite: "
    SELECT best.id, totals.project FROM project_totals AS totals
    JOIN projects ON projects.id = totals.project
    JOIN jobs AS best ON best.id = (
        SELECT waiting.id FROM jobs AS waiting INDEXED BY jobs_to_claim
        WHERE waiting.project = totals.project AND waiting.state = 'queued'
            AND (waiting.run_after <= ?1 OR waiting.waits_since > ?1) AND waiting.needs <= ?3
        ORDER BY waiting.priority DESC, waiting.created_at, waiting.id LIMIT 1)
    WHERE totals.queued_jobs > 0
        AND totals.running_jobs < COALESCE(projects.max_running_jobs, ?2, totals.running_jobs + 1)
    ORDER BY best.priority DESC, totals.running_jobs, totals.last_claim, best.created_at, best.id
    LIMIT 1",
    postgres: "
    SELECT best.id, totals.project FROM project_totals AS totals
    JOIN projects ON projects.id = totals.project
    CROSS JOIN LATERAL (
        SELECT waiting.id, waiting.priority, waiting.created_at FROM jobs AS waiting
        WHERE waiting.project = totals.project AND waiting.state = 'queued'
            AND (waiting.run_after <= ?1 OR waiting.waits_since > ?1) AND waiting.needs <= ?3
        ORDER BY waiting.priority DESC, waiting.created_at, waiting.id LIMIT 1) AS best
    WHERE totals.queued_jobs > 0
        AND totals.running_jobs < COALESCE(projects.max_running_jobs, ?2, totals.running_jobs + 1)
    ORDER BY best.priority DESC, totals.running_jobs, totals.last_claim, best.created_at, best.id
    LIMIT 1",
};

/// On PostgreSQL, the next job of project `?4` alone, whose totals are locked, as in [`NEXT`].
const NEXT_OF_PROJECT: &str = "
    SELECT waiting.id FROM jobs AS waiting
    WHERE waiting.project = ?4 AND waiting.state = 'queued' AND (waiting.run_after <= ?1 OR waiting.waits_since > ?1)
        AND waiting.needs <= ?3
        AND EXISTS (
            SELECT 1 FROM project_totals AS totals JOIN projects ON projects.id = totals.project
            WHERE totals.project = ?4
                AND totals.running_jobs < COALESCE(projects.max_running_jobs, ?2, totals.running_jobs + 1))
    ORDER BY waiting.priority DESC, waiting.created_at, waiting.id LIMIT 1
    FOR NO KEY UPDATE OF waiting SKIP LOCKED";

/// Which projects a claim considers, if other transactions have locked some.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RowLock {
    /// Those that no other has locked; locks the one that is found.
    SkipLocked,
    /// All, without locking any.
    None,
}

/// The newest `?2` attempts of job `?1`.
const LATEST_ATTEMPTS: &str = "SELECT * FROM attempts WHERE job_id = ?1 ORDER BY number DESC LIMIT ?2";

/// How many queued jobs, at most `?5`, of project `?1` come before the one with priority `?2`, creation `?3` and identity `?4`.
const AHEAD: Sql = Sql {
    sqlite: "
    SELECT count(*) AS ahead FROM (
        SELECT 1 FROM jobs INDEXED BY jobs_to_claim WHERE project = ?1 AND state = 'queued' AND priority > ?2
        UNION ALL
        SELECT 1 FROM jobs INDEXED BY jobs_to_claim
        WHERE project = ?1 AND state = 'queued' AND priority = ?2 AND (created_at, id) < (?3, ?4)
        LIMIT ?5)",
    postgres: "
    SELECT count(*) AS ahead FROM (
        SELECT 1 FROM jobs WHERE project = ?1 AND state = 'queued' AND priority > ?2
        UNION ALL
        SELECT 1 FROM jobs
        WHERE project = ?1 AND state = 'queued' AND priority = ?2 AND (created_at, id) < (?3, ?4)
        LIMIT ?5) AS before",
};

/// Statements of claims and of every job that is read; their cost must not grow with the number of jobs.
#[cfg(test)]
pub(super) fn statements() -> [Sql; 3] {
    [NEXT, LATEST_ATTEMPTS.into(), AHEAD]
}

/// The job that a claim of a worker that can do `can` would grant now, and its project.
pub(super) async fn next(
    on: impl Into<Target<'_>>,
    policy: &QueuePolicy,
    can: Preparation,
    now: Timestamp,
    lock: RowLock,
) -> Result<Option<(JobId, ProjectId)>, StoreError> {
    let mut next = query(NEXT);
    if lock == RowLock::SkipLocked {
        next.push(Sql { sqlite: "", postgres: " FOR UPDATE OF totals SKIP LOCKED" });
    }
    next.bind_all(values![micros(now), policy.limits.max_running_jobs, rows::preparation_place(can)])
        .optional(on, rows::job_and_project)
        .await
}

/// What a transaction found to claim.
pub(super) enum Claiming<T> {
    Granted(T),
    NothingDue,
    /// Others took what there was in its project. Another transaction, which holds no lock of that project, can look for more.
    Overtaken,
}

/// The job to grant, which the transaction then holds with its project's totals.
async fn take_next(
    tx: &mut Transaction,
    policy: &QueuePolicy,
    can: Preparation,
    now: Timestamp,
) -> Result<Claiming<JobId>, StoreError> {
    if !tx.is_postgres() {
        let next = next(tx, policy, can, now, RowLock::None).await?;
        return Ok(next.map_or(Claiming::NothingDue, |(job, _)| Claiming::Granted(job)));
    }
    let project = match next(&mut *tx, policy, can, now, RowLock::SkipLocked).await? {
        Some((_, project)) => project,
        // All projects with something to claim are locked, for the moment that another claim takes.
        None => match next(&mut *tx, policy, can, now, RowLock::None).await? {
            Some((_, project)) => {
                locks::project(tx, project).await?;
                project
            }
            None => return Ok(Claiming::NothingDue),
        },
    };
    // Another claim may have taken the job that was found before the totals were locked.
    let row = query(NEXT_OF_PROJECT)
        .bind_all(values![micros(now), policy.limits.max_running_jobs, rows::preparation_place(can)])
        .bind(project.to_string())
        .fetch_optional(tx)
        .await?;
    row.map_or(Ok(Claiming::Overtaken), |row| rows::job_id(&row).map(Claiming::Granted))
}

/// The position of a row of `jobs` in its project's queue; `None` unless it is queued.
pub(super) async fn position(connection: &mut Transaction, row: &Row) -> Result<Option<u32>, StoreError> {
    if row.try_get::<&str>("state")? != JobState::Queued.name() {
        return Ok(None);
    }
    let counted = query(AHEAD)
        .bind_all(values![row.try_get::<&str>("project")?, row.try_get::<i64>("priority")?])
        .bind_all(values![row.try_get::<i64>("created_at")?, row.try_get::<&str>("id")?])
        .bind(MAX_QUEUE_POSITION - 1)
        .fetch_one(connection)
        .await?;
    Ok(Some(rows::integer::<u32>(&counted, "ahead")? + 1))
}

/// The newest attempts at a job, oldest first.
pub(super) async fn latest_attempts(
    connection: &mut Transaction,
    job: JobId,
) -> Result<Vec<AttemptRecord>, StoreError> {
    let rows =
        query(LATEST_ATTEMPTS).bind(job.to_string()).bind(SHOWN_ATTEMPTS).fetch_all(connection).await?;
    rows.iter().rev().map(rows::attempt).collect()
}

/// Grants the next job to `worker`, which can do `can`.
pub(super) async fn claim(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    worker: &str,
    can: Preparation,
    now: Timestamp,
) -> Result<Claiming<(LeaseRow, Claim)>, StoreError> {
    let job = match take_next(connection, policy, can, now).await? {
        Claiming::Granted(job) => job,
        Claiming::NothingDue => return Ok(Claiming::NothingDue),
        Claiming::Overtaken => return Ok(Claiming::Overtaken),
    };
    let row = query(
        "UPDATE jobs SET state = 'running', phase = 'ingest', progress = ?1, attempt = attempt + 1,
             charged = charged + 1, lease_owner = ?2, lease_until = ?3, started_at = ?4, progress_event_at = NULL,
             version = version + 1
         WHERE id = ?5
         RETURNING id, attempt, lease_until, dataset, needs, photographs, options, resume_from",
    )
    .bind_all(values![text(&Progress::default())?, worker, micros(after(now, policy.lease)), micros(now)])
    .bind(job.to_string())
    .fetch_one(&mut *connection)
    .await?;
    let attempt: u32 = rows::integer(&row, "attempt")?;
    query("INSERT INTO attempts (job_id, number, worker, started_at) VALUES (?, ?, ?, ?)")
        .bind_all(values![job.to_string(), attempt, worker, micros(now)])
        .execute(&mut *connection)
        .await?;
    let data = json!({ "state": JobState::Running });
    append(connection, job, EventKind::State, attempt, &data, now).await?;
    append(connection, job, EventKind::Phase, attempt, &json!({ "phase": Phase::Ingest }), now).await?;
    let claim = Claim {
        lease: Lease { job, attempt, worker: worker.to_owned() },
        dataset: rows::dataset(&row)?,
        needs: rows::preparation(&row, "needs")?,
        is_posed: row.try_get::<Option<&str>>("photographs")?.is_some(),
        options: rows::options(&row)?,
        resume_from: rows::resume_from(&row)?,
    };
    Ok(Claiming::Granted((rows::lease(&row)?, claim)))
}

/// Cancels a queued job, or requests that a running one stop.
pub(super) async fn cancel(
    connection: &mut Transaction,
    id: JobId,
    now: Timestamp,
) -> Result<Option<Cancellation>, StoreError> {
    locks::job(connection, id).await?;
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    let (change, data) = match record.job.state {
        JobState::Cancelled => return Ok(Some(Cancellation::Done(record))),
        JobState::Succeeded | JobState::Failed => return Ok(Some(Cancellation::TooLate(record))),
        JobState::Running if record.job.cancel_requested => return Ok(Some(Cancellation::Requested(record))),
        JobState::Running => (
            "UPDATE jobs SET cancel_requested_at = ?1, version = version + 1 WHERE id = ?2",
            json!({ "state": JobState::Running, "cancel_requested": true }),
        ),
        JobState::Queued => (
            "UPDATE jobs SET state = 'cancelled', phase = 'done', cancel_requested_at = ?1, finished_at = ?1,
                 version = version + 1
             WHERE id = ?2",
            json!({ "state": JobState::Cancelled }),
        ),
    };
    query(change).bind(micros(now)).bind(id.to_string()).execute(&mut *connection).await?;
    append(connection, id, EventKind::State, record.job.attempt, &data, now).await?;
    let was_queued = record.job.state == JobState::Queued;
    let record = select_job(connection, id).await?.ok_or(sqlx::Error::RowNotFound)?;
    Ok(Some(if was_queued { Cancellation::Done(record) } else { Cancellation::Requested(record) }))
}

fn lease_lost(lease: &Lease) -> StoreError {
    StoreError::LeaseLost { job: lease.job, attempt: lease.attempt }
}

/// Renews the lease. Successive renewals always differ in `lease_until`, whatever the clock does: that is how the lease watch
/// recognizes them.
pub(super) async fn heartbeat(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    lease: &Lease,
    now: Timestamp,
) -> Result<(LeaseRow, Heartbeat), StoreError> {
    let row = query(
        "UPDATE jobs SET lease_until = CASE WHEN lease_until = ?1 THEN ?1 + 1 ELSE ?1 END
         WHERE id = ?2 AND attempt = ?3 AND lease_owner = ?4 AND state = 'running'
         RETURNING id, attempt, lease_until, cancel_requested_at, deadline_at",
    )
    .bind_all(values![micros(after(now, policy.lease)), lease.job.to_string(), lease.attempt, &lease.worker])
    .fetch_optional(connection)
    .await?
    .ok_or_else(|| lease_lost(lease))?;
    let deadline: Option<i64> = row.try_get("deadline_at")?;
    let heartbeat = Heartbeat {
        cancel_requested: row.try_get::<Option<i64>>("cancel_requested_at")?.is_some(),
        deadline_passed: deadline.is_some_and(|deadline| deadline <= micros(now)),
    };
    Ok((rows::lease(&row)?, heartbeat))
}

/// Records phase and progress.
pub(super) async fn report(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    lease: &Lease,
    phase: Phase,
    progress: &Progress,
    now: Timestamp,
) -> Result<(), StoreError> {
    let row = leased_job(connection, lease).await?;
    let phase_name = name(&phase)?;
    let phase_changed = row.try_get::<String>("phase")? != phase_name;
    let last_event: Option<i64> = row.try_get("progress_event_at")?;
    let every = i64::try_from(policy.progress_event_every.as_micros()).unwrap_or(i64::MAX);
    // A clock that was set back must not delay the next event.
    let due = last_event.is_none_or(|last| micros(now).saturating_sub(last).saturating_abs() >= every);
    query(
        "UPDATE jobs SET phase = ?1, progress = ?2, version = version + 1,
             checkpoint_step = CASE WHEN checkpoint_step < ?3 THEN ?3 ELSE checkpoint_step END, progress_event_at = CASE WHEN ?4 THEN ?5 ELSE progress_event_at END
         WHERE id = ?6",
    )
    .bind_all(values![phase_name, text(progress)?, rows::signed(progress.checkpoint_step), due, micros(now)])
    .bind(lease.job.to_string())
    .execute(&mut *connection)
    .await?;
    if phase_changed {
        let data = json!({ "phase": phase });
        append(connection, lease.job, EventKind::Phase, lease.attempt, &data, now).await?;
    }
    if due {
        let data = serde_json::to_value(progress).unwrap_or(Value::Null);
        append(connection, lease.job, EventKind::Progress, lease.attempt, &data, now).await?;
    }
    Ok(())
}

/// Makes `dataset`, which has the cameras of the job's photographs, the dataset of the job. That is progress of its attempt, as a checkpoint
/// is.
pub(super) async fn use_posed_dataset(
    connection: &mut Transaction,
    lease: &Lease,
    dataset: BlobRef,
    now: Timestamp,
) -> Result<(), StoreError> {
    locks::job(connection, lease.job).await?;
    leased_job(connection, lease).await?;
    insert_blob(connection, dataset, now).await?;
    query(
        "UPDATE jobs SET photographs = dataset, dataset = ?, needs = 0, checkpoint_step = checkpoint_step + 1, version = version + 1
         WHERE id = ?",
    )
    .bind_all(values![dataset.digest.to_string(), lease.job.to_string()])
    .execute(connection)
    .await?;
    Ok(())
}

/// Replaces the pictures of a job in training.
pub(super) async fn set_preview(
    connection: &mut Transaction,
    lease: &Lease,
    [preview, photograph]: [BlobRef; 2],
    now: Timestamp,
) -> Result<(), StoreError> {
    locks::job(connection, lease.job).await?;
    leased_job(connection, lease).await?;
    remove_preview(connection, lease.job).await?;
    for (kind, blob) in [(ArtifactKind::Preview, preview), (ArtifactKind::PreviewPhotograph, photograph)] {
        insert_blob(connection, blob, now).await?;
        query("INSERT INTO artifacts (job_id, kind, place, digest, attempt) VALUES (?, ?, 0, ?, ?)")
            .bind_all(values![lease.job.to_string(), kind.name(), blob.digest.to_string(), lease.attempt])
            .execute(&mut *connection)
            .await?;
    }
    query("UPDATE jobs SET version = version + 1 WHERE id = ?")
        .bind(lease.job.to_string())
        .run(connection)
        .await
}

async fn remove_preview(connection: &mut Transaction, job: JobId) -> Result<(), StoreError> {
    query("DELETE FROM artifacts WHERE job_id = ? AND kind IN ('preview', 'preview_photograph')")
        .bind(job.to_string())
        .run(connection)
        .await
}

/// Of the latest jobs of the same photographs, how many are asked for a search by the same options.
const EARLIER_SEARCHES: u32 = 64;

/// The dataset with the cameras of photographs that one of the latest jobs of the project found before, by the same search.
pub(super) async fn posed_dataset(
    connection: &mut Transaction,
    project: ProjectId,
    photographs: Digest,
    search: &CameraSearchOptions,
) -> Result<Option<BlobRef>, StoreError> {
    let found = query(
        "SELECT jobs.dataset, blobs.bytes, jobs.options FROM jobs JOIN blobs ON blobs.digest = jobs.dataset
         WHERE jobs.project = ? AND jobs.photographs = ? ORDER BY jobs.created_at DESC LIMIT ?",
    )
    .bind_all(values![project.to_string(), photographs.to_string(), EARLIER_SEARCHES])
    .fetch_all(connection)
    .await?;
    for row in &found {
        if rows::options(row)?.camera_search() == *search {
            return rows::blob(row, "dataset").map(Some);
        }
    }
    Ok(None)
}

/// The job's row if the lease is held; else [`StoreError::LeaseLost`].
pub(super) async fn leased_job(connection: &mut Transaction, lease: &Lease) -> Result<Row, StoreError> {
    let row =
        query("SELECT * FROM jobs WHERE id = ? AND attempt = ? AND lease_owner = ? AND state = 'running'")
            .for_update()
            .bind_all(values![lease.job.to_string(), lease.attempt, &lease.worker])
            .fetch_optional(connection)
            .await?;
    row.ok_or_else(|| lease_lost(lease))
}

/// Ends the attempt with the outcome that its worker reports.
pub(super) async fn finish(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    lease: &Lease,
    outcome: Outcome,
    now: Timestamp,
) -> Result<JobState, StoreError> {
    locks::job(connection, lease.job).await?;
    let row = leased_job(connection, lease).await?;
    let mut attempt_state = rows::attempt_state(&row, now)?;
    if matches!(outcome, Outcome::Held(_)) {
        attempt_state.holds = holds_before(connection, lease).await?;
    }
    end_attempt(connection, policy, &attempt_state, AttemptEnd::Reported(outcome), now).await
}

/// The attempts in a row before this one that were held: unlike those that a stopping worker released, they have a cause.
async fn holds_before(connection: &mut Transaction, lease: &Lease) -> Result<u32, StoreError> {
    let row = query(
        "SELECT count(*) AS holds FROM attempts
         WHERE job_id = ?1 AND number < ?2 AND number > COALESCE(
             (SELECT max(number) FROM attempts
              WHERE job_id = ?1 AND number < ?2 AND (outcome <> 'released' OR cause IS NULL)), 0)",
    )
    .bind_all(values![lease.job.to_string(), lease.attempt])
    .fetch_one(connection)
    .await?;
    rows::integer(&row, "holds")
}

async fn end_attempt(
    connection: &mut Transaction,
    policy: &QueuePolicy,
    attempt_state: &AttemptState,
    end: AttemptEnd,
    now: Timestamp,
) -> Result<JobState, StoreError> {
    let (outcome, cause, next) = decide(policy, attempt_state, end);
    let (job, attempt) = (attempt_state.job, attempt_state.attempt);
    query("UPDATE attempts SET ended_at = ?, outcome = ?, cause = ? WHERE job_id = ? AND number = ?")
        .bind_all(values![micros(now), outcome.name(), cause.as_ref().map(text).transpose()?])
        .bind_all(values![job.to_string(), attempt])
        .execute(&mut *connection)
        .await?;
    let end = match next {
        NextState::Requeue { delay, refund, losses } => {
            let run_after = after(now, delay);
            query(
                "UPDATE jobs SET state = 'queued', phase = 'queued', run_after = ?, waits_since = ?, charged = charged - ?,
                     silent_deaths = ?, setbacks = ?, setback_step = checkpoint_step, lease_owner = NULL, lease_until = NULL, version = version + 1
                 WHERE id = ?",
            )
            .bind_all(values![micros(run_after), micros(now), i64::from(refund), losses.alone])
            .bind_all(values![losses.with_service, job.to_string()])
            .execute(&mut *connection)
            .await?;
            let data = json!({ "outcome": outcome.name(), "cause": cause, "run_after": run_after });
            append(connection, job, EventKind::Attempt, attempt, &data, now).await?;
            let data = json!({ "state": JobState::Queued });
            append(connection, job, EventKind::State, attempt, &data, now).await?;
            return Ok(JobState::Queued);
        }
        NextState::Succeed { metrics, artifacts } => {
            remove_preview(connection, job).await?;
            for (number, artifact) in artifacts.iter().enumerate() {
                insert_blob(connection, artifact.blob, now).await?;
                let before = artifacts[..number].iter();
                let place = before.filter(|other| other.kind == artifact.kind).count();
                query(
                    "INSERT INTO artifacts (job_id, kind, place, lambda, digest, attempt) VALUES (?, ?, ?, ?, ?, ?)",
                )
                .bind_all(values![job.to_string(), artifact.kind.name(), place as i64, artifact.lambda])
                .bind_all(values![artifact.blob.digest.to_string(), attempt])
                .execute(&mut *connection)
                .await?;
            }
            JobEnd { state: JobState::Succeeded, metrics: Some(metrics), error: None }
        }
        NextState::Fail(problem) => JobEnd { state: JobState::Failed, metrics: None, error: Some(problem) },
        NextState::Cancel => JobEnd { state: JobState::Cancelled, metrics: None, error: None },
    };
    end_job(connection, job, attempt, &end, now).await?;
    Ok(end.state)
}

/// The end of a job: its terminal state with what belongs to it.
pub(super) struct JobEnd {
    pub(super) state: JobState,
    pub(super) metrics: Option<Box<JobMetrics>>,
    pub(super) error: Option<Problem>,
}

/// Writes the end of a job, and appends its event.
pub(super) async fn end_job(
    connection: &mut Transaction,
    job: JobId,
    attempt: u32,
    end: &JobEnd,
    now: Timestamp,
) -> Result<(), StoreError> {
    query(
        "UPDATE jobs SET state = ?, phase = 'done', lease_owner = NULL, lease_until = NULL, metrics = ?, error = ?,
             finished_at = ?, version = version + 1
         WHERE id = ?",
    )
    .bind_all(values![end.state.name(), end.metrics.as_ref().map(text).transpose()?])
    .bind_all(values![end.error.as_ref().map(text).transpose()?, micros(now), job.to_string()])
    .execute(&mut *connection)
    .await?;
    let mut data = json!({ "state": end.state });
    if let Some(error) = &end.error {
        data["error"] = json!(error);
    }
    append(connection, job, EventKind::State, attempt, &data, now).await
}
