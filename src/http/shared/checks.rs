//! Whether the service can accept a job and serve a file now: the checks of the database and of the disk, cached.

use std::{future::Future, sync::Arc, time::Duration};

use tokio::{sync::watch::error::RecvError, time::timeout};

use super::cached::Cached;
use crate::store::{BlobError, Blobs, Store, StoreError};

/// How long the checks of the disk are cached: they write a file and run a transaction.
const CACHE_TIME: Duration = Duration::from_secs(2);
/// How long the database's answers are cached, so that requests without a key cannot keep it busy.
const ANSWER_TIME: Duration = Duration::from_secs(1);
/// Timeout of one check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);
/// The result of a check that found nothing wrong.
pub(crate) const OK: &str = "ok";

/// The checks; clones share what they found.
#[derive(Clone)]
pub(crate) struct Checks(Arc<Inner>);

struct Inner {
    store: Store,
    blobs: Blobs,
    /// The floor of free disk space, in bytes.
    min_free_space: u64,
    disk: Cached<Disk>,
    answers: Cached<Answers>,
}

/// What the database answers: `ok`, or what is wrong.
#[derive(Debug, Clone)]
pub(crate) struct Answers {
    pub(crate) database: String,
    pub(crate) migrations: String,
}

/// The checks of the disk: `ok`, or what is wrong.
#[derive(Debug, Clone)]
pub(crate) struct Disk {
    pub(crate) database: String,
    pub(crate) blobs: String,
    pub(crate) space: String,
}

impl Checks {
    /// Checks that have found nothing yet.
    pub(crate) fn new(store: Store, blobs: Blobs, min_free_space: u64) -> Self {
        let (disk, answers) = (Cached::default(), Cached::default());
        Self(Arc::new(Inner { store, blobs, min_free_space, disk, answers }))
    }

    /// The checks of the disk.
    ///
    /// # Errors
    /// If one of them panics.
    pub(crate) async fn disk(&self) -> Result<Disk, RecvError> {
        let this = self.clone();
        self.0.disk.get(CACHE_TIME, async move { this.0.check_disk().await }).await
    }

    /// What the database answers.
    ///
    /// # Errors
    /// If a check panics.
    pub(crate) async fn answers(&self) -> Result<Answers, RecvError> {
        let this = self.clone();
        self.0.answers.get(ANSWER_TIME, async move { this.0.ask().await }).await
    }
}

impl Inner {
    async fn ask(&self) -> Answers {
        let database = check(self.store.ping(), "it does not answer", |_| None).await;
        Answers { database, migrations: self.migrations().await }
    }

    async fn migrations(&self) -> String {
        match timeout(CHECK_TIMEOUT, self.store.schema_is_current()).await {
            Ok(Ok(true)) => OK.to_owned(),
            Ok(Ok(false)) => "the schema is not this program's; another version has changed it".to_owned(),
            Ok(Err(_)) | Err(_) => "the schema's version cannot be read".to_owned(),
        }
    }

    async fn check_disk(&self) -> Disk {
        Disk {
            // A database may answer reads and fail writes: on a full disk, or behind a lock that is never released.
            database: check(self.store.probe(), "it cannot be written", |error: &StoreError| {
                error.is_disk_full().then_some("no room is left on its disk")
            })
            .await,
            blobs: check(self.blobs.probe(), "files cannot be written", |error: &BlobError| {
                error.is_disk_full().then_some("no room is left on their disk")
            })
            .await,
            space: self.space(),
        }
    }

    fn space(&self) -> String {
        let floor = self.min_free_space;
        match self.blobs.free_bytes() {
            Ok(free) if free >= floor => OK.to_owned(),
            Ok(free) => format!("{free} bytes are free on the data folder's disk; {floor} are the least"),
            Err(error) => {
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    "cannot read the free space: {error}"
                );
                "the free space of the disk cannot be read".to_owned()
            }
        }
    }
}

/// `ok`, or what is wrong with what `probe` tests.
async fn check<E: std::error::Error + 'static>(
    probe: impl Future<Output = Result<(), E>>,
    fails: &str,
    disk_full: impl Fn(&E) -> Option<&'static str>,
) -> String {
    match timeout(CHECK_TIMEOUT, probe).await {
        Ok(Ok(())) => OK.to_owned(),
        Ok(Err(error)) => {
            tracing::error!(error = &error as &dyn std::error::Error, "readiness: {fails}: {error}");
            disk_full(&error).unwrap_or(fails).to_owned()
        }
        Err(_) => format!("{fails} in time"),
    }
}
