//! `PATCH /v1/jobs/{id}`: changes what the user calls a job.

use std::collections::BTreeMap;

use axum::{extract::State, http::HeaderMap, response::IntoResponse};
use serde::Deserialize;

use super::{
    OwnedJob,
    actions::changed,
    create_request::{given_name, job_labels},
    etag, representation,
};
use crate::{
    http::{
        problem::{ApiResult, ProblemResponse},
        request::{ApiJson, IfMatch, JsonBody, present},
        state::AppState,
    },
    store::{JobChange, JobUpdate},
};

/// Fields that are absent stay; `null` takes the name, or all labels, away.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct ChangeJobRequest {
    #[serde(deserialize_with = "present")]
    name: Option<Option<String>>,
    #[serde(deserialize_with = "present")]
    metadata: Option<Option<BTreeMap<String, String>>>,
}

impl JsonBody for ChangeJobRequest {
    const EXPECTED: &'static str = "a job's new name and metadata";
}

/// `PATCH /v1/jobs/{id}`.
pub(crate) async fn change(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    headers: HeaderMap,
    ApiJson(request): ApiJson<ChangeJobRequest>,
) -> ApiResult<impl IntoResponse> {
    let id = record.job.id;
    let ChangeJobRequest { name, metadata } = request;
    let change = JobChange {
        name: name.map(given_name).transpose()?,
        metadata: metadata.map(|labels| job_labels(labels.unwrap_or_default())).transpose()?,
    };
    let version = match etag(&record).if_match(&headers) {
        IfMatch::Absent => None,
        IfMatch::Matches => Some(record.job.version),
        IfMatch::Differs => return Err(changed(id)),
    };
    match state.store().change_job(id, change, version).await?.ok_or_else(|| ProblemResponse::no_job(id))? {
        JobUpdate::Changed(record) => Ok(representation(*record)),
        JobUpdate::VersionMismatch => Err(changed(id)),
    }
}
