//! `/healthz`, `/version`, `/openapi.yaml` and `/openapi.json`.

use std::sync::LazyLock;

use axum::{Json, http::header, response::IntoResponse};
use serde_json::{Value, json};

use crate::http::problem::{ApiResult, ProblemResponse};

const CONTRACT: &str = include_str!("../../../openapi.yaml");

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
    ([(header::CONTENT_TYPE, "application/yaml")], CONTRACT)
}

/// The contract as JSON, written once.
static AS_JSON: LazyLock<Result<String, String>> = LazyLock::new(|| {
    let contract: Value = yaml_serde::from_str(CONTRACT).map_err(|error| error.to_string())?;
    serde_json::to_string(&contract).map_err(|error| error.to_string())
});

/// `GET /openapi.json`: the same as JSON.
pub(crate) async fn openapi_json() -> ApiResult<impl IntoResponse> {
    match &*AS_JSON {
        Ok(text) => Ok(([(header::CONTENT_TYPE, "application/json")], text.as_str())),
        Err(error) => {
            let error = std::io::Error::other(format!("openapi.yaml is not what JSON can say: {error}"));
            Err(ProblemResponse::internal(&error))
        }
    }
}
