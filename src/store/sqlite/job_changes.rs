//! What becomes of jobs besides being worked at: given up when their time is over, repeated, deleted. Each function is a part
//! of its caller's transaction.

use jiff::Timestamp;
use serde_json::json;
use sqlx::{Row as _, SqliteConnection};

use super::{
    events::append,
    rows::{self, json as text, micros},
    select_job,
};
use crate::{
    domain::{EventKind, JobId, JobState},
    store::{Deletion, NewJob, RetryRequest, StoreError, retry::deadline_exceeded},
};

/// Fails every queued job whose deadline has passed, and counts them.
pub(super) async fn fail_expired(
    connection: &mut SqliteConnection,
    now: Timestamp,
) -> Result<u64, StoreError> {
    let late =
        sqlx::query("SELECT id, attempt, deadline_at FROM jobs WHERE state = 'queued' AND deadline_at <= ?")
            .bind(micros(now))
            .fetch_all(&mut *connection)
            .await?;
    for row in &late {
        let (job, attempt) = (rows::job_id(row)?, row.try_get("attempt")?);
        let problem = deadline_exceeded(rows::deadline(row)?, attempt);
        sqlx::query(
            "UPDATE jobs SET state = 'failed', phase = 'done', error = ?, finished_at = ?, version = version + 1
             WHERE id = ?",
        )
        .bind(text(&problem)?)
        .bind(micros(now))
        .bind(job.to_string())
        .execute(&mut *connection)
        .await?;
        let data = json!({ "state": JobState::Failed, "error": problem });
        append(connection, job, EventKind::State, attempt, &data, now).await?;
    }
    Ok(late.len() as u64)
}

/// The job that repeats `id`, or in what state that is if it cannot be repeated; `None` if there is no such job.
pub(super) async fn retry_of(
    connection: &mut SqliteConnection,
    id: JobId,
    repeat: RetryRequest,
) -> Result<Option<Result<NewJob, JobState>>, StoreError> {
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    if !matches!(record.job.state, JobState::Failed | JobState::Cancelled) {
        return Ok(Some(Err(record.job.state)));
    }
    let RetryRequest { id: new, from_checkpoint, deadline_at, intent } = repeat;
    Ok(Some(Ok(NewJob {
        owner: record.owner,
        scene: record.scene,
        retry_of: Some(id),
        deadline_at,
        priority: record.priority,
        from_checkpoint,
        intent,
        ..NewJob::new(new, record.job.options, record.dataset)
    })))
}

/// Deletes a job that has ended, with all that belongs to it but its blobs.
pub(super) async fn delete(
    connection: &mut SqliteConnection,
    id: JobId,
    version: Option<u64>,
) -> Result<Option<Deletion>, StoreError> {
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    if version.is_some_and(|version| version != record.job.version) {
        return Ok(Some(Deletion::VersionMismatch));
    }
    if !record.job.state.is_terminal() {
        return Ok(Some(Deletion::Active(record.job.state)));
    }
    // The schema would forget the reference too, but not that those rows have changed.
    for statement in [
        "UPDATE jobs SET retry_of = NULL, version = version + 1 WHERE retry_of = ?",
        "DELETE FROM jobs WHERE id = ?",
    ] {
        sqlx::query(statement).bind(id.to_string()).execute(&mut *connection).await?;
    }
    Ok(Some(Deletion::Deleted))
}
