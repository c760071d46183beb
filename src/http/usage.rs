//! `GET /v1/usage`: what projects use, and what they may.

use axum::extract::State;
use serde::Serialize;

use super::{
    problem::{ApiResult, ProblemResponse},
    request::{Page, Parameters},
    state::AppState,
};
use crate::{
    domain::{Caller, ProjectId, ProjectLimits},
    store::{ProjectUsage, StoredBytes},
};

/// `#/components/schemas/Usage` of the contract.
#[derive(Serialize)]
struct UsageBody {
    project_id: ProjectId,
    name: String,
    bytes: BytesBody,
    jobs: JobsBody,
    worker_seconds: f64,
    limits: ProjectLimits,
}

#[derive(Serialize)]
struct BytesBody {
    total: u64,
    #[serde(flatten)]
    stored: StoredBytes,
    uploads: u64,
}

#[derive(Serialize)]
struct JobsBody {
    queued: u64,
    running: u64,
    succeeded: u64,
    failed: u64,
    cancelled: u64,
}

impl From<ProjectUsage> for UsageBody {
    fn from(usage: ProjectUsage) -> Self {
        use crate::domain::JobState;
        let jobs = |state: JobState| {
            usage.jobs.iter().find(|(counted, _)| *counted == state).map_or(0, |(_, count)| *count)
        };
        Self {
            project_id: usage.project.id,
            bytes: BytesBody {
                total: usage.stored.total().saturating_add(usage.reserved),
                stored: usage.stored,
                uploads: usage.reserved,
            },
            jobs: JobsBody {
                queued: jobs(JobState::Queued),
                running: jobs(JobState::Running),
                succeeded: jobs(JobState::Succeeded),
                failed: jobs(JobState::Failed),
                cancelled: jobs(JobState::Cancelled),
            },
            worker_seconds: usage.worker_seconds,
            limits: usage.limits,
            name: usage.project.name,
        }
    }
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
    page.answer("projects", usage, &list, |last| last.project.id, UsageBody::from)
}
