//! Links that open a job for those without a key: make, list and revoke them.

use axum::{
    Json,
    body::Body,
    extract::{Path, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::IntoResponse as _,
};
use jiff::{SignedDuration, Timestamp};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{
    auth::shared_link::{may_open, prefix},
    jobs::{OwnedJob, body::href, find},
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{JsonBody, Parameters, parse_json, read_optional_json},
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType, ShareId},
    store::{NewShare, SHARES_PER_JOB, ShareRecord},
};

/// Seconds that a link is open unless another time is asked for: a week.
const DEFAULT_SECONDS: u32 = 7 * 24 * 3600;
/// Most seconds that a link may be open.
const MAX_SECONDS: u32 = 366 * 24 * 3600;
/// Longest target.
const MAX_PATH: usize = 4000;

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct CreateShareRequest {
    expires_in_s: Option<u32>,
    path: Option<String>,
}

impl JsonBody for CreateShareRequest {
    const EXPECTED: &'static str = "{\"expires_in_s\": SECONDS, \"path\": TEXT}";
}

/// `POST /v1/jobs/{id}/shares`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    OwnedJob(record): OwnedJob,
    parameters: Parameters,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    parameters.finish()?;
    let content = read_optional_json(&mut body.into_data_stream(), &headers, &state.limits).await?;
    let CreateShareRequest { expires_in_s, path } =
        content.as_deref().map(parse_json).transpose()?.unwrap_or_default();
    let seconds = expires_in_s.unwrap_or(DEFAULT_SECONDS);
    if !(1..=MAX_SECONDS).contains(&seconds) {
        let error = format!("{seconds} is outside 1..={MAX_SECONDS}");
        return Err(ProblemResponse::parameter("expires_in_s", error));
    }
    let target = path.map(checked).transpose()?;
    let now = state.store().time().await?;
    let expires_at = now.checked_add(SignedDuration::from_secs(seconds.into())).unwrap_or(Timestamp::MAX);
    let id = ShareId(state.services.new_uuid());
    let new = NewShare { id, job: record.job.id, target, key: caller.key, expires_at };
    let Some(share) = state.store().create_share(new).await? else {
        let detail =
            format!("the job has {SHARES_PER_JOB} open links, and may have no more; revoke one first");
        return Err(ProblemType::TooManyShares.because(detail));
    };
    tracing::info!(share = %share.id, "link {} to job {} is made", share.id, share.job);
    let location = HeaderValue::try_from(format!("{}/shares/{}", href(share.job), share.id))?;
    let headers =
        [(header::LOCATION, location), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((StatusCode::CREATED, headers, Json(shown(&state, &share).await?)).into_response())
}

/// A path below a job that a link may open, with its query.
fn checked(path: String) -> ApiResult<String> {
    let below = path.split('?').next().unwrap_or_default();
    let is_uri =
        path.len() <= MAX_PATH && format!("/{path}").parse::<axum::http::uri::PathAndQuery>().is_ok();
    if may_open(below) && is_uri && !path.contains('#') {
        return Ok(path);
    }
    let error = "is not a path below the job that a link can open, such as artifact or view?frame=NAME";
    Err(ProblemResponse::parameter("path", error))
}

/// `GET /v1/jobs/{id}/shares`.
pub(super) async fn list(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    parameters: Parameters,
) -> ApiResult {
    parameters.finish()?;
    let mut shares = Vec::new();
    for share in state.store().shares(record.job.id).await? {
        shares.push(shown(&state, &share).await?);
    }
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(json!({ "shares": shares }))).into_response())
}

/// `DELETE /v1/jobs/{id}/shares/{share}`.
pub(super) async fn revoke(
    State(state): State<AppState>,
    caller: Caller,
    Path((job, share)): Path<(String, String)>,
    parameters: Parameters,
) -> ApiResult<StatusCode> {
    parameters.finish()?;
    let record = find(&state, caller, &job).await?;
    let known = match share.parse() {
        Ok(id) => state.store().delete_share(record.job.id, id).await?,
        Err(_) => false,
    };
    if known {
        return Ok(StatusCode::NO_CONTENT);
    }
    Err(ProblemResponse::not_found(ProblemType::ShareNotFound, "link", share))
}

/// `#/components/schemas/Share` of the contract.
async fn shown(state: &AppState, share: &ShareRecord) -> ApiResult<Value> {
    let token = state.share_secret().await?.sign(share.id);
    let below = share.target.as_deref().unwrap_or("report");
    Ok(json!({
        "id": share.id,
        "job_id": share.job,
        "path": share.target,
        "url": format!("{}{}/{below}", prefix(&token), href(share.job)),
        "created_at": share.created_at,
        "expires_at": share.expires_at,
    }))
}
