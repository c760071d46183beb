//! `POST /v1/estimate`: what a job would take, before it is created.

mod experience;

use axum::{
    Json,
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderValue, Uri, header},
    response::IntoResponse as _,
};
use serde::Serialize;

use self::experience::{Experience, rounded_outward};
use super::{
    jobs::create_request::CreateJobRequest,
    problem::{ApiResult, ProblemResponse},
    request::{Parameters, read_json},
    state::AppState,
};
use crate::domain::{Caller, JobNeeds, MemoryNeeds, TrainOptions, ValueRange};

/// The answer.
#[derive(Debug, Serialize)]
struct EstimateResponse {
    steps: u64,
    /// Of training alone.
    train_seconds: Option<ValueRange<f64>>,
    /// From the start to the end of the job.
    seconds: Option<ValueRange<f64>>,
    file_bytes: ValueRange<u64>,
    memory: Option<MemoryNeeds>,
    finished_jobs: FinishedJobs,
    notes: Vec<String>,
}

/// The finished jobs that the times are taken from.
#[derive(Debug, Default, Serialize)]
struct FinishedJobs {
    count: usize,
    adapters: Vec<String>,
    steps_per_second: Option<ValueRange<f64>>,
}

/// `POST /v1/estimate`.
pub(super) async fn estimate(
    State(state): State<AppState>,
    caller: Caller,
    uri: Uri,
    headers: HeaderMap,
    body: Body,
) -> ApiResult {
    Parameters::parse(uri.query())?.finish()?;
    let content = read_json(&mut body.into_data_stream(), &headers, &state.limits).await?;
    let (id, CreateJobRequest { options, .. }) = CreateJobRequest::from_json(&content)?;
    let dataset = state.store().dataset(id).await?.filter(|dataset| caller.may_see(dataset.project));
    let summary = dataset.ok_or_else(|| ProblemResponse::no_scene(id))?.summary;
    let needs = state.services.engine.needs(&summary, &options);
    let count = (summary.train + summary.test) as u64;
    let pixels = summary.pixels.checked_div(count).filter(|pixels| *pixels > 0);
    let experience = match pixels {
        None => None,
        Some(pixels) => {
            let runs = state.store().finished_runs(options.model, options.preset).await?;
            Experience::of(&runs, pixels)
        }
    };
    let caching = (header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(([caching], Json(answer(needs, pixels, experience, &options))).into_response())
}

fn answer(
    needs: JobNeeds,
    pixels: Option<u64>,
    experience: Option<Experience>,
    options: &TrainOptions,
) -> EstimateResponse {
    let JobNeeds { steps, memory, file_bytes, mut notes } = needs;
    let Some(experience) = experience else {
        notes.push(match pixels {
            None => "times are unknown: the photographs have no size yet".to_owned(),
            Some(_) => format!(
                "times are unknown: none of the newest jobs of this service trained model {} by preset {}",
                options.model.name(),
                options.preset.name()
            ),
        });
        return EstimateResponse {
            steps,
            train_seconds: None,
            seconds: None,
            file_bytes,
            memory,
            finished_jobs: FinishedJobs::default(),
            notes,
        };
    };
    let train = experience.train_seconds(steps);
    let whole = experience
        .other_seconds
        .map(|other| ValueRange { low: train.low + other.low, high: train.high + other.high });
    if whole.is_none() {
        notes
            .push("the time of the whole job is unknown: every finished job had several attempts".to_owned());
    }
    EstimateResponse {
        steps,
        train_seconds: Some(rounded_outward(train)),
        seconds: whole.map(rounded_outward),
        file_bytes,
        memory,
        finished_jobs: FinishedJobs {
            count: experience.count,
            steps_per_second: Some(rounded_outward(experience.speed)),
            adapters: experience.adapters,
        },
        notes,
    }
}
