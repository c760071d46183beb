//! The server of a viewer process: renders views and exports for API replicas that share its database and blobs.
//!
//! Invariants: without the viewer's token nothing but `/healthz` is answered; requests are bounded in size, and in number while they
//! wait, so a viewer refuses with 503 instead of collecting requests.

use std::sync::Arc;

use axum::{
    Json, Router,
    body::Bytes,
    extract::{DefaultBodyLimit, Request, State},
    http::{StatusCode, header},
    middleware::{Next, from_fn_with_state},
    response::{IntoResponse, Response},
    routing::{get, post},
};
use tokio::{
    net::TcpListener,
    runtime::Handle,
    sync::{AcquireError, OwnedSemaphorePermit, Semaphore, TryAcquireError},
    task::{JoinError, spawn_blocking},
};
use tokio_util::sync::CancellationToken;
use tower_http::catch_panic::CatchPanicLayer;

use super::{
    HttpConfig,
    meters::Meters,
    problem::internal,
    server::{accept, health},
    services::read_blob,
};
use crate::{
    domain::{Problem, ProblemType, ViewerToken},
    engine::{SceneEngine, SceneSource},
    store::Blobs,
    viewers::protocol::{
        self, Channels, EXPORT, ExportHead, ExportRequest, MAX_EXPORT_REQUEST, MAX_RENDER_REQUEST,
        MessageError, PictureHead, RENDER, RenderRequest,
    },
};

/// Bounds on the work of a viewer.
#[derive(Debug, Clone, Copy)]
pub struct ViewerConfig {
    /// Views rendered at a time; more wait.
    pub renders: usize,
    /// Views that wait.
    pub renders_waiting: usize,
    /// Exports made at a time; more wait.
    pub exports: usize,
    pub exports_waiting: usize,
}

impl Default for ViewerConfig {
    /// Replicas bound what they send, so this many wait only for a viewer of many replicas.
    fn default() -> Self {
        Self { renders: 1, renders_waiting: 256, exports: 1, exports_waiting: 32 }
    }
}

/// The services of a viewer.
pub struct ViewerServices {
    pub blobs: Blobs,
    /// Renders and exports.
    pub engine: Arc<dyn SceneEngine>,
    /// What a request has to send.
    pub token: ViewerToken,
}

/// Work of one kind, a part of it at a time.
struct WorkQueue {
    admitted: Arc<Semaphore>,
    running: Arc<Semaphore>,
}

impl WorkQueue {
    fn new(running: usize, waiting: usize) -> Self {
        let running = running.max(1);
        let of = |permits| Arc::new(Semaphore::new(permits));
        Self { admitted: of(running + waiting), running: of(running) }
    }

    /// Waits for a turn, which lasts until what is returned is dropped.
    async fn take(&self) -> Result<[OwnedSemaphorePermit; 2], Refusal> {
        let admitted = Arc::clone(&self.admitted).try_acquire_owned()?;
        Ok([admitted, Arc::clone(&self.running).acquire_owned().await?])
    }
}

struct Viewer {
    services: ViewerServices,
    renders: WorkQueue,
    exports: WorkQueue,
}

/// A problem as an answer.
struct Refusal(Problem);

impl From<Problem> for Refusal {
    fn from(problem: Problem) -> Self {
        Self(problem)
    }
}

impl From<MessageError> for Refusal {
    fn from(error: MessageError) -> Self {
        Self(Problem::new(ProblemType::InvalidView, error.to_string()))
    }
}

impl From<JoinError> for Refusal {
    fn from(error: JoinError) -> Self {
        tracing::error!("a view or an export panicked: {error}");
        Self(internal())
    }
}

impl From<AcquireError> for Refusal {
    fn from(_: AcquireError) -> Self {
        Self(internal())
    }
}

impl From<TryAcquireError> for Refusal {
    fn from(_: TryAcquireError) -> Self {
        Self(Problem::new(ProblemType::Busy, "too many requests wait for this viewer"))
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.0.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        (status, Json(self.0)).into_response()
    }
}

