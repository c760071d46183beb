//! `GET /readyz`: whether the service can accept a job and serve a file now, and if not, which check fails.

use std::collections::BTreeMap;

use axum::{
    Json,
    extract::State,
    http::{HeaderValue, header},
    response::IntoResponse,
};
use serde_json::json;

use crate::{
    domain::{Problem, ProblemType},
    http::{
        problem::{ApiResult, ProblemResponse},
        shared::OK,
        state::AppState,
    },
};

/// `GET /readyz`.
///
/// Dead workers do not make the service unready: requests are answered, jobs wait, and the supervisor restarts workers.
pub(crate) async fn readyz(State(state): State<AppState>) -> ApiResult {
    let panicked = |error| ProblemResponse::internal(&error);
    let disk = state.readiness.disk().await.map_err(panicked)?;
    let answers = state.readiness.answers().await.map_err(panicked)?;
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
        .map(|(name, error)| format!("{name}: {error}"))
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
