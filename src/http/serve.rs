//! The accept loop. `axum::serve` has no header timeout, no bound on connections and no deadline for draining;
//! this one does.

use std::{io, net::SocketAddr, sync::Arc, time::Duration};

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
    overdue, router,
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
        address: std::net::SocketAddr,
        /// Why.
        #[source]
        source: io::Error,
    },
}

/// Takes hold of the configured address, if it may be served by a service that has keys, or has none.
///
/// # Errors
/// [`ServeError`].
pub async fn bind(config: &HttpConfig, has_keys: bool) -> Result<TcpListener, ServeError> {
    config.check_exposure(has_keys)?;
    let address = config.listen;
    TcpListener::bind(address).await.map_err(|source| ServeError::Bind { address, source })
}

/// Answers requests until `shutdown`, then lets open ones finish for at most [`HttpConfig::drain`].
pub async fn serve(
    listener: TcpListener,
    config: HttpConfig,
    services: Services,
    shutdown: CancellationToken,
) {
    let store = services.store.clone();
    tokio::spawn(overdue::give_up(store, config.limits.overdue_every, shutdown.clone()));
    let app = router(AppState::new(services, config.limits.clone(), shutdown.clone()));
    let places = Arc::new(Semaphore::new(config.max_connections));
    let graceful = GracefulShutdown::new();
    loop {
        let accepted = async {
            // A place first: beyond the cap, connections wait in the system's queue.
            let place = Arc::clone(&places).acquire_owned().await;
            (place, listener.accept().await)
        };
        let (place, accepted) = tokio::select! {
            () = shutdown.cancelled() => break,
            accepted = accepted => accepted,
        };
        match accepted {
            Ok((stream, peer)) => {
                let connection = connection(&config, stream, peer, app.clone());
                let watched = graceful.watch(connection);
                tokio::spawn(async move {
                    if let Err(error) = watched.await {
                        tracing::debug!("a connection ended early: {error}");
                    }
                    drop(place);
                });
            }
            Err(error) => {
                tracing::warn!("accept failed: {error}");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    if timeout(config.drain, graceful.shutdown()).await.is_err() {
        tracing::warn!("some requests did not end within {} s", config.drain.as_secs());
    }
}

fn connection(
    config: &HttpConfig,
    stream: TcpStream,
    peer: SocketAddr,
    app: Router,
) -> http1::Connection<TokioIo<TcpStream>, TowerToHyperService<AddExtension<Router, ClientAddress>>> {
    // Answers are written whole; waiting to fill a packet only adds delay.
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!("no TCP_NODELAY: {error}");
    }
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(config.header_timeout)
        .max_headers(MAX_HEADERS)
        .max_buf_size(MAX_HEAD_BYTES)
        .serve_connection(
            TokioIo::new(stream),
            TowerToHyperService::new(Extension(ClientAddress(peer.ip())).layer(app)),
        )
}
