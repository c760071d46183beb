//! Middleware around every request: request id, tracing span, metrics, and the body of problems.

use std::{any::Any, time::Instant};

use axum::{
    body::Body,
    extract::{MatchedPath, Request, State},
    http::{HeaderName, HeaderValue, header},
    middleware::Next,
    response::{IntoResponse as _, Response},
};
use futures_util::TryStreamExt as _;
use hyper::body::Body as _;
use prometheus_client::metrics::counter::Counter;
use tracing::Instrument as _;
use uuid::Uuid;

use super::trace_parent::trace_id;
use crate::{
    domain::Problem,
    http::{
        problem::{ProblemResponse, internal, plain},
        state::AppState,
    },
};

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
const CROSS_ORIGIN_RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");
const MAX_REQUEST_ID: usize = 128;

/// Gives the request an id, records it, and finishes its answer.
pub(crate) async fn wrap(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let active = state.meters.request_begun();
    let id = request_id(&request);
    let method = request.method().clone();
    let path = request.uri().path().to_owned();
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let route = matched.as_ref().map(MatchedPath::as_str);
    let shown = route.unwrap_or("unmatched");
    let trace_id = trace_id(request.headers());
    let span = tracing::info_span!("request", request_id = id, trace_id, %method, route = shown);
    let request = counted(request, state.meters.body_bytes(route));
    let started = Instant::now();
    let mut response = next.run(request).instrument(span.clone()).await;
    let status = response.status();
    if status.is_client_error() || status.is_server_error() {
        let problem = response.extensions_mut().remove::<Problem>();
        let problem = problem.unwrap_or_else(|| plain(status, method.as_str(), &path));
        response = with_body(response, problem, &id);
    }
    let headers = response.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    // Pages of other origins cannot embed responses.
    headers.insert(CROSS_ORIGIN_RESOURCE_POLICY, HeaderValue::from_static("same-origin"));
    if let Ok(id) = HeaderValue::from_str(&id) {
        headers.insert(REQUEST_ID, id);
    }
    drop(active);
    let duration = started.elapsed();
    state.meters.request_answered(&method, route, status.as_u16(), duration);
    let duration_ms = duration.as_secs_f64() * 1e3;
    span.in_scope(|| {
        tracing::info!(status = status.as_u16(), duration_ms, "{method} {shown} {}", status.as_u16())
    });
    response
}

/// The request with a body that counts its bytes as they come.
fn counted(request: Request, bytes: Counter) -> Request {
    request.map(|body| {
        if body.is_end_stream() {
            return body;
        }
        let pieces = body.into_data_stream();
        Body::from_stream(pieces.inspect_ok(move |piece| {
            bytes.inc_by(piece.len() as u64);
        }))
    })
}

/// The client's own id if it is safe to log, else a new one.
fn request_id(request: &Request) -> String {
    let given = request.headers().get(REQUEST_ID).and_then(|value| value.to_str().ok());
    let fit = |id: &&str| {
        (1..=MAX_REQUEST_ID).contains(&id.len())
            && id.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.'))
    };
    given.filter(fit).map_or_else(|| Uuid::now_v7().to_string(), str::to_owned)
}

fn with_body(response: Response, mut problem: Problem, id: &str) -> Response {
    problem.instance = Some(id.to_owned());
    // A `Problem` is strings and a number, so writing it cannot fail.
    let body = serde_json::to_vec(&problem).unwrap_or_default();
    let (mut parts, _) = response.into_parts();
    parts.headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
    parts.headers.insert(header::CONTENT_LENGTH, HeaderValue::from(body.len()));
    parts.headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Response::from_parts(parts, Body::from(body))
}

/// The answer to a request whose handler panicked.
pub(crate) fn panicked(panic: Box<dyn Any + Send + 'static>) -> Response {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message");
    tracing::error!("a handler panicked: {text}");
    ProblemResponse::from(internal()).into_response()
}
