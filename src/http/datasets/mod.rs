//! Datasets, which the API calls scenes too ([`naming`]): list, get, delete.

mod body;
pub(super) mod create;
pub(super) mod form;
mod naming;
pub(super) mod received;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};

use self::{body::dataset, naming::Naming};
use super::{
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{Etag, IfMatch, Page, Parameters, cursor, not_modified, parse_cursor},
    state::AppState,
};
use crate::{
    domain::{Caller, DatasetId, ProblemType},
    store::{DatasetDeletion, DatasetPageKey, DatasetRecord},
};

/// The scene that a path or a body names.
///
/// # Errors
/// 404 if there is none, and if it is another's.
pub(super) async fn find(state: &AppState, caller: &Caller, id: &str) -> ApiResult<DatasetRecord> {
    let parsed: DatasetId = id.parse().map_err(|_| ProblemResponse::no_scene(id))?;
    let record = state.store().dataset(parsed).await?;
    record.filter(|record| caller.may_see(record.project)).ok_or_else(|| ProblemResponse::no_scene(id))
}

/// `GET /v1/datasets`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    naming: Naming,
    mut parameters: Parameters,
) -> ApiResult {
    let page = Page::take(&mut parameters, |text| {
        let (created_at, id) = parse_cursor(text)?;
        Some(DatasetPageKey { created_at, id })
    })?;
    parameters.finish()?;
    let records = state.store().datasets(caller.visible_project(), page.after, page.to_read()).await?;
    let after = |last: &DatasetRecord| cursor(last.created_at, last.id);
    page.answer(naming.list(), records, naming.path(), after, |record| dataset(&record, naming))
}

/// `GET /v1/datasets/{id}`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    naming: Naming,
    headers: HeaderMap,
) -> ApiResult {
    let record = find(&state, &caller, &id).await?;
    let etag = Etag::new(record.version);
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    Ok(representation(record, naming))
}

/// 200 with the dataset.
fn representation(record: DatasetRecord, naming: Naming) -> Response {
    let etag = Etag::new(record.version).value();
    let caching = HeaderValue::from_static("no-cache");
    ([(header::ETAG, etag), (header::CACHE_CONTROL, caching)], Json(dataset(&record, naming))).into_response()
}

/// `DELETE /v1/datasets/{id}`.
pub(super) async fn delete(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> ApiResult<StatusCode> {
    let record = find(&state, &caller, &id).await?;
    let changed = || {
        ProblemType::PreconditionFailed.because(format!(
            "If-Match does not name the scene as it is now, which is \"{}\"",
            record.version
        ))
    };
    if Etag::new(record.version).if_match(&headers) == IfMatch::Differs {
        return Err(changed());
    }
    match state.store().delete_dataset(record.id, Some(record.version)).await? {
        Some(DatasetDeletion::Deleted) => {
            state.blobs().request_collection();
            tracing::info!(scene = %record.id, "scene {} is deleted", record.id);
            Ok(StatusCode::NO_CONTENT)
        }
        Some(DatasetDeletion::InUse(jobs)) => Err(ProblemType::SceneInUse.because(format!(
            "{jobs} queued or running jobs are made of scene {id}; cancel them or wait for their end"
        ))),
        Some(DatasetDeletion::VersionMismatch) => Err(changed()),
        None => Err(ProblemResponse::no_scene(&id)),
    }
}
