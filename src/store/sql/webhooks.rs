//! Webhook endpoints and the outbox.

use std::time::Duration;

use super::{
    Store,
    db::{Sql, Transaction, query, values},
    lists, locks,
    rows::{self, after, json as text, micros},
};
use crate::{
    domain::{DeliveryId, EndpointId, JobId, JobState, ProjectId, WebhookEvent},
    store::{
        AfterAttempt, DeliveryRecord, DeliveryResult, DueDelivery, EndpointRecord, MAX_PAUSE, NewEndpoint,
        Replay, StoreError, StoreFuture,
    },
};
use jiff::Timestamp;

/// How long a delivery that has ended is kept, from its creation.
pub(super) const DELIVERY_TTL: Duration = Duration::from_secs(30 * 24 * 3600);

/// The endpoint whose turn it is at `?1`, of those with something due and nothing under way: one of the project with the fewest deliveries
/// under way, and of these the one whose delivery has been due for longest.
const NEXT_ENDPOINT: &str = "
    SELECT d.endpoint FROM (
        SELECT endpoint, MIN(due_at) AS due_at, MIN(seq) AS seq FROM webhook_deliveries
        WHERE state = 'pending' AND due_at <= ?1 AND (lease_until IS NULL OR lease_until <= ?1)
        GROUP BY endpoint
    ) AS d
    JOIN webhook_endpoints e ON e.id = d.endpoint
    WHERE NOT EXISTS (SELECT 1 FROM webhook_deliveries o WHERE o.endpoint = d.endpoint AND o.lease_until > ?1)
    ORDER BY (SELECT count(*) FROM webhook_deliveries o JOIN webhook_endpoints s ON s.id = o.endpoint
              WHERE s.project = e.project AND o.lease_until > ?1), d.due_at, d.seq LIMIT 1";

/// Deliveries that are due later than `?1`, or under way until later than `?2`.
const TOO_LATE: &str = "
    SELECT id FROM webhook_deliveries WHERE state = 'pending' AND due_at > ?1
    UNION ALL SELECT id FROM webhook_deliveries WHERE lease_until IS NOT NULL AND lease_until > ?2";

/// How often an endpoint is chosen for one delivery, where other processes take what was chosen.
const MAX_CHOICES: u32 = 16;

