//! The accept loop. `axum::serve` has no header timeout, no bound on connections, no answer to a client that stops reading
//! and no deadline for draining; this one does.

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

use super::{
    AppState, Services,
    client::ClientAddress,
    config::{ExposureError, HttpConfig},
    metrics::{self, Meters},
    overdue,
    paced::{Pace, Paced},
    peers::Peers,
    router, router_without_metrics,
};

const MAX_HEADERS: usize = 100;
const MAX_HEAD_BYTES: usize = 64 << 10;
/// Pause after a failed accept: out of file descriptors, mostly, and then only time helps.
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
        /// The address.
        address: SocketAddr,
        /// Why.
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
    /// Where the API is, with the port that the system chose if it was to choose one.
    ///
    /// # Errors
    /// If the system does not say.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.api.local_addr()
    }

    /// The same of the metrics, if they have a listener of their own.
    ///
    /// # Errors
    /// If the system does not say.
    pub fn metrics_address(&self) -> io::Result<Option<SocketAddr>> {
        self.metrics.as_ref().map(TcpListener::local_addr).transpose()
    }
}

/// Takes hold of the configured addresses, if they may be served by a service that has keys, or has none.
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
    tokio::spawn(overdue::give_up(store, config.limits.overdue_every, shutdown.clone()));
    let state = AppState::new(services, config.limits.clone(), shutdown.clone());
    state.lock().prime(&state).await;
    let closed = CancellationToken::new();
    let app = if listeners.metrics.is_some() { router_without_metrics } else { router };
    let api = Door::new(app(state.clone()), &config, state.meters());
    // Scrapers must get in when clients have taken every place.
    let metrics_on_loopback =
        config.metrics_listen.is_some_and(|address| address.ip().to_canonical().is_loopback());
    let own = Door::new(metrics::router(state.clone(), metrics_on_loopback), &config, state.meters());
    let notice = async {
        shutdown.cancelled().await;
        sleep(config.drain_notice).await;
        closed.cancel();
    };
    let metrics = async {
        if let Some(listener) = listeners.metrics {
            own.attend(listener, &closed).await;
        }
    };
    tokio::join!(api.attend(listeners.api, &closed), metrics, notice);
}

/// A listener's application with the bounds on its connections.
struct Door<'a> {
    app: Router,
    config: &'a HttpConfig,
    meters: Meters,
    places: Arc<Semaphore>,
    peers: Peers,
}

impl<'a> Door<'a> {
    fn new(app: Router, config: &'a HttpConfig, meters: &Meters) -> Self {
        let places = Arc::new(Semaphore::new(config.max_connections));
        let proxies = config.limits.access.trusted_proxies.clone();
        let peers = Peers::new(config.max_connections_per_address, proxies);
        Self { app, config, meters: meters.clone(), places, peers }
    }

    /// Takes connections until `closed`, then waits for those that are open.
    async fn attend(&self, listener: TcpListener, closed: &CancellationToken) {
        let graceful = GracefulShutdown::new();
        loop {
            let accepted = async {
                // A place first: beyond the cap, connections wait in the system's queue.
                let place = Arc::clone(&self.places).acquire_owned().await;
                (place, listener.accept().await)
            };
            let (place, accepted) = tokio::select! {
                () = closed.cancelled() => break,
                accepted = accepted => accepted,
            };
            match accepted {
                Ok((stream, address)) => self.admit(stream, address.ip(), place, &graceful),
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
        place: impl Send + 'static,
        graceful: &GracefulShutdown,
    ) {
        let Some(peer) = self.peers.admit(ClientAddress(address)) else {
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
            drop((place, peer, open));
        });
    }

    fn connection(&self, stream: TcpStream, address: IpAddr) -> Connection {
        // Answers are written whole; waiting to fill a packet only adds delay.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!("no TCP_NODELAY: {error}");
        }
        let pace = Pace { patience: self.config.write_timeout, rate: self.config.answer_rate };
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.config.header_timeout)
            .max_headers(MAX_HEADERS)
            .max_buf_size(MAX_HEAD_BYTES)
            .serve_connection(
                TokioIo::new(Paced::new(stream, pace)),
                TowerToHyperService::new(Extension(ClientAddress(address)).layer(self.app.clone())),
            )
    }
}

type Connection =
    http1::Connection<TokioIo<Paced<TcpStream>>, TowerToHyperService<AddExtension<Router, ClientAddress>>>;