/// Answers replicas until `shutdown`, then finishes what is under way.
pub async fn serve(
    listener: TcpListener,
    config: HttpConfig,
    limits: ViewerConfig,
    services: ViewerServices,
    shutdown: CancellationToken,
) {
    accept(router(services, limits), &config, &Meters::default(), listener, &shutdown).await;
}

fn router(services: ViewerServices, limits: ViewerConfig) -> Router {
    let viewer = Arc::new(Viewer {
        services,
        renders: WorkQueue::new(limits.renders, limits.renders_waiting),
        exports: WorkQueue::new(limits.exports, limits.exports_waiting),
    });
    Router::new()
        .route(RENDER, post(render).layer(DefaultBodyLimit::max(MAX_RENDER_REQUEST)))
        .route(EXPORT, post(export).layer(DefaultBodyLimit::max(MAX_EXPORT_REQUEST)))
        // Before the body is read.
        .route_layer(from_fn_with_state(Arc::clone(&viewer), authenticate))
        .route("/healthz", get(health::healthz))
        .layer(CatchPanicLayer::custom(|_| Refusal(internal()).into_response()))
        .with_state(viewer)
}

async fn authenticate(State(viewer): State<Arc<Viewer>>, request: Request, next: Next) -> Response {
    let sent = request.headers().get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let token = sent.and_then(|text| text.strip_prefix("Bearer "));
    if token.is_some_and(|token| viewer.services.token.matches(token)) {
        return next.run(request).await;
    }
    Refusal(Problem::new(ProblemType::InvalidKey, "only replicas of this viewer's service are answered"))
        .into_response()
}

async fn render(State(viewer): State<Arc<Viewer>>, message: Bytes) -> Result<Vec<u8>, Refusal> {
    let (RenderRequest { artifact, camera, channels }, _) = protocol::read(&message)?;
    protocol::check(&camera)?;
    let turn = viewer.renders.take().await?;
    let (viewer, runtime) = (Arc::clone(&viewer), Handle::current());
    let rendered = spawn_blocking(move || {
        let _turn = turn;
        let services = &viewer.services;
        let load = || services.engine.load(&read_blob(&services.blobs, &runtime, artifact)?);
        let renderer = services.engine.renderer(artifact)?;
        match channels {
            Channels::Color => {
                let image = renderer.render(artifact, &load, &camera)?;
                Ok::<_, Refusal>(protocol::write(
                    &PictureHead { channels: image.channels() },
                    image.samples(),
                )?)
            }
            Channels::Scalars(kind) => {
                let plane = renderer.render_scalars(artifact, &load, &camera, kind)?;
                let samples: Vec<u8> = plane.values.iter().flat_map(|value| value.to_le_bytes()).collect();
                Ok(protocol::write(&PictureHead { channels: 1 }, &samples)?)
            }
        }
    });
    rendered.await?
}

async fn export(State(viewer): State<Arc<Viewer>>, message: Bytes) -> Result<Vec<u8>, Refusal> {
    let (ExportRequest { artifact, format, cameras }, _) = protocol::read(&message)?;
    cameras.iter().try_for_each(|named| protocol::check(&named.camera))?;
    let turn = viewer.exports.take().await?;
    let (viewer, runtime) = (Arc::clone(&viewer), Handle::current());
    let exported = spawn_blocking(move || {
        let _turn = turn;
        let services = &viewer.services;
        let read = || read_blob(&services.blobs, &runtime, artifact);
        let made = services.engine.export(SceneSource { digest: artifact, read: &read }, format, &cameras)?;
        let head =
            ExportHead { gaussians: made.gaussians, sh_degree: made.sh_degree, fidelity: made.fidelity };
        Ok::<_, Refusal>(protocol::write(&head, &made.bytes)?)
    });
    exported.await?
}
