//! The HTTP API: what `openapi.yaml` says, and nothing else.
//!
//! Handlers parse, ask the store, and answer. What always holds: every error is an `application/problem+json`
//! document with the request's id; every body, queue, connection and render is bounded; nothing that a
//! client sends reaches the file system as a name; no request reaches a handler but through `auth`. Workers,
//! SQL and the GPU are not known here.

mod accept;
mod artifact;
mod auth;
mod body;
mod caller;
mod camera;
mod client;
pub mod config;
mod content_digest;
mod create_job;
mod create_scene;
mod cross_site;
mod etag;
mod event_stream;
mod events;
mod exports;
mod file;
mod head;
mod health;
mod host;
mod idempotency;
mod job_actions;
mod job_body;
mod job_list;
mod job_wish;
mod jobs;
mod keys;
mod listing;
mod metrics;
mod overdue;
mod paced;
mod peers;
mod picture;
mod prefer;
mod problem;
mod query;
mod range;
mod readiness;
mod received;
mod report;
mod revocation;
mod scene_body;
mod scenes;
mod scopes;
mod series;
mod serve;
mod space;
mod state;
mod stream_places;
mod throttle;
mod trace_parent;
mod tus;
mod unread;
mod upload_part;
mod uploads;
mod views;
mod watch;
mod webhooks;
mod wrap;

use axum::{
    Router,
    middleware::{from_fn, from_fn_with_state, map_response},
    routing::{get, head, options, post},
};
use tower_http::catch_panic::CatchPanicLayer;

pub use client::{ProxyNetwork, TrustedProxies};
pub use config::HttpConfig;
pub use serve::{Listeners, ServeError, bind, serve};
pub use state::{
    AppState, DatasetCheck, ExportedScene, ForgetJob, SceneExporter, SceneLoader, Services, WorkerCensus,
    WorkerCounts,
};

/// Every route of the API.
pub fn router(state: AppState) -> Router {
    routes(state, Router::new().route("/metrics", get(metrics::get)))
}

/// Every route of the API but the metrics, which have a listener of their own.
fn router_without_metrics(state: AppState) -> Router {
    routes(state, Router::new())
}

fn routes(state: AppState, more: Router<AppState>) -> Router {
    let uploads = Router::new()
        .route("/v1/uploads", options(uploads::options).post(uploads::create))
        .route("/v1/uploads/{id}", head(uploads::head).patch(uploads::append).delete(uploads::delete))
        .layer(map_response(tus::stamp));
    more.route("/v1/jobs", get(job_list::list).post(create_job::create))
        .route("/v1/jobs/{id}", get(jobs::get).delete(job_actions::delete))
        .route("/v1/jobs/{id}/cancel", post(job_actions::cancel))
        .route("/v1/jobs/{id}/retry", post(job_actions::retry))
        .route("/v1/jobs/{id}/events", get(events::list))
        .route("/v1/jobs/{id}/series", get(series::get))
        .route("/v1/jobs/{id}/artifact", get(artifact::get))
        .route("/v1/jobs/{id}/artifacts", get(artifact::list))
        .route("/v1/jobs/{id}/export", get(exports::get))
        .route("/v1/artifacts/{sha256}", get(artifact::by_hash))
        .route("/v1/jobs/{id}/view", get(views::get))
        .route("/v1/jobs/{id}/views", post(views::post))
        .route("/v1/jobs/{id}/stream", get(views::sequence::stream).post(views::sequence::stream_path))
        .route(
            "/v1/jobs/{id}/animation",
            get(views::sequence::animation).post(views::sequence::animation_path),
        )
        .route("/v1/jobs/{id}/report", get(report::get))
        .route("/v1/scenes", get(scenes::list).post(create_scene::create))
        .route("/v1/scenes/{id}", get(scenes::get).delete(scenes::delete))
        .merge(uploads)
        .route("/v1/webhook-endpoints", get(webhooks::list).post(webhooks::create))
        .route("/v1/webhook-endpoints/{id}", get(webhooks::get).delete(webhooks::delete))
        .route("/v1/webhook-endpoints/{id}/deliveries", get(webhooks::deliveries))
        .route("/v1/webhook-endpoints/{id}/deliveries/{delivery}/replay", post(webhooks::replay))
        .route("/v1/keys", get(keys::list).post(keys::create))
        .route("/v1/keys/{id}", get(keys::get).delete(keys::revoke))
        .route("/healthz", get(health::healthz))
        .route("/readyz", get(readiness::readyz))
        .route("/version", get(health::version))
        .route("/openapi.yaml", get(health::openapi))
        .layer(from_fn_with_state(state.clone(), auth::authenticate))
        .layer(CatchPanicLayer::custom(wrap::panicked))
        .layer(from_fn(head::bounded))
        .layer(from_fn(unread::discard))
        .layer(from_fn_with_state(state.clone(), wrap::wrap))
        .with_state(state)
}
