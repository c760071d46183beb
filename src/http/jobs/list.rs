//! `GET /v1/jobs`: a page of jobs, newest first.

use axum::{Json, extract::State, response::IntoResponse};
use serde::Serialize;

use super::body::JobBody;
use crate::{
    domain::{Caller, JobState},
    http::{
        problem::{ApiResult, ProblemResponse},
        request::{Page, Parameters, cursor, pagination, parse_cursor},
        state::AppState,
    },
    store::{JobFilter, PageKey},
};

#[derive(Debug, Serialize)]
struct JobList {
    jobs: Vec<JobBody>,
    next: Option<String>,
}

/// `GET /v1/jobs`.
pub(crate) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    mut parameters: Parameters,
) -> ApiResult<impl IntoResponse> {
    let page = Page::take(&mut parameters, |text| {
        let (created_at, id) = parse_cursor(text)?;
        Some(PageKey { created_at, id })
    })?;
    let filter = JobFilter {
        owner: caller.visible_owner(),
        states: parameters.take("state").map(|text| parse_states(&text)).transpose()?.unwrap_or_default(),
        dataset_id: parameters.take_as("scene_id", "a scene's id")?,
        model: parameters.take_as("model", "one of tcgs, scaffold, 3dgs")?,
    };
    parameters.finish()?;
    let mut records = state.store().jobs(&filter, page.after, page.to_read()).await?;
    let next = page.cut(&mut records, &filtered(&filter), |last| cursor(last.job.created_at, last.job.id));
    let headers = pagination::headers(next.as_deref())?;
    let jobs = records.into_iter().map(JobBody::from).collect();
    Ok((headers, Json(JobList { jobs, next })))
}

fn parse_states(text: &str) -> ApiResult<Vec<JobState>> {
    text.split(',')
        .map(|state| state.parse().map_err(|fault: String| ProblemResponse::parameter("state", fault)))
        .collect()
}

/// The path of the list with this filter. None of its values needs escaping.
fn filtered(filter: &JobFilter) -> String {
    let states: Vec<&str> = filter.states.iter().map(|state| state.name()).collect();
    let parts = [
        (!states.is_empty()).then(|| format!("state={}", states.join(","))),
        filter.dataset_id.map(|scene| format!("scene_id={scene}")),
        filter.model.map(|model| format!("model={model}")),
    ];
    let query: Vec<String> = parts.into_iter().flatten().collect();
    if query.is_empty() { "/v1/jobs".to_owned() } else { format!("/v1/jobs?{}", query.join("&")) }
}