/// Adds a delivery to the outbox for each endpoint of the job's project that subscribed to `state`, within the transaction of the change.
///
/// On PostgreSQL the endpoints are locked, so that one that is disabled meanwhile either gets none or fails it with the others.
pub(super) async fn enqueue_deliveries(
    connection: &mut Transaction,
    job: JobId,
    state: JobState,
    attempt: u32,
    seq: u64,
    now: Timestamp,
) -> Result<(), StoreError> {
    let event = WebhookEvent(state);
    let endpoints = query(Sql {
        sqlite: "SELECT id FROM webhook_endpoints
         WHERE project = (SELECT project FROM jobs WHERE id = ?) AND disabled_at IS NULL
             AND EXISTS (SELECT 1 FROM json_each(events) WHERE value = ?)
         ORDER BY id",
        postgres: "SELECT id FROM webhook_endpoints
         WHERE project = (SELECT project FROM jobs WHERE id = ?) AND disabled_at IS NULL
             AND CAST(events AS jsonb) @> to_jsonb(CAST(? AS text))
         ORDER BY id FOR SHARE",
    })
    .bind_all(values![job.to_string(), event.name()])
    .fetch_all(&mut *connection)
    .await?;
    for row in &endpoints {
        let endpoint = rows::endpoint_id(row)?;
        query(
            "INSERT INTO webhook_deliveries (id, endpoint, job, event, body, state, due_at, created_at)
             VALUES (?, ?, ?, ?, ?, 'pending', ?, ?)",
        )
        .bind_all(values![DeliveryId::of(endpoint, job, seq).to_string(), endpoint.to_string()])
        .bind_all(values![job.to_string(), event.name(), event.message(job, attempt, seq, now), micros(now)])
        .bind(micros(now))
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

impl Store {
    /// The endpoint whose turn it is. It is chosen without a lock, so that neither idle polling nor a long backlog delays writers.
    async fn next_endpoint(&self) -> Result<Option<String>, StoreError> {
        let now = micros(self.now(&self.readers).await?);
        let row = query(NEXT_ENDPOINT).bind(now).fetch_optional(&self.readers).await?;
        let Some(row) = row else { return Ok(None) };
        Ok(Some(row.try_get("endpoint")?))
    }

    /// Makes deliveries due now that wait for longer than any is ever put off, since the clock was set back; returns whether there are any.
    async fn hasten_deliveries(&self, lease: Duration) -> Result<bool, StoreError> {
        // Another process may have taken one a moment later than this one's time.
        let too_late = |now| values![micros(after(now, MAX_PAUSE)), micros(after(now, 2 * lease))];
        let now = self.now(&self.readers).await?;
        if query(TOO_LATE).bind_all(too_late(now)).fetch_optional(&self.readers).await?.is_none() {
            return Ok(false);
        }
        self.write(async move |tx, now| {
            let hastened = query(
                "UPDATE webhook_deliveries SET due_at = ?3, lease_until = NULL
                 WHERE (state = 'pending' AND due_at > ?1) OR (lease_until IS NOT NULL AND lease_until > ?2)",
            )
            .bind_all(too_late(now))
            .bind(micros(now))
            .execute(tx)
            .await?;
            Ok(hastened > 0)
        })
        .await
    }

    /// Takes the delivery of an endpoint that has been due for longest, unless one is under way.
    async fn take_delivery_of(
        &self,
        endpoint: String,
        lease: Duration,
    ) -> Result<Option<DueDelivery>, StoreError> {
        self.write(async move |tx, now| {
            // So that no other transaction takes another of its deliveries.
            query(Sql {
                sqlite: "SELECT id FROM webhook_endpoints WHERE id = ?",
                postgres: "SELECT id FROM webhook_endpoints WHERE id = ? FOR NO KEY UPDATE",
            })
            .bind(&endpoint)
            .fetch_optional(&mut *tx)
            .await?;
            query(
                "UPDATE webhook_deliveries
                 SET attempts = attempts + 1, tries = tries + 1, lease_until = ?2, attempted_at = ?1,
                     answer_status = NULL, answer_fault = NULL
                 WHERE seq = (SELECT d.seq FROM webhook_deliveries d
                              WHERE d.endpoint = ?3 AND d.state = 'pending' AND d.due_at <= ?1
                                  AND (d.lease_until IS NULL OR d.lease_until <= ?1)
                                  AND NOT EXISTS (SELECT 1 FROM webhook_deliveries o
                                                  WHERE o.endpoint = d.endpoint AND o.lease_until > ?1)
                              ORDER BY d.due_at, d.seq LIMIT 1)
                 RETURNING id, attempts, tries, body,
                     (SELECT url FROM webhook_endpoints e WHERE e.id = endpoint) AS url,
                     (SELECT secret FROM webhook_endpoints e WHERE e.id = endpoint) AS secret",
            )
            .bind_all(values![micros(now), micros(after(now, lease)), endpoint])
            .optional(tx, |row| rows::due_delivery(row, now))
            .await
        })
        .await
    }
}

async fn disable(
    connection: &mut Transaction,
    endpoint: EndpointId,
    now: Timestamp,
) -> Result<(), StoreError> {
    query("UPDATE webhook_endpoints SET disabled_at = ? WHERE id = ? AND disabled_at IS NULL")
        .bind_all(values![micros(now), endpoint.to_string()])
        .execute(&mut *connection)
        .await?;
    query(
        "UPDATE webhook_deliveries
         SET state = 'failed', due_at = NULL, lease_until = NULL, answer_fault = 'the endpoint is disabled'
         WHERE endpoint = ? AND state = 'pending'",
    )
    .bind(endpoint.to_string())
    .run(connection)
    .await
}

impl Store {
    /// Adds an endpoint, unless its project has `at_most` already.
    pub fn create_endpoint(&self, new: NewEndpoint, at_most: u32) -> StoreFuture<'_, Option<EndpointRecord>> {
        self.call("create_endpoint").run(self.write(async move |tx, now| {
            locks::project(tx, new.project).await?;
            let project = new.project.to_string();
            let row = query("SELECT count(*) AS had FROM webhook_endpoints WHERE project = ?")
                .bind(&project)
                .fetch_one(&mut *tx)
                .await?;
            if row.try_get::<i64>("had")? >= i64::from(at_most) {
                return Ok(None);
            }
            let names: Vec<&str> = new.events.iter().map(|event| event.name()).collect();
            let row = query(
                "INSERT INTO webhook_endpoints (id, project, url, events, description, secret, created_at)
                 VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING *",
            )
            .bind_all(values![new.id.to_string(), project, new.url, text(&names)?, new.description])
            .bind_all(values![new.secret.expose(), micros(now)])
            .fetch_one(tx)
            .await?;
            rows::endpoint(&row).map(Some)
        }))
    }

    /// An endpoint.
    pub fn endpoint(&self, id: EndpointId) -> StoreFuture<'_, Option<EndpointRecord>> {
        let found = query("SELECT * FROM webhook_endpoints WHERE id = ?").bind(id.to_string());
        self.call("endpoint").run(found.optional(&self.readers, rows::endpoint))
    }

    /// Up to `limit` endpoints of one project or of all, newest first, older than `before`.
    pub fn endpoints(
        &self,
        project: Option<ProjectId>,
        before: Option<EndpointId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<EndpointRecord>> {
        self.call("endpoints")
            .run(lists::endpoints(project, before, limit).all(&self.readers, rows::endpoint))
    }

    /// Deletes an endpoint with its deliveries; false if there is none.
    pub fn delete_endpoint(&self, id: EndpointId) -> StoreFuture<'_, bool> {
        self.call("delete_endpoint").run(self.write(async move |tx, _| {
            let deleted =
                query("DELETE FROM webhook_endpoints WHERE id = ?").bind(id.to_string()).execute(tx).await?;
            Ok(deleted > 0)
        }))
    }

    /// Up to `limit` deliveries to an endpoint, newest first, with numbers below `before`.
    pub fn deliveries(
        &self,
        endpoint: EndpointId,
        before: Option<u64>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DeliveryRecord>> {
        let list = query(
            "SELECT * FROM webhook_deliveries WHERE endpoint = ? AND seq < ? ORDER BY seq DESC LIMIT ?",
        )
        .bind_all(values![endpoint.to_string(), before.map_or(i64::MAX, rows::signed), limit]);
        self.call("deliveries").run(list.all(&self.readers, rows::delivery))
    }

    /// Makes a delivery due now and restarts its retry schedule; `None` if the endpoint has no such delivery.
    pub fn replay(&self, endpoint: EndpointId, id: DeliveryId) -> StoreFuture<'_, Option<Replay>> {
        self.call("replay").run(self.write(async move |tx, now| {
            let row = query(
                "SELECT d.lease_until, e.disabled_at
                 FROM webhook_deliveries d JOIN webhook_endpoints e ON e.id = d.endpoint
                 WHERE d.endpoint = ? AND d.id = ?",
            )
            .for_update_of("d")
            .bind_all(values![endpoint.to_string(), id.to_string()])
            .fetch_optional(&mut *tx)
            .await?;
            let Some(row) = row else { return Ok(None) };
            if row.try_get::<Option<i64>>("disabled_at")?.is_some() {
                return Ok(Some(Replay::Disabled));
            }
            if row.try_get::<Option<i64>>("lease_until")?.is_some_and(|until| until > micros(now)) {
                return Ok(Some(Replay::InProgress));
            }
            let row = query(
                "UPDATE webhook_deliveries SET state = 'pending', tries = 0, due_at = ?, lease_until = NULL, delivered_at = NULL
                 WHERE id = ? RETURNING *",
            )
            .bind_all(values![micros(now), id.to_string()])
            .fetch_one(tx)
            .await?;
            rows::delivery(&row).map(|record| Some(Replay::Due(record)))
        }))
    }

    /// Leases a due delivery for the time `lease`; at most one of an endpoint at a time. Projects take turns: the one with the fewest deliveries
    /// under way is next, and of its deliveries the one that has been due for longest.
    pub fn take_delivery(&self, lease: Duration) -> StoreFuture<'_, Option<DueDelivery>> {
        self.call("take_delivery").run(async move {
            for _ in 0..MAX_CHOICES {
                let Some(endpoint) = self.next_endpoint().await? else {
                    if self.hasten_deliveries(lease).await? {
                        continue;
                    }
                    return Ok(None);
                };
                let taken = self.take_delivery_of(endpoint, lease).await?;
                if taken.is_some() {
                    return Ok(taken);
                }
            }
            Ok(None)
        })
    }

    /// Records the result of an attempt. Changes nothing if a newer attempt has started or the endpoint was deleted.
    pub fn finish_delivery(
        &self,
        id: DeliveryId,
        attempt: u32,
        result: DeliveryResult,
    ) -> StoreFuture<'_, ()> {
        self.call("finish_delivery").run(self.write(async move |tx, now| {
            let (state, due_at) = match result.next {
                AfterAttempt::Done => ("delivered", None),
                AfterAttempt::RetryAfter(delay) => ("pending", Some(after(now, delay))),
                AfterAttempt::GiveUp | AfterAttempt::DisableEndpoint => ("failed", None),
            };
            let row = query(
                "UPDATE webhook_deliveries
                 SET state = ?1, due_at = ?2, lease_until = NULL, answer_status = ?3, answer_fault = ?4,
                     delivered_at = CASE WHEN ?1 = 'delivered' THEN ?5 END
                 WHERE id = ?6 AND attempts = ?7 AND lease_until IS NOT NULL RETURNING endpoint AS id",
            )
            .bind_all(values![state, due_at.map(micros), result.response_status, result.error, micros(now)])
            .bind_all(values![id.to_string(), attempt])
            .fetch_optional(&mut *tx)
            .await?;
            if let (Some(row), AfterAttempt::DisableEndpoint) = (row, result.next) {
                disable(tx, rows::endpoint_id(&row)?, now).await?;
            }
            query("DELETE FROM webhook_deliveries WHERE state <> 'pending' AND created_at < ?")
                .bind(micros(rows::before(now, DELIVERY_TTL)))
                .run(tx)
                .await
        }))
    }
}
