//! Listens to what PostgreSQL tells of changes (`LISTEN`, `NOTIFY`). The schema's triggers tell of them when a transaction commits.

use std::time::Duration;

use sqlx::{PgPool, postgres::PgListener};
use tokio::{sync::watch, task::AbortHandle, time::sleep};

use super::db::Pool;
use crate::store::{ChangeKind, Changes, changes::ListenerState};

/// The channels of the schema's triggers.
const QUEUE: &str = "tcgs_queue";
const EVENTS: &str = "tcgs_events";

/// Time between attempts to connect.
const RECONNECT_AFTER: Duration = Duration::from_secs(1);

/// One connection that listens on behalf of the whole process; none on SQLite, which cannot tell.
pub(super) struct Listener(Option<Listening>);

struct Listening {
    queue: watch::Receiver<ListenerState>,
    events: watch::Receiver<ListenerState>,
    task: AbortHandle,
}

impl Listener {
    /// Listens until it is stopped or dropped.
    pub(super) fn start(pool: &Pool) -> Self {
        let Pool::Postgres(pool) = pool else { return Self(None) };
        let (queue, events) = (watch::Sender::default(), watch::Sender::default());
        let (of_queue, of_events) = (queue.subscribe(), events.subscribe());
        let task = tokio::spawn(listen(pool.clone(), queue, events)).abort_handle();
        Self(Some(Listening { queue: of_queue, events: of_events, task }))
    }

    /// Changes of a kind from now on.
    pub(super) fn changes(&self, kind: ChangeKind) -> Changes {
        let Some(listening) = &self.0 else { return Changes::never() };
        let mut receiver = match kind {
            ChangeKind::Queue => listening.queue.clone(),
            ChangeKind::Events => listening.events.clone(),
        };
        receiver.mark_unchanged();
        Changes::of(receiver)
    }

    /// Gives its connection back.
    pub(super) fn stop(&self) {
        if let Some(listening) = &self.0 {
            listening.task.abort();
        }
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Listens, and connects again whenever the connection is lost.
async fn listen(pool: PgPool, queue: watch::Sender<ListenerState>, events: watch::Sender<ListenerState>) {
    loop {
        if let Err(error) = listen_once(&pool, &queue, &events).await {
            tracing::debug!(error = &error as &dyn std::error::Error, "not told of changes: {error}");
        }
        if pool.is_closed() {
            return;
        }
        for told in [&queue, &events] {
            told.send_modify(|told| told.is_live = false);
        }
        sleep(RECONNECT_AFTER).await;
    }
}

/// Listens until the connection is lost.
async fn listen_once(
    pool: &PgPool,
    queue: &watch::Sender<ListenerState>,
    events: &watch::Sender<ListenerState>,
) -> Result<(), sqlx::Error> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.listen_all([QUEUE, EVENTS]).await?;
    let tell = |told: &watch::Sender<ListenerState>| {
        told.send_modify(|told| *told = ListenerState { is_live: true, count: told.count.wrapping_add(1) });
    };
    // Whatever was told before this connection listened was missed.
    tell(queue);
    tell(events);
    while let Some(notification) = listener.try_recv().await? {
        tell(if notification.channel() == QUEUE { queue } else { events });
    }
    Ok(())
}
