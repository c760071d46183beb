//! Waits for changes of jobs.
//!
//! One task asks the store for all waiters, with one statement, and only while there are any: at intervals, and where the database tells of
//! events (PostgreSQL), at once when it does and rarely otherwise, since what it tells may be lost. Invariant: a wait ends once there is an event that its caller has not seen, whichever came first.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use tokio::{
    sync::{Notify, watch},
    time::sleep,
};

use crate::{
    domain::JobId,
    store::{ChangeKind, Changes, Store},
};

/// How many times rarer the store is asked while the database tells of events.
const RARER: u32 = 8;

/// Shortest time between two questions, however many events there are.
const AT_MOST_EVERY: Duration = Duration::from_millis(25);

/// Polls for changes on behalf of all waiters; clones share the task.
#[derive(Clone)]
pub(crate) struct Watcher(Arc<Inner>);

struct Inner {
    store: Store,
    every: Duration,
    waiting: Mutex<Waiting>,
    /// Told of every new waiter.
    arrived: Notify,
}

#[derive(Default)]
struct Waiting {
    /// Whether the polling task runs.
    polling: bool,
    jobs: BTreeMap<JobId, watch::Sender<Newest>>,
}

/// What is known of a job's newest event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newest {
    Unknown,
    Event(u64),
    Gone,
}

impl Watcher {
    /// A watcher that polls at an interval.
    pub(crate) fn new(store: Store, every: Duration) -> Self {
        Self(Arc::new(Inner { store, every, waiting: Mutex::default(), arrived: Notify::new() }))
    }

    /// Waits until the job has an event with a number above `seen` and returns the newest one's; `None` once there is no
    /// such job. Without a change it waits for ever, even while the database fails, so callers set a time limit.
    pub(crate) async fn changed(&self, job: JobId, seen: u64) -> Option<u64> {
        let mut newest = self.subscribe(job);
        let found = newest.wait_for(|newest| match newest {
            Newest::Unknown => false,
            Newest::Event(seq) => *seq > seen,
            Newest::Gone => true,
        });
        // The sender is dropped only once there are no receivers.
        match *found.await.ok()? {
            Newest::Event(seq) => Some(seq),
            Newest::Unknown | Newest::Gone => None,
        }
    }

    fn subscribe(&self, job: JobId) -> watch::Receiver<Newest> {
        let mut waiting = self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let newest = waiting.jobs.entry(job).or_insert_with(|| watch::channel(Newest::Unknown).0).subscribe();
        self.0.arrived.notify_one();
        if !waiting.polling {
            waiting.polling = true;
            tokio::spawn(poll(Arc::clone(&self.0)));
        }
        newest
    }
}

/// Waits until the store is to be asked again.
async fn pause(inner: &Inner, changes: &mut Changes) {
    if !changes.is_live() {
        tokio::select! {
            () = sleep(inner.every) => {}
            () = changes.wait() => {}
        }
        return;
    }
    sleep(inner.every.min(AT_MOST_EVERY)).await;
    tokio::select! {
        () = sleep(inner.every * RARER) => {}
        () = changes.wait() => {}
        // What a new waiter has not seen may have happened long ago.
        () = inner.arrived.notified() => {}
    }
}

/// Polls until there are no waiters.
async fn poll(inner: Arc<Inner>) {
    let mut changes = inner.store.changes(ChangeKind::Events);
    loop {
        pause(&inner, &mut changes).await;
        let jobs: Vec<JobId> = {
            let mut waiting = inner.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            waiting.jobs.retain(|_, newest| newest.receiver_count() > 0);
            if waiting.jobs.is_empty() {
                waiting.polling = false;
                return;
            }
            waiting.jobs.keys().copied().collect()
        };
        match inner.store.newest_events(&jobs).await {
            Ok(found) => notify(&inner, &jobs, &found.into_iter().collect()),
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "cannot poll for changes: {error}");
            }
        }
    }
}

fn notify(inner: &Inner, polled: &[JobId], found: &BTreeMap<JobId, u64>) {
    let waiting = inner.waiting.lock().unwrap_or_else(PoisonError::into_inner);
    for job in polled {
        let now = found.get(job).map_or(Newest::Gone, |seq| Newest::Event(*seq));
        if let Some(newest) = waiting.jobs.get(job) {
            newest.send_if_modified(|newest| std::mem::replace(newest, now) != now);
        }
    }
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;
    use tokio::time::timeout;
    use uuid::Uuid;

    use super::*;
    use crate::{
        domain::{Digest, SystemClock},
        store::{BlobRef, NewJob, QueuePolicy},
    };

    const LONG: Duration = Duration::from_secs(60);

    async fn with_job() -> (TempDir, Store, Watcher, JobId) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.db");
        let store = Store::open(&path, Arc::new(SystemClock), QueuePolicy::default()).await;
        let store = store.expect("a database");
        let id = JobId(Uuid::from_u128(1));
        let dataset = BlobRef { digest: Digest::of(b"dataset"), bytes: 7 };
        store.create_job(NewJob::new(id, Default::default(), dataset)).await.expect("created");
        let watcher = Watcher::new(store.clone(), Duration::from_millis(2));
        (folder, store, watcher, id)
    }

    #[tokio::test]
    async fn what_happened_before_the_wait_ends_it_too() {
        let (_folder, _store, watcher, id) = with_job().await;
        assert_eq!(timeout(LONG, watcher.changed(id, 0)).await.expect("soon"), Some(1));
    }

    #[tokio::test]
    async fn everybody_who_waits_is_told_of_a_change_and_the_looking_ends_with_the_waiting() {
        let (_folder, store, watcher, id) = with_job().await;
        let waiters: Vec<_> = (0..20)
            .map(|_| {
                let watcher = watcher.clone();
                tokio::spawn(async move { watcher.changed(id, 1).await })
            })
            .collect();
        store.cancel(id).await.expect("cancelled");
        for waiter in waiters {
            assert_eq!(timeout(LONG, waiter).await.expect("soon").expect("joined"), Some(2));
        }
        let polling = || watcher.0.waiting.lock().expect("not poisoned").polling;
        timeout(LONG, async {
            while polling() {
                tokio::task::yield_now().await;
            }
        })
        .await
        .expect("the task ends");
        assert_eq!(timeout(LONG, watcher.changed(id, 1)).await.expect("soon"), Some(2), "and begins again");
    }

    #[tokio::test]
    async fn what_has_been_seen_does_not_end_the_wait() {
        let (_folder, store, watcher, id) = with_job().await;
        let mut wait = Box::pin(watcher.changed(id, 1));
        assert!(timeout(Duration::from_millis(50), &mut wait).await.is_err(), "nothing has happened since");
        store.cancel(id).await.expect("cancelled");
        assert_eq!(timeout(LONG, wait).await.expect("soon"), Some(2));
    }

    #[tokio::test]
    async fn a_job_that_is_not_there_ends_the_wait() {
        let (_folder, _store, watcher, _) = with_job().await;
        let unknown = JobId(Uuid::from_u128(2));
        assert_eq!(timeout(LONG, watcher.changed(unknown, 0)).await.expect("soon"), None);
    }
}
