//! `/healthz`, `/version` and `/openapi.yaml`.

use axum::{Json, http::header, response::IntoResponse};
use serde_json::{Value, json};

/// `GET /healthz`: the process answers.
pub(crate) async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

/// `GET /version`.
pub(crate) async fn version() -> Json<Value> {
    Json(json!({ "name": env!("CARGO_PKG_NAME"), "version": env!("CARGO_PKG_VERSION"), "api": "v1" }))
}

/// `GET /openapi.yaml`: the contract that this server was built with.
pub(crate) async fn openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/yaml")], include_str!("../../../openapi.yaml"))
}
