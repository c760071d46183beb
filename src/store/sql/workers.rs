//! Workers.

use super::{
    Store,
    db::{Transaction, query, values},
    rows::{before, micros, preparation, preparation_place},
};
use crate::{
    domain::Preparation,
    store::{StoreError, StoreFuture, WORKER_LIFE},
};
use jiff::Timestamp;

/// Refuses a job that no live worker can prepare. If none is known, one may start later.
pub(super) async fn admit(
    connection: &mut Transaction,
    needs: Preparation,
    now: Timestamp,
) -> Result<(), StoreError> {
    if needs == Preparation::None {
        return Ok(());
    }
    match best(connection, now).await? {
        Some(best) if best < needs => Err(StoreError::NoWorker { needs, best }),
        _ => Ok(()),
    }
}

/// The most that a worker which was announced within [`WORKER_LIFE`] can do; `None` if none was.
async fn best(connection: &mut Transaction, now: Timestamp) -> Result<Option<Preparation>, StoreError> {
    query("SELECT can FROM workers WHERE seen_at >= ? ORDER BY can DESC LIMIT 1")
        .bind(micros(before(now, WORKER_LIFE)))
        .optional(connection, |row| preparation(row, "can"))
        .await
}

impl Store {
    /// Records that a worker is alive now and what it can do, and forgets those that are not.
    pub fn announce_worker<'a>(&'a self, worker: &'a str, can: Preparation) -> StoreFuture<'a, ()> {
        self.call("announce_worker").run(self.write(async move |tx, now| {
            query(
                "INSERT INTO workers (id, can, seen_at) VALUES (?, ?, ?)
                 ON CONFLICT (id) DO UPDATE SET can = excluded.can, seen_at = excluded.seen_at",
            )
            .bind_all(values![worker, preparation_place(can), micros(now)])
            .execute(&mut *tx)
            .await?;
            query("DELETE FROM workers WHERE seen_at < ?")
                .bind(micros(before(now, WORKER_LIFE)))
                .run(tx)
                .await
        }))
    }

    /// Forgets a worker that stops.
    pub fn withdraw_worker<'a>(&'a self, worker: &'a str) -> StoreFuture<'a, ()> {
        self.call("withdraw_worker").run(
            self.write(async move |tx, _| {
                query("DELETE FROM workers WHERE id = ?").bind(worker).run(tx).await
            }),
        )
    }
}
