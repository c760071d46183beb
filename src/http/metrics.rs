//! `GET /metrics`: the process's own metrics, then those of the database and the disk, read at most once a second.

use std::sync::atomic::AtomicU64;

use axum::{
    extract::State,
    http::{HeaderValue, header},
    response::IntoResponse,
};
use jiff::Timestamp;
use prometheus_client::{
    encoding::text::{encode_eof, encode_registry},
    metrics::{counter::Counter, family::Family, gauge::Gauge},
    registry::Registry,
};

use crate::{
    http::{
        problem::{ApiResult, ProblemResponse},
        state::AppState,
    },
    store::StoreStats,
};

const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type Gauges = Family<Labels, Gauge<f64, AtomicU64>>;
type Counters = Family<Labels, Counter<f64, AtomicU64>>;

/// `GET /metrics`.
pub(crate) async fn get(State(state): State<AppState>) -> ApiResult {
    let figures = state.stats.get().await?;
    let registry = registry(&state, &figures);
    let mut text = String::new();
    encode_registry(&mut text, state.meters.registry())
        .and_then(|()| encode_registry(&mut text, &registry))
        .and_then(|()| encode_eof(&mut text))
        .map_err(|error| ProblemResponse::internal(&error))?;
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE)),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    ];
    Ok((headers, text).into_response())
}

fn registry(state: &AppState, figures: &StoreStats) -> Registry {
    let mut registry = Registry::with_prefix("tcgs");
    jobs(&mut registry, figures, state.services.clock.now());
    attempts(&mut registry, figures);
    let states = figures.deliveries.iter().map(|(state, count)| (state.name(), *count as f64));
    gauges(&mut registry, "webhook_deliveries", "Kept messages to webhooks by state", states);
    machine(&mut registry, state, figures);
    registry
}

fn jobs(registry: &mut Registry, figures: &StoreStats, now: Timestamp) {
    let states = figures.jobs.iter().map(|(state, count)| (state.name(), *count as f64));
    gauges(registry, "jobs", "Jobs by state", states);
    let age = figures.oldest_queued_at.map_or(0.0, |at| now.duration_since(at).as_secs_f64().max(0.0));
    gauge(registry, "oldest_queued_job_age_seconds", "Age of the oldest job that waits", age);
    let speed = "Training steps a second of the jobs that run, together";
    gauge(registry, "training_steps_per_second", speed, figures.steps_per_second);
    let phases = Counters::default();
    for (phase, seconds) in &figures.phase_seconds {
        phases.get_or_create(&vec![("phase", (*phase).to_owned())]).inc_by(*seconds);
    }
    registry.register("phase_seconds", "Time that succeeded jobs took in each phase", phases);
}

fn attempts(registry: &mut Registry, figures: &StoreStats) {
    counter(registry, "claims", "Attempts started", figures.claims as f64);
    let ended = Counters::default();
    for attempt in &figures.attempts {
        let labels = vec![
            ("outcome", attempt.outcome.name().to_owned()),
            ("cause", attempt.cause.clone().unwrap_or_default()),
        ];
        ended.get_or_create(&labels).inc_by(attempt.count as f64);
    }
    registry.register("attempts_ended", "Attempts ended, by outcome and the problem that caused it", ended);
}

fn machine(registry: &mut Registry, state: &AppState, figures: &StoreStats) {
    let workers = state.services.workers.counts();
    let counts = [("expected", workers.expected as f64), ("alive", workers.alive as f64)];
    gauges(registry, "workers", "Worker processes that this service keeps", counts.into_iter());
    if let Some(viewers) = state.services.engine.viewers() {
        gauge(registry, "viewers", "Viewers that are alive", viewers as f64);
    }
    gauge(registry, "blobs", "Stored blobs", figures.blobs as f64);
    gauge(registry, "blob_bytes", "Bytes of stored blobs", figures.blob_bytes as f64);
    match state.blobs().free_bytes() {
        Ok(free) => gauge(registry, "disk_free_bytes", "Free room on the blobs' disk", free as f64),
        Err(error) => {
            let cause = &error as &dyn std::error::Error;
            tracing::warn!(error = cause, "cannot read the free space of the disk: {error}");
        }
    }
    let (rendering, waiting) = state.view_renderer.depth();
    let depth = [("rendering", rendering as f64), ("waiting", waiting as f64)];
    gauges(registry, "render_queue", "Pictures in the line for the renderer", depth.into_iter());
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: f64) {
    let gauge = Gauge::<f64, AtomicU64>::default();
    gauge.set(value);
    registry.register(name, help, gauge);
}

fn counter(registry: &mut Registry, name: &str, help: &str, value: f64) {
    let counter = Counter::<f64, AtomicU64>::default();
    counter.inc_by(value);
    registry.register(name, help, counter);
}

/// A gauge for each state.
fn gauges(
    registry: &mut Registry,
    name: &str,
    help: &str,
    states: impl Iterator<Item = (&'static str, f64)>,
) {
    let family = Gauges::default();
    for (state, number) in states {
        family.get_or_create(&vec![("state", state.to_owned())]).set(number);
    }
    registry.register(name, help, family);
}
