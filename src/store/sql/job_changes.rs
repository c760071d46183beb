//! Changes to jobs outside of attempts: expired deadlines, retries, deletion. Each function runs within its caller's transaction.

use super::{
    datasets,
    db::{Transaction, query, values},
    locks,
    queue::{JobEnd, end_job},
    rows::{self, json, micros},
    select_job,
};
use crate::{
    domain::{JobId, JobState, Preparation},
    store::{
        Deletion, JobChange, JobUpdate, NewJob, RetryOutcome, RetryRequest, StoreError,
        retry::deadline_exceeded,
    },
};
use jiff::Timestamp;

/// Fails every queued job whose deadline has passed, and counts them.
pub(super) async fn fail_expired(connection: &mut Transaction, now: Timestamp) -> Result<u64, StoreError> {
    let selected = "SELECT project FROM jobs WHERE state = 'queued' AND deadline_at <= ";
    locks::projects(connection, selected, micros(now)).await?;
    let late = query("SELECT id, attempt, deadline_at FROM jobs WHERE state = 'queued' AND deadline_at <= ?")
        // A project that has such a job only since the locks were taken may be granting it.
        .for_update()
        .bind(micros(now))
        .fetch_all(&mut *connection)
        .await?;
    for row in &late {
        let (job, attempt) = (rows::job_id(row)?, rows::integer(row, "attempt")?);
        let error = Some(deadline_exceeded(rows::deadline(row)?, attempt));
        let end = JobEnd { state: JobState::Failed, metrics: None, error };
        end_job(connection, job, attempt, &end, now).await?;
    }
    Ok(late.len() as u64)
}

/// The job that retries `id`, or why it cannot be retried; `None` if there is no such job.
pub(super) async fn retry_of(
    connection: &mut Transaction,
    id: JobId,
    request: RetryRequest,
) -> Result<Option<Result<NewJob, RetryOutcome>>, StoreError> {
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    let RetryRequest { id: new, key, from_checkpoint, options, change, deadline_at, intent } = request;
    let is_retryable = match record.job.state {
        JobState::Failed | JobState::Cancelled => true,
        // The same job again would make the same file.
        JobState::Succeeded => options.is_some(),
        JobState::Queued | JobState::Running => false,
    };
    if !is_retryable {
        return Ok(Some(Err(RetryOutcome::NotRetryable(record.job.state))));
    }
    let options = options.unwrap_or_else(|| record.job.options.clone());
    // A job that never ran has left the checkpoint where it was.
    let source = record.resume_from.filter(|_| record.job.attempt == 0).unwrap_or(id);
    let (mut dataset, mut needs, mut photographs) = (record.dataset, record.needs, record.photographs);
    if let Some(of) = photographs
        && options.camera_search() != record.job.options.camera_search()
    {
        // Cameras that another search found are not those that this one finds.
        let Some(given) = datasets::of_photographs(connection, record.dataset_id, of).await? else {
            return Ok(Some(Err(RetryOutcome::NoPhotographs)));
        };
        (dataset, needs, photographs) = (given.dataset, Preparation::of(given.summary.layout), None);
    }
    Ok(Some(Ok(NewJob {
        project: record.project,
        key,
        name: change.name.unwrap_or(record.name),
        metadata: change.metadata.unwrap_or(record.metadata),
        dataset_id: record.dataset_id,
        retry_of: Some(id),
        deadline_at,
        priority: record.priority,
        resume_from: from_checkpoint.then_some(source),
        intent,
        needs,
        photographs,
        ..NewJob::new(new, options, dataset)
    })))
}

/// Changes a job's name and labels, if it has the requested version; `None` if there is no such job.
pub(super) async fn change(
    connection: &mut Transaction,
    id: JobId,
    change: JobChange,
    version: Option<u64>,
) -> Result<Option<JobUpdate>, StoreError> {
    locks::job(connection, id).await?;
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    if version.is_some_and(|version| version != record.job.version) {
        return Ok(Some(JobUpdate::VersionMismatch));
    }
    let name = change.name.unwrap_or_else(|| record.name.clone());
    let metadata = change.metadata.unwrap_or_else(|| record.metadata.clone());
    if (&name, &metadata) == (&record.name, &record.metadata) {
        return Ok(Some(JobUpdate::Changed(Box::new(record))));
    }
    query("UPDATE jobs SET name = ?, metadata = ?, version = version + 1 WHERE id = ?")
        .bind_all(values![&name, json(&metadata)?, id.to_string()])
        .execute(&mut *connection)
        .await?;
    let changed = select_job(connection, id).await?.ok_or(sqlx::Error::RowNotFound)?;
    Ok(Some(JobUpdate::Changed(Box::new(changed))))
}

/// Deletes a job that has ended, with everything but its blobs.
pub(super) async fn delete(
    connection: &mut Transaction,
    id: JobId,
    version: Option<u64>,
) -> Result<Option<Deletion>, StoreError> {
    locks::job(connection, id).await?;
    let Some(record) = select_job(connection, id).await? else { return Ok(None) };
    if version.is_some_and(|version| version != record.job.version) {
        return Ok(Some(Deletion::VersionMismatch));
    }
    if !record.job.state.is_terminal() {
        return Ok(Some(Deletion::Active(record.job.state)));
    }
    remove(connection, id).await?;
    Ok(Some(Deletion::Deleted))
}

/// Deletes a job if it is there and has ended, and counts it. The totals of its project are locked.
pub(super) async fn remove(connection: &mut Transaction, id: JobId) -> Result<u64, StoreError> {
    // The schema would clear the reference too, but not raise the version of those rows.
    query("UPDATE jobs SET retry_of = NULL, version = version + 1 WHERE retry_of = ?")
        .bind(id.to_string())
        .execute(&mut *connection)
        .await?;
    let dataset = query("SELECT scene FROM jobs WHERE id = ?").bind(id.to_string());
    let dataset = dataset.fetch_optional(&mut *connection).await?;
    let dataset = dataset.map(|row| rows::dataset_id(&row)).transpose()?.flatten();
    let removed = query("DELETE FROM jobs WHERE id = ? AND finished_at IS NOT NULL")
        .bind(id.to_string())
        .execute(&mut *connection)
        .await?;
    if let Some(dataset) = dataset {
        datasets::remove_unused(connection, dataset).await?;
    }
    Ok(removed)
}
