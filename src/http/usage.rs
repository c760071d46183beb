//! `GET /v1/usage`: what projects use, and what they may.

use axum::extract::State;
use serde::Serialize;
use serde_json::{Map, Value, json};

use super::{
    problem::{ApiResult, ProblemResponse},
    request::{Page, Parameters},
    state::AppState,
};
use crate::{
    domain::{Caller, JobState, ProjectId},
    store::{ProjectUsage, StoredBytes},
};

#[derive(Serialize)]
struct BytesBody {
    total: u64,
    #[serde(flatten)]
    stored: StoredBytes,
    uploads: u64,
}

/// `#/components/schemas/Usage` of the contract.
fn shown(usage: ProjectUsage) -> Value {
    let jobs = JobState::ALL.map(|state| {
        let count = usage.jobs.iter().find(|(counted, _)| *counted == state).map_or(0, |(_, count)| *count);
        (state.name().to_owned(), Value::from(count))
    });
    let bytes = BytesBody {
        total: usage.stored.total().saturating_add(usage.reserved),
        stored: usage.stored,
        uploads: usage.reserved,
    };
    json!({
        "project_id": usage.project.id,
        "name": usage.project.name,
        "bytes": bytes,
        "jobs": Map::from_iter(jobs),
        "worker_seconds": usage.worker_seconds,
        "limits": usage.limits,
    })
}

/// `GET /v1/usage`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    mut parameters: Parameters,
) -> ApiResult {
    let page = Page::take(&mut parameters, |text| text.parse().ok())?;
    let asked: Option<ProjectId> = parameters.take_as("project_id", "a project's id")?;
    parameters.finish()?;
    let project = match (caller.visible_project(), asked) {
        (Some(own), Some(asked)) if own != asked => return Err(ProblemResponse::no_project(asked)),
        (own, asked) => own.or(asked),
    };
    let usage = state.store().project_usage(project, page.after, page.to_read()).await?;
    if let Some(asked) = asked
        && usage.is_empty()
        && page.after.is_none()
    {
        return Err(ProblemResponse::no_project(asked));
    }
    let list = asked.map_or_else(|| "/v1/usage".to_owned(), |asked| format!("/v1/usage?project_id={asked}"));
    page.answer("projects", usage, &list, |last| last.project.id, shown)
}
