//! Removal of what is kept for a time only.

use std::time::Duration;

use super::{
    Store,
    db::{Query, query, values},
    job_changes, locks,
    rows::{self, before, micros},
    webhooks::DELIVERY_TTL,
};
use crate::{
    domain::JobId,
    store::{PageKey, RemovedJobs, StoreFuture},
};
use jiff::Timestamp;

/// Jobs per transaction. A job has up to 1000 points of its series and some hundred events.
const JOBS: usize = 10;

/// Other rows per transaction.
const RECORDS: i64 = 500;

/// Up to [`JOBS`] jobs that ended before `end`, in the order of their creation. Whatever ended before was created before, so the index by age
/// finds them: it passes over older jobs that have not ended.
pub(super) fn ended_jobs(end: Timestamp, after: Option<PageKey>) -> Query {
    let mut list = query("SELECT id, created_at FROM jobs WHERE finished_at < ");
    list.push_bind(micros(end)).push(" AND created_at < ").push_bind(micros(end));
    if let Some(after) = after {
        list.push(" AND (created_at, id) > (").push_bind(micros(after.created_at));
        list.push(", ").push_bind(after.id.to_string()).push(")");
    }
    list.push(" ORDER BY created_at, id LIMIT ").push_bind(JOBS as i64);
    list
}

/// Deletes rows of requests that were answered before `?`.
pub(super) const EXPIRED_REQUESTS: &str =
    "DELETE FROM idempotency WHERE created_at <= ?1 AND (project, key) IN
    (SELECT project, key FROM idempotency WHERE created_at <= ?1 ORDER BY created_at LIMIT ?2)";

/// Deletes messages that have ended and were made before `?1`, or whose job is gone before `?2`. One that is to be delivered again meanwhile
/// stays, which the outer condition sees on PostgreSQL.
pub(super) const EXPIRED_MESSAGES: &str = "DELETE FROM webhook_deliveries WHERE state <> 'pending' AND seq IN
    (SELECT seq FROM webhook_deliveries
     WHERE state <> 'pending' AND created_at < ?2
         AND (created_at < ?1 OR NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = webhook_deliveries.job))
     ORDER BY created_at LIMIT ?3)";

impl Store {
    /// Removes some of the jobs that ended longer ago than `keep`, oldest first, of those created after `after`: each with its events,
    /// attempts, series, artifacts and exports.
    pub fn remove_ended_jobs(&self, keep: Duration, after: Option<PageKey>) -> StoreFuture<'_, RemovedJobs> {
        self.call("remove_ended_jobs").run(async move {
            let end = before(self.now(&self.readers).await?, keep);
            let rows = ended_jobs(end, after).fetch_all(&self.readers).await?;
            let ids = rows.iter().map(rows::job_id).collect::<Result<Vec<JobId>, _>>()?;
            let next = match rows.last() {
                Some(row) if rows.len() == JOBS => Some(PageKey {
                    created_at: rows::instant("created_at", row.try_get("created_at")?)?,
                    id: rows::job_id(row)?,
                }),
                _ => None,
            };
            if ids.is_empty() {
                return Ok(RemovedJobs::default());
            }
            self.write(async move |tx, _| {
                locks::jobs(tx, &ids).await?;
                let mut count = 0;
                for id in ids {
                    count += job_changes::remove(tx, id).await?;
                }
                Ok(RemovedJobs { count, next })
            })
            .await
        })
    }

    /// Removes some of the rows of `Idempotency-Key`s and of messages that are over, and counts them: those past their own time, and
    /// with `keep`, messages older than that whose job is gone.
    pub fn remove_expired_records(&self, keep: Option<Duration>) -> StoreFuture<'_, u64> {
        self.call("remove_expired_records").run(self.write(async move |tx, now| {
            let requests = query(EXPIRED_REQUESTS)
                .bind_all(values![micros(before(now, self.policy.idempotency_ttl)), RECORDS])
                .execute(&mut *tx)
                .await?;
            let oldest = before(now, DELIVERY_TTL);
            let messages = query(EXPIRED_MESSAGES)
                .bind(micros(oldest))
                .bind_all(values![micros(keep.map_or(oldest, |keep| before(now, keep).max(oldest))), RECORDS])
                .execute(tx)
                .await?;
            Ok(requests + messages)
        }))
    }
}
