//! `GET /v1/jobs`: a page of jobs, newest first, or a stream of those that change.

use axum::{extract::State, http::HeaderMap};

use super::{body::job, event_stream, fields::Fields, list_stream};
use crate::{
    domain::{Caller, DatasetId, JobState, ProjectId},
    http::{
        jobs::create_request::{labels, one_dataset},
        problem::{ApiResult, ProblemResponse},
        request::{Page, Parameters, cursor, parse_cursor, prefers},
        state::AppState,
    },
    store::{JobFilter, JobRecord, PageKey},
};

/// `GET /v1/jobs`.
pub(crate) async fn list(
    State(state): State<AppState>,
    caller: Caller,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let page = Page::take(&mut parameters, |text| {
        let (created_at, id) = parse_cursor(text)?;
        Some(PageKey { created_at, id })
    })?;
    let own = caller.visible_project();
    let asked: Option<ProjectId> = parameters.take_as("project_id", "a project's id")?;
    let filter = JobFilter {
        project: match (own, asked) {
            // As for any other thing of another project, there is nothing to see.
            (Some(own), Some(asked)) if own != asked => return Err(ProblemResponse::no_project(asked)),
            (_, asked) => asked,
        },
        states: parameters.take("state").map(|text| parse_states(&text)).transpose()?.unwrap_or_default(),
        dataset_id: take_dataset(&mut parameters)?,
        model: parameters.take_as("model", "one of tcgs, scaffold, 3dgs")?,
        name: parameters.take("name"),
        created_from: parameters.take_as("created_from", "an instant such as 2026-11-21T12:00:00Z")?,
        created_before: parameters.take_as("created_before", "an instant such as 2026-11-21T12:00:00Z")?,
        metadata: labels(&mut parameters)?,
    };
    let fields = Fields::take(&mut parameters)?;
    parameters.finish()?;
    let seen = JobFilter { project: own.or(asked), ..filter.clone() };
    if prefers(&headers, "text/event-stream", "application/json") {
        let slot = event_stream::slot(&state, &caller)?;
        return Ok(list_stream::answer(state, &caller, seen, slot));
    }
    let records = state.store().jobs(&seen, page.after, page.to_read()).await?;
    let after = |last: &JobRecord| cursor(last.job.created_at, last.job.id);
    page.answer("jobs", records, &filtered(&filter, &fields)?, after, |record| fields.of(job(&record)))
}

/// `dataset_id`, or `scene_id`, its earlier name.
fn take_dataset(parameters: &mut Parameters) -> ApiResult<Option<DatasetId>> {
    let dataset = parameters.take_as("dataset_id", "a dataset's id")?;
    let scene = parameters.take_as("scene_id", "a dataset's id")?;
    one_dataset(dataset, scene)
}

fn parse_states(text: &str) -> ApiResult<Vec<JobState>> {
    text.split(',')
        .map(|state| state.parse().map_err(|error: String| ProblemResponse::parameter("state", error)))
        .collect()
}

/// The path of the list with this filter and these fields.
fn filtered(filter: &JobFilter, fields: &Fields) -> ApiResult<String> {
    let states: Vec<&str> = filter.states.iter().map(|state| state.name()).collect();
    let parts = [
        ("project_id", filter.project.map(|project| project.to_string())),
        ("state", (!states.is_empty()).then(|| states.join(","))),
        ("scene_id", filter.dataset_id.map(|scene| scene.to_string())),
        ("model", filter.model.map(|model| model.to_string())),
        ("name", filter.name.clone()),
        ("created_from", filter.created_from.map(|at| at.to_string())),
        ("created_before", filter.created_before.map(|at| at.to_string())),
        ("fields", fields.text()),
    ];
    let mut pairs: Vec<(String, String)> =
        parts.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))).collect();
    pairs.extend(filter.metadata.iter().map(|(key, value)| (format!("metadata[{key}]"), value.to_owned())));
    let query = serde_urlencoded::to_string(pairs).map_err(|error| ProblemResponse::internal(&error))?;
    Ok(if query.is_empty() { "/v1/jobs".to_owned() } else { format!("/v1/jobs?{query}") })
}
