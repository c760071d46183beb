//! `GET /v1/jobs/{id}/cameras`: the dataset's cameras, each as a view that `POST /v1/jobs/{id}/views` takes.

use axum::{
    Json,
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::IntoResponse as _,
};
use serde_json::{Value, json};

use super::{cameras_blob, dataset_cameras};
use crate::{
    domain::{CameraView, NamedCamera},
    http::{
        jobs::OwnedJob,
        problem::ApiResult,
        request::{Etag, Parameters, not_modified},
        state::AppState,
    },
};

/// `GET /v1/jobs/{id}/cameras`.
pub(crate) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    parameters.finish()?;
    let etag = Etag::new(cameras_blob(&record)?.digest);
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        let cameras = dataset_cameras(&state, &record).await?;
        Json(json!({ "cameras": cameras.iter().map(body).collect::<Value>() })).into_response()
    };
    let answer = response.headers_mut();
    answer.insert(header::ETAG, etag.value());
    answer.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    Ok(response)
}

/// `#/components/schemas/DatasetCamera` of the contract.
fn body(named: &NamedCamera) -> Value {
    json!({ "name": named.name, "split": named.split, "view": CameraView::from(&named.camera) })
}
