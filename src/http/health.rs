//! Is the process there, can it work, what is it, and what does it promise.

use axum::{
    Json,
    extract::State,
    http::{StatusCode, header},
    response::IntoResponse,
};
use serde_json::{Value, json};

use super::{problem::Fault, state::AppState};

/// `GET /healthz`: the process answers.
pub(super) async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

/// `GET /readyz`: a job could be taken and a file served now.
///
/// Dead workers do not make the service unready: requests are answered, jobs wait, and the supervisor is at it.
pub(super) async fn readyz(State(state): State<AppState>) -> Result<Json<Value>, Fault> {
    let not_ready = |detail| Fault::new(StatusCode::SERVICE_UNAVAILABLE, "not-ready", "Not ready", detail);
    if state.is_draining() {
        return Err(not_ready("the server is shutting down"));
    }
    if let Err(error) = state.store().ping().await {
        tracing::error!(error = &error as &dyn std::error::Error, "the database does not answer: {error}");
        return Err(not_ready("the database does not answer"));
    }
    if let Err(error) = state.blobs().probe().await {
        tracing::error!(error = &error as &dyn std::error::Error, "blobs cannot be written: {error}");
        return Err(not_ready("files cannot be written"));
    }
    let workers = (state.services().workers)();
    Ok(Json(json!({
        "status": "ready",
        "database": "ok",
        "blobs": "ok",
        "workers": { "expected": workers.expected, "alive": workers.alive },
    })))
}

/// `GET /version`.
pub(super) async fn version() -> Json<Value> {
    Json(json!({ "name": env!("CARGO_PKG_NAME"), "version": env!("CARGO_PKG_VERSION"), "api": "v1" }))
}

/// `GET /openapi.yaml`: the contract that this server was built with.
pub(super) async fn openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/yaml")], include_str!("../../openapi.yaml"))
}
