//! The accept loop, with what `axum::serve` lacks: a header timeout, a limit on connections, a timeout for clients that stop reading,
//! and a deadline for draining.

pub(super) mod cors;
mod deadlines;
pub(super) mod drain_body;
pub(super) mod head;
pub(super) mod health;
pub(super) mod middleware;
pub(super) mod readiness;
mod stall_guard;
mod trace_parent;

use std::{
    io,
    net::{IpAddr, SocketAddr},
    sync::Arc,
    time::Duration,
};

use axum::{Extension, Router, middleware::AddExtension};
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    server::graceful::GracefulShutdown,
    service::TowerToHyperService,
};
use thiserror::Error;
use tokio::{
    net::{TcpListener, TcpStream},
    sync::Semaphore,
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;
use tower::Layer as _;

use self::stall_guard::{ReadRate, StallGuard};
use super::{
    AppState, Services,
    client_address::ClientAddress,
    config::{ExposureError, HttpConfig},
    meters::Meters,
    metrics_router, router, router_without_metrics,
    shared::{Capacity, Slots},
};

const MAX_HEADERS: usize = 100;
const MAX_HEAD_BYTES: usize = 64 << 10;
/// Pause after a failed accept, mostly for want of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Why the server does not start.
#[derive(Debug, Error)]
pub enum ServeError {
    /// The address may not be served.
    #[error(transparent)]
    Exposure(#[from] ExposureError),
    /// The address cannot be had.
    #[error("cannot listen on {address}")]
    Bind {
        address: SocketAddr,
        #[source]
        source: io::Error,
    },
}

/// What the server listens on.
#[derive(Debug)]
pub struct Listeners {
    api: TcpListener,
    metrics: Option<TcpListener>,
}

impl Listeners {
    /// The address of the API, with the port that the system chose if the configured one is 0.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.api.local_addr()
    }

    /// The address of the metrics, if they have a listener of their own.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn metrics_address(&self) -> io::Result<Option<SocketAddr>> {
        self.metrics.as_ref().map(TcpListener::local_addr).transpose()
    }
}

/// Binds the configured addresses, if a service with or without keys may serve them.
///
/// # Errors
/// [`ServeError`].
pub async fn bind(config: &HttpConfig, has_keys: bool) -> Result<Listeners, ServeError> {
    config.check_exposure(has_keys)?;
    let listen = async |address| {
        TcpListener::bind(address).await.map_err(|source| ServeError::Bind { address, source })
    };
    let api = listen(config.listen).await?;
    let metrics = match config.metrics_listen {
        Some(address) => Some(listen(address).await?),
        None => None,
    };
    Ok(Listeners { api, metrics })
}

/// Answers requests until `shutdown`. Then readiness fails; after [`HttpConfig::drain_notice`] no more connections are taken,
/// and open requests have [`HttpConfig::drain`] to finish.
pub async fn serve(
    listeners: Listeners,
    config: HttpConfig,
    services: Services,
    shutdown: CancellationToken,
) {
    let store = services.store.clone();
    tokio::spawn(deadlines::enforce(store, config.limits.deadline_check_interval, shutdown.clone()));
    let state = AppState::new(services, config.limits.clone(), shutdown.clone());
    state.auth_mode.load().await;
    let closed = CancellationToken::new();
    let app = if listeners.metrics.is_some() { router_without_metrics } else { router };
    let api = Acceptor::new(app(state.clone()), &config, &state.meters);
    // Scrapers must be served even when clients have taken every permit.
    let metrics_on_loopback =
        config.metrics_listen.is_some_and(|address| address.ip().to_canonical().is_loopback());
    let own = Acceptor::new(metrics_router(state.clone(), metrics_on_loopback), &config, &state.meters);
    let notice = async {
        shutdown.cancelled().await;
        sleep(config.drain_notice).await;
        closed.cancel();
    };
    let metrics = async {
        if let Some(listener) = listeners.metrics {
            own.run(listener, &closed).await;
        }
    };
    tokio::join!(api.run(listeners.api, &closed), metrics, notice);
}

