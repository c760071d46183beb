//! A job's numbered events.

use super::{
    db::{Transaction, query, values},
    rows::{json, micros, name},
    webhooks,
};
use crate::{
    domain::{EventKind, JobId, JobState},
    store::StoreError,
};
use jiff::Timestamp;
use serde_json::Value;

/// Appends an event within the caller's transaction, with the job's next number.
pub(super) async fn append(
    connection: &mut Transaction,
    job: JobId,
    kind: EventKind,
    attempt: u32,
    data: &Value,
    now: Timestamp,
) -> Result<(), StoreError> {
    let row = query("UPDATE jobs SET last_seq = last_seq + 1 WHERE id = ? RETURNING last_seq")
        .bind(job.to_string())
        .fetch_one(&mut *connection)
        .await?;
    let seq: i64 = row.try_get("last_seq")?;
    query("INSERT INTO events (job_id, seq, at, kind, attempt, data) VALUES (?, ?, ?, ?, ?, ?)")
        .bind_all(values![job.to_string(), seq, micros(now), name(&kind)?, attempt, json(data)?])
        .execute(&mut *connection)
        .await?;
    // Here rather than at each change of state, so that no change can omit it.
    if let Some(state) = entered(kind, data) {
        webhooks::enqueue_deliveries(connection, job, state, attempt, u64::try_from(seq).unwrap_or(0), now)
            .await?;
    }
    Ok(())
}

/// The state that the job enters with this event, if any.
fn entered(kind: EventKind, data: &Value) -> Option<JobState> {
    if kind != EventKind::State || data.get("cancel_requested").is_some() {
        return None;
    }
    data.get("state")?.as_str()?.parse().ok()
}
