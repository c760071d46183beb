//! The HTTP API that `openapi.yaml` specifies.
//!
//! Handlers parse, call the store, and respond. Invariants: every error is an `application/problem+json` document with the request's
//! id; every body, queue, connection and render is bounded; no file name comes from a client; every request passes `auth` before
//! its handler. This layer knows no workers, SQL or GPU.

mod auth;
mod client_address;
pub mod config;
mod datasets;
mod estimate;
mod files;
mod front;
mod html;
mod jobs;
mod keys;
mod meters;
mod metrics;
mod origins;
#[doc(hidden)]
pub mod parsers;
mod problem;
mod projects;
mod rendering;
mod report;
mod request;
mod server;
mod services;
mod session;
mod shared;
mod shares;
mod state;
mod uploads;
mod usage;
mod viewer_page;
mod viewer_process;
mod views;
mod webhooks;

use axum::{
    Router,
    middleware::{from_fn, from_fn_with_state, map_response},
    routing::{delete, get, head, options, post},
};
use tower::{ServiceExt as _, util::option_layer};
use tower_http::catch_panic::CatchPanicLayer;

use server::cors::Cors;

pub use client_address::{ProxyNetwork, TrustedProxies};
pub use config::HttpConfig;
pub use origins::{AllowedOrigin, AllowedOrigins, InvalidOrigin};
pub use server::{Listeners, ServeError, bind, serve};
pub use services::Services;
pub use state::AppState;
pub use viewer_process::{ViewerConfig, ViewerServices, serve as serve_viewer};

/// Every route of the API.
pub fn router(state: AppState) -> Router {
    routes(state, Router::new().route("/metrics", get(metrics::get)))
}

/// Every route of the API except the metrics, if they have a listener of their own.
fn router_without_metrics(state: AppState) -> Router {
    routes(state, Router::new())
}

/// The routes of a listener for metrics only; one on loopback answers under any host name that leads there.
fn metrics_router(state: AppState, on_loopback: bool) -> Router {
    Router::new()
        .route("/metrics", get(metrics::get))
        .route("/healthz", get(server::health::healthz))
        .layer(from_fn_with_state(on_loopback, auth::admit_without_keys))
        .layer(from_fn(server::head::bounded))
        .layer(from_fn(server::drain_body::drain_unread))
        .layer(from_fn_with_state(state.clone(), server::middleware::wrap))
        .with_state(state)
}

fn routes(state: AppState, more: Router<AppState>) -> Router {
    let uploads = Router::new()
        .route("/v1/uploads", options(uploads::options).post(uploads::create))
        .route(
            "/v1/uploads/{id}",
            head(uploads::head).patch(uploads::append).delete(uploads::delete).post(uploads::overridden),
        )
        .layer(map_response(uploads::tus::stamp));
    let origins = &state.limits.access.allowed_origins;
    let cors = (!origins.0.is_empty()).then(|| from_fn_with_state(Cors::new(origins), server::cors::share));
    let routes = more
        .route("/v1/jobs", get(jobs::list::list).post(jobs::create::create))
        .route("/v1/estimate", post(estimate::estimate))
        .route("/v1/jobs/{id}", get(jobs::get).patch(jobs::change::change).delete(jobs::actions::delete))
        .route("/v1/jobs/{id}/cancel", post(jobs::actions::cancel))
        .route("/v1/jobs/{id}/retry", post(jobs::actions::retry))
        .route("/v1/jobs/{id}/events", get(jobs::events::list))
        .route("/v1/jobs/{id}/series", get(jobs::series::get))
        .route("/v1/jobs/{id}/artifact", get(files::get))
        .route("/v1/jobs/{id}/artifacts", get(files::list))
        .route("/v1/jobs/{id}/thumbnail", get(files::thumbnail))
        .route("/v1/jobs/{id}/preview", get(files::preview))
        .route("/v1/jobs/{id}/export", get(files::exports::get))
        .route("/v1/artifacts/{sha256}", get(files::by_hash))
        .route("/v1/jobs/{id}/cameras", get(views::cameras::get))
        .route("/v1/jobs/{id}/view", get(views::get))
        .route("/v1/jobs/{id}/views", post(views::post))
        .route("/v1/jobs/{id}/stream", get(views::sequence::stream))
        .route(
            "/v1/jobs/{id}/animation",
            get(views::sequence::animation).post(views::sequence::animation_path),
        )
        .route("/v1/jobs/{id}/report", get(report::get))
        .route("/v1/jobs/{id}/viewer", get(viewer_page::page))
        .route("/v1/jobs/{id}/shares", get(shares::list).post(shares::create))
        .route("/v1/jobs/{id}/shares/{share}", delete(shares::revoke))
        .route("/v1/datasets", get(datasets::list).post(datasets::create::create))
        .route("/v1/datasets/{id}", get(datasets::get).delete(datasets::delete))
        .route("/v1/scenes", get(datasets::list).post(datasets::create::create))
        .route("/v1/scenes/{id}", get(datasets::get).delete(datasets::delete))
        .merge(uploads)
        .route("/v1/webhook-endpoints", get(webhooks::list).post(webhooks::create))
        .route("/v1/webhook-endpoints/{id}", get(webhooks::get).delete(webhooks::delete))
        .route("/v1/webhook-endpoints/{id}/deliveries", get(webhooks::deliveries))
        .route("/v1/webhook-endpoints/{id}/deliveries/{delivery}/replay", post(webhooks::replay))
        .route("/v1/projects", get(projects::list).post(projects::create))
        .route("/v1/projects/{id}", get(projects::get).patch(projects::change))
        .route("/v1/usage", get(usage::get))
        .route("/v1/keys", get(keys::list).post(keys::create))
        .route("/v1/keys/{id}", get(keys::get).patch(keys::change).delete(keys::revoke))
        .route("/", get(front::get))
        .route("/session", post(session::begin).delete(session::end))
        .route("/healthz", get(server::health::healthz))
        .route("/readyz", get(server::readiness::readyz))
        .route("/version", get(server::health::version))
        .route("/openapi.yaml", get(server::health::openapi))
        .route("/viewer/worker.js", get(viewer_page::worker))
        .route("/viewer/module.wasm", get(viewer_page::module))
        .route("/openapi.json", get(server::health::openapi_json))
        .layer(from_fn_with_state(state.clone(), auth::authenticate))
        .layer(CatchPanicLayer::custom(server::middleware::panicked))
        .layer(from_fn(server::head::bounded))
        .layer(from_fn(server::drain_body::drain_unread))
        .layer(option_layer(cors))
        .layer(from_fn_with_state(state.clone(), server::middleware::wrap))
        .with_state(state);
    // Before routing, so that a shared link has the routes of what it opens.
    Router::new().fallback_service(routes.map_request(auth::shared_link::take_token))
}
