//! `GET /v1/jobs`: a page of jobs, newest first.

use axum::{
    Json,
    extract::{RawQuery, State},
    http::{HeaderMap, HeaderValue, header},
    response::IntoResponse,
};
use jiff::Timestamp;
use serde::Serialize;

use super::{job_body::JobBody, problem::Fault, query::Parameters, state::AppState};
use crate::{
    domain::{Caller, JobState},
    store::{JobFilter, JobRecord, PageKey},
};

const DEFAULT_PAGE: u32 = 20;
const MAX_PAGE: u32 = 100;

#[derive(Debug, Serialize)]
struct JobList {
    jobs: Vec<JobBody>,
    next: Option<String>,
}

/// `GET /v1/jobs`.
pub(super) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    RawQuery(query): RawQuery,
) -> Result<impl IntoResponse, Fault> {
    let mut parameters = Parameters::parse(query.as_deref())?;
    let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
    let before = parameters.take("cursor").map(|text| parse_cursor(&text)).transpose()?;
    let filter = JobFilter {
        owner: caller.sees_only(),
        states: parameters.take("state").map(|text| parse_states(&text)).transpose()?.unwrap_or_default(),
        scene: parameters.take_as("scene_id", "a scene's id")?,
        model: parameters.take_as("model", "one of tcgs, scaffold, 3dgs")?,
    };
    parameters.finish()?;
    // One more than asked for tells whether there is a next page.
    let mut records = state.store().jobs(&filter, before, limit + 1).await?;
    let more = records.len() > limit as usize;
    records.truncate(limit as usize);
    let next = records.last().filter(|_| more).map(|last| next_page(&filter, limit, last));
    let mut headers = HeaderMap::new();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if let Some(next) = &next {
        let link = HeaderValue::try_from(format!("<{next}>; rel=\"next\""));
        headers.insert(header::LINK, link.map_err(|error| Fault::internal(&error))?);
    }
    let jobs = records.into_iter().map(JobBody::from).collect();
    Ok((headers, Json(JobList { jobs, next })))
}

fn parse_states(text: &str) -> Result<Vec<JobState>, Fault> {
    text.split(',')
        .map(|state| state.parse().map_err(|fault: String| Fault::parameter("state", fault)))
        .collect()
}

/// The path of what follows `last`, with the same filter. None of its values needs escaping.
fn next_page(filter: &JobFilter, limit: u32, last: &JobRecord) -> String {
    let mut path = format!("/v1/jobs?limit={limit}");
    if !filter.states.is_empty() {
        let states: Vec<&str> = filter.states.iter().map(|state| state.name()).collect();
        path.push_str(&format!("&state={}", states.join(",")));
    }
    if let Some(scene) = filter.scene {
        path.push_str(&format!("&scene_id={scene}"));
    }
    if let Some(model) = filter.model {
        path.push_str(&format!("&model={model}"));
    }
    path.push_str(&format!("&cursor={}.{}", last.job.created_at.as_microsecond(), last.job.id));
    path
}

fn parse_cursor(text: &str) -> Result<PageKey, Fault> {
    let key = text.split_once('.').and_then(|(at, id)| {
        let created_at = Timestamp::from_microsecond(at.parse().ok()?).ok()?;
        Some(PageKey { created_at, id: id.parse().ok()? })
    });
    key.ok_or_else(|| Fault::parameter("cursor", "is not one that this service gave out"))
}
