//! `GET /v1/jobs`: a page of jobs, newest first.

use axum::{
    Json,
    extract::{RawQuery, State},
    response::IntoResponse,
};
use serde::Serialize;

use super::{
    job_body::JobBody,
    listing::{self, DEFAULT_PAGE, MAX_PAGE, cursor, parse_cursor},
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, JobState},
    store::{JobFilter, JobRecord, PageKey},
};

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
    let before = before.map(|(created_at, id)| PageKey { created_at, id });
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
    let headers = listing::headers(next.as_deref())?;
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
    path.push_str(&format!("&cursor={}", cursor(last.job.created_at, last.job.id)));
    path
}
