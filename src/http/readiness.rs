//! `GET /readyz`: whether a job could be taken and a file served now, and if not, what is in the way.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use axum::{
    Json,
    extract::State,
    http::{HeaderValue, header},
    response::{IntoResponse, Response},
};
use serde_json::json;
use tokio::{sync::Mutex, time::timeout};

use super::{problem::Fault, state::AppState};
use crate::domain::Problem;

/// How long what the disk said is told again: asking it costs a file and a transaction.
const FRESH: Duration = Duration::from_secs(2);
/// Longest that one thing that is looked at may take.
const PATIENCE: Duration = Duration::from_secs(5);
const OK: &str = "ok";

/// What the disk said last.
#[derive(Debug, Default)]
pub(super) struct Checks(Mutex<Option<(Instant, Disk)>>);

/// What there is to say of the disk; `ok`, or a fault.
#[derive(Debug, Clone)]
struct Disk {
    database: String,
    blobs: String,
    space: String,
}

/// `GET /readyz`.
///
/// Dead workers do not make the service unready: requests are answered, jobs wait, and the supervisor is at it.
pub(super) async fn readyz(State(state): State<AppState>) -> Result<Response, Fault> {
    let disk = disk(&state).await;
    let drain = if state.is_draining() { "the server is shutting down" } else { OK };
    let answers = database(&state).await;
    let database = if answers == OK { disk.database } else { answers };
    let checks: BTreeMap<String, String> = [
        ("database", database),
        ("migrations", migrations(&state).await),
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
        let mut problem = Problem::new(503, "not-ready", "Not ready", faults.join("; "));
        problem.checks = checks;
        return Err(problem.into());
    }
    let workers = (state.services().workers)();
    let body = json!({
        "status": "ready",
        "checks": checks,
        "workers": { "expected": workers.expected, "alive": workers.alive },
    });
    Ok(([(header::CACHE_CONTROL, HeaderValue::from_static("no-store"))], Json(body)).into_response())
}

async fn database(state: &AppState) -> String {
    match timeout(PATIENCE, state.store().ping()).await {
        Ok(Ok(())) => OK.to_owned(),
        Ok(Err(error)) => {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "the database does not answer: {error}"
            );
            "it does not answer".to_owned()
        }
        Err(_) => "it does not answer in time".to_owned(),
    }
}

/// A database may answer and yet take nothing: on a full disk, or behind a lock that is never let go.
async fn writes(state: &AppState) -> String {
    match timeout(PATIENCE, state.store().probe()).await {
        Ok(Ok(())) => OK.to_owned(),
        Ok(Err(error)) => {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "the database cannot be written: {error}"
            );
            let fault =
                if error.is_disk_full() { "no room is left on its disk" } else { "it cannot be written" };
            fault.to_owned()
        }
        Err(_) => "it cannot be written in time".to_owned(),
    }
}

async fn migrations(state: &AppState) -> String {
    match timeout(PATIENCE, state.store().schema_is_current()).await {
        Ok(Ok(true)) => OK.to_owned(),
        Ok(Ok(false)) => "the schema is not this program's; another version has changed it".to_owned(),
        Ok(Err(_)) | Err(_) => "the schema's version cannot be read".to_owned(),
    }
}

async fn disk(state: &AppState) -> Disk {
    // Those who ask meanwhile wait for the same answer.
    let mut cached = state.checks().0.lock().await;
    if let Some((at, disk)) = &*cached
        && at.elapsed() < FRESH
    {
        return disk.clone();
    }
    let disk = Disk { database: writes(state).await, blobs: blobs(state).await, space: space(state) };
    *cached = Some((Instant::now(), disk.clone()));
    disk
}

async fn blobs(state: &AppState) -> String {
    match timeout(PATIENCE, state.blobs().probe()).await {
        Ok(Ok(())) => OK.to_owned(),
        Ok(Err(error)) => {
            tracing::error!(error = &error as &dyn std::error::Error, "blobs cannot be written: {error}");
            let fault = if error.is_disk_full() {
                "no room is left on their disk"
            } else {
                "files cannot be written"
            };
            fault.to_owned()
        }
        Err(_) => "files cannot be written in time".to_owned(),
    }
}

fn space(state: &AppState) -> String {
    let floor = state.limits().min_free_space;
    match state.blobs().free_bytes() {
        Ok(free) if free >= floor => OK.to_owned(),
        Ok(free) => format!("{free} bytes are free on the data folder's disk; {floor} are the least"),
        Err(error) => {
            tracing::error!(error = &error as &dyn std::error::Error, "no word of free room: {error}");
            "the disk does not say how much room is free".to_owned()
        }
    }
}
