//! `GET /readyz`: whether the service can accept a job and serve a file now, and if not, which check fails.

use std::{
    collections::BTreeMap,
    future::Future,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use axum::{
    Json,
    extract::State,
    http::{HeaderValue, header},
    response::IntoResponse,
};
use serde_json::json;
use tokio::{
    sync::watch::{self, error::RecvError},
    time::timeout,
};

use crate::{
    domain::{Problem, ProblemType},
    http::{
        problem::{ApiResult, ProblemResponse},
        state::AppState,
    },
    store::{BlobError, StoreError},
};

/// How long the checks of the disk are cached: they write a file and run a transaction.
const CACHE_TIME: Duration = Duration::from_secs(2);
/// How long the database's answers are cached, so that requests without a key cannot keep it busy.
const ANSWER_TIME: Duration = Duration::from_secs(1);
/// Timeout of one check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);
const OK: &str = "ok";

/// The cached checks.
#[derive(Debug, Default)]
pub(crate) struct Checks {
    disk: Cached<Disk>,
    answers: Cached<Answers>,
}

/// The latest search, and what it found.
#[derive(Debug)]
struct Cached<T>(Mutex<Option<Search<T>>>);

/// What a search finds, and when; `None` while it is under way.
type Search<T> = watch::Receiver<Option<(Instant, T)>>;

impl<T> Default for Cached<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T: Clone + Send + Sync + 'static> Cached<T> {
    /// What was found less than `age` ago, or else what `find` finds. Concurrent callers wait for the same.
    ///
    /// # Errors
    /// If `find` panics.
    async fn get(
        &self,
        age: Duration,
        find: impl Future<Output = T> + Send + 'static,
    ) -> Result<T, RecvError> {
        let mut search = self.search(age, find);
        loop {
            if let Some((_, found)) = &*search.borrow_and_update() {
                return Ok(found.clone());
            }
            search.changed().await?;
        }
    }

    /// The latest search, or a new one if that ended longer ago than `age` or panicked.
    fn search(&self, age: Duration, find: impl Future<Output = T> + Send + 'static) -> Search<T> {
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = latest.as_ref().filter(|search| match &*search.borrow() {
            Some((at, _)) => at.elapsed() < age,
            None => search.has_changed().is_ok(),
        });
        if let Some(search) = fresh {
            return search.clone();
        }
        let (sender, search) = watch::channel(None);
        // A task of its own, so that it ends and is cached also if the client that asked has gone.
        tokio::spawn(async move {
            let found = find.await;
            sender.send_replace(Some((Instant::now(), found)));
        });
        *latest = Some(search.clone());
        search
    }
}

/// What the database answers: `ok`, or what is wrong.
#[derive(Debug, Clone)]
struct Answers {
    database: String,
    migrations: String,
}

/// The checks of the disk: `ok`, or what is wrong.
#[derive(Debug, Clone)]
struct Disk {
    database: String,
    blobs: String,
    space: String,
}

/// `GET /readyz`.
///
/// Dead workers do not make the service unready: requests are answered, jobs wait, and the supervisor restarts workers.
pub(crate) async fn readyz(State(state): State<AppState>) -> ApiResult {
    let panicked = |error| ProblemResponse::internal(&error);
    let disk = state.readiness.disk.get(CACHE_TIME, disk(state.clone())).await.map_err(panicked)?;
    let answers = state.readiness.answers.get(ANSWER_TIME, answers(state.clone())).await.map_err(panicked)?;
    let drain = if state.draining.is_cancelled() { "the server is shutting down" } else { OK };
    let database = if answers.database == OK { disk.database } else { answers.database };
    let checks: BTreeMap<String, String> = [
        ("database", database),
        ("migrations", answers.migrations),
        ("blobs", disk.blobs),
        ("free_space", disk.space),
        ("draining", drain.to_owned()),
    ]
    .map(|(name, found)| (name.to_owned(), found))
    .into();
    let faults: Vec<String> = checks
        .iter()
        .filter(|(_, found)| *found != OK)
        .map(|(name, fault)| format!("{name}: {fault}"))
        .collect();
    if !faults.is_empty() {
        let mut problem = Problem::new(ProblemType::NotReady, faults.join("; "));
        problem.checks = checks;
        return Err(problem.into());
    }
    let workers = state.services.workers.counts();
    let body = json!({
        "status": "ready",
        "checks": checks,
        "workers": { "expected": workers.expected, "alive": workers.alive },
    });
    Ok(([(header::CACHE_CONTROL, HeaderValue::from_static("no-store"))], Json(body)).into_response())
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

async fn answers(state: AppState) -> Answers {
    Answers { database: database(&state).await, migrations: migrations(&state).await }
}

async fn database(state: &AppState) -> String {
    check(state.store().ping(), "it does not answer", |_| None).await
}

async fn migrations(state: &AppState) -> String {
    match timeout(CHECK_TIMEOUT, state.store().schema_is_current()).await {
        Ok(Ok(true)) => OK.to_owned(),
        Ok(Ok(false)) => "the schema is not this program's; another version has changed it".to_owned(),
        Ok(Err(_)) | Err(_) => "the schema's version cannot be read".to_owned(),
    }
}

async fn disk(state: AppState) -> Disk {
    Disk {
        // A database may answer reads and fail writes: on a full disk, or behind a lock that is never released.
        database: check(state.store().probe(), "it cannot be written", |error: &StoreError| {
            error.is_disk_full().then_some("no room is left on its disk")
        })
        .await,
        blobs: check(state.blobs().probe(), "files cannot be written", |error: &BlobError| {
            error.is_disk_full().then_some("no room is left on their disk")
        })
        .await,
        space: space(&state),
    }
}

fn space(state: &AppState) -> String {
    let floor = state.limits.min_free_space;
    match state.blobs().free_bytes() {
        Ok(free) if free >= floor => OK.to_owned(),
        Ok(free) => format!("{free} bytes are free on the data folder's disk; {floor} are the least"),
        Err(error) => {
            tracing::error!(error = &error as &dyn std::error::Error, "cannot read the free space: {error}");
            "the free space of the disk cannot be read".to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    };

    use tokio_util::sync::CancellationToken;

    use super::*;

    const LONG: Duration = Duration::from_secs(600);

    #[tokio::test]
    async fn what_a_client_that_has_gone_asked_for_is_found_once_and_cached() {
        let (cached, searches) = (Cached::default(), Arc::new(AtomicU32::new(0)));
        let released = CancellationToken::new();
        let find = || {
            let (searches, released) = (Arc::clone(&searches), released.clone());
            async move {
                let number = 1 + searches.fetch_add(1, Ordering::SeqCst);
                released.cancelled().await;
                number
            }
        };
        for _ in 0..10 {
            let cut_off = timeout(Duration::from_millis(5), cached.get(LONG, find())).await;
            assert!(cut_off.is_err(), "the search takes longer");
        }
        released.cancel();
        assert_eq!(cached.get(LONG, find()).await.ok(), Some(1), "all asked the same search");
        let again = cached.get(Duration::ZERO, find()).await.ok();
        assert_eq!(again, Some(2), "what is too old is searched for again");
        assert_eq!(searches.load(Ordering::SeqCst), 2);
    }

    #[tokio::test]
    async fn a_search_that_panicked_is_begun_again() {
        let cached = Cached::default();
        assert!(cached.get(LONG, async { panic!("as the test wants it") }).await.is_err());
        assert_eq!(cached.get(LONG, async { 1 }).await.ok(), Some(1));
    }
}
