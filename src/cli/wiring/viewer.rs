//! Starts a viewer process.

use std::{net::SocketAddr, sync::Arc};

use tcgs::{
    domain::{ProjectLimits, SystemRandom, ViewerToken},
    engine::LocalEngine,
    gpu::AdapterChoice,
    http::{self, HttpConfig, ServeError, ViewerConfig, ViewerServices},
    ingest::DatasetChecker,
    pipeline::exported::Refiner,
    store::ViewerRecord,
    viewers::announce,
};
use tokio::net::TcpListener;
use url::Url;

use super::{
    runtime::{cannot_listen, run_until_stopped, stop_on_signals, unavailable},
    service::{OlderSchema, open_blobs, open_store},
};
use crate::cli::{CliError, storage::Storage};

/// Where replicas reach a viewer.
#[derive(Debug, Clone)]
pub(crate) enum Advertised {
    /// Here.
    Url(Url),
    /// At this machine's name and the port that it listens on.
    Host(String),
    /// At the address that it listens on.
    Address,
}

/// Options of a viewer process.
#[derive(Debug, Clone)]
pub(crate) struct ViewerOptions {
    pub(crate) listen: SocketAddr,
    pub(crate) advertise: Advertised,
    pub(crate) storage: Storage,
    pub(crate) adapter: AdapterChoice,
    /// Bytes of device memory.
    pub(crate) memory: u64,
}

/// Runs a viewer until a signal comes.
pub(crate) fn viewer(options: ViewerOptions) -> Result<(), CliError> {
    run_until_stopped(async {
        let (views, adapter) = super::views(&options.adapter, options.memory)?;
        let listener = TcpListener::bind(options.listen).await.map_err(|source| {
            let error = ServeError::Bind { address: options.listen, source };
            cannot_listen(&error)
        })?;
        let address = listener.local_addr().map_err(|error| unavailable(&error))?;
        let url = match options.advertise {
            Advertised::Url(url) => url.as_str().trim_end_matches('/').to_owned(),
            Advertised::Host(name) => format!("http://{name}:{}", address.port()),
            Advertised::Address => format!("http://{address}"),
        };
        // The service has migrated the schema; a viewer of another version must not.
        let store = open_store(&options.storage, ProjectLimits::default(), OlderSchema::Refuse).await?;
        let blobs = open_blobs(&options.storage, &store).await?;
        let shutdown = stop_on_signals()?;
        let token = ViewerToken::generate(&SystemRandom).map_err(|error| unavailable(&error))?;
        let record = ViewerRecord {
            url: url.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            identity: views.identity(),
            token: token.clone(),
        };
        let announced = tokio::spawn(announce(store.clone(), record, shutdown.clone()));
        let config = HttpConfig { listen: address, ..HttpConfig::default() };
        let checker = DatasetChecker::new(config.limits.checks, config.limits.check_time);
        let refiner = Refiner::new(options.adapter.clone(), options.memory);
        let engine = Arc::new(LocalEngine::new(checker, views).with_refiner(refiner));
        let services = ViewerServices { blobs, engine, token };
        tracing::info!(%address, adapter, "rendering views for replicas at {url}");
        http::serve_viewer(listener, config, ViewerConfig::default(), services, shutdown).await;
        if let Err(error) = announced.await {
            tracing::warn!(%error, "the viewer's announcement stopped early");
        }
        store.close().await;
        Ok(())
    })
}