/// Answers with another application than the API on a listener, within the same bounds on connections, until `shutdown`.
pub(super) async fn accept(
    app: Router,
    config: &HttpConfig,
    meters: &Meters,
    listener: TcpListener,
    shutdown: &CancellationToken,
) {
    Acceptor::new(app, config, meters).run(listener, shutdown).await;
}

/// A listener's application with the bounds on its connections.
struct Acceptor<'a> {
    app: Router,
    config: &'a HttpConfig,
    meters: Meters,
    permits: Arc<Semaphore>,
    /// By network ([`ClientAddress::network`]).
    connections: Slots<IpAddr>,
}

impl<'a> Acceptor<'a> {
    fn new(app: Router, config: &'a HttpConfig, meters: &Meters) -> Self {
        let permits = Arc::new(Semaphore::new(config.max_connections));
        let capacity = Capacity { all: usize::MAX, each: config.max_connections_per_address };
        let connections = Slots::new(capacity);
        Self { app, config, meters: meters.clone(), permits, connections }
    }

    /// Takes connections until `closed`, then waits for those that are open.
    async fn run(&self, listener: TcpListener, closed: &CancellationToken) {
        let graceful = GracefulShutdown::new();
        loop {
            let accepted = async {
                // A permit first: beyond the cap, connections wait in the system's queue.
                let permit = Arc::clone(&self.permits).acquire_owned().await;
                (permit, listener.accept().await)
            };
            let (permit, accepted) = tokio::select! {
                () = closed.cancelled() => break,
                accepted = accepted => accepted,
            };
            match accepted {
                Ok((stream, address)) => self.admit(stream, address.ip(), permit, &graceful),
                Err(error) => {
                    tracing::warn!("accept failed: {error}");
                    sleep(ACCEPT_PAUSE).await;
                }
            }
        }
        drop(listener);
        if timeout(self.config.drain, graceful.shutdown()).await.is_err() {
            tracing::warn!("some requests did not end within {} s", self.config.drain.as_secs());
        }
    }

    fn admit(
        &self,
        stream: TcpStream,
        address: IpAddr,
        permit: impl Send + 'static,
        graceful: &GracefulShutdown,
    ) {
        let is_proxy = self.config.limits.access.trusted_proxies.contains(address);
        // A proxy's connections are those of all its clients.
        let address_slot =
            (!is_proxy).then(|| self.connections.take(ClientAddress(address).network())).transpose();
        let Ok(address_slot) = address_slot else {
            self.meters.connection_refused();
            tracing::debug!(%address, "{address} has too many connections open; closing one more");
            return;
        };
        let open = self.meters.connection_opened();
        let watched = graceful.watch(self.connection(stream, address));
        tokio::spawn(async move {
            if let Err(error) = watched.await {
                tracing::debug!("a connection ended early: {error}");
            }
            drop((permit, address_slot, open));
        });
    }

    fn connection(&self, stream: TcpStream, address: IpAddr) -> Connection {
        // Responses are written whole; waiting to fill a packet only adds delay.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!("no TCP_NODELAY: {error}");
        }
        let min_rate = ReadRate {
            max_stall: self.config.write_timeout,
            bytes_per_second: self.config.min_response_rate,
        };
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.config.header_timeout)
            .max_headers(MAX_HEADERS)
            .max_buf_size(MAX_HEAD_BYTES)
            .serve_connection(
                TokioIo::new(StallGuard::new(stream, min_rate)),
                TowerToHyperService::new(Extension(ClientAddress(address)).layer(self.app.clone())),
            )
    }
}

type Connection = http1::Connection<
    TokioIo<StallGuard<TcpStream>>,
    TowerToHyperService<AddExtension<Router, ClientAddress>>,
>;
