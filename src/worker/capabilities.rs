//! The preparation of datasets that a worker can do: found out once, beside its work, and announced in the database.

use std::{
    error::Error,
    sync::{Arc, OnceLock},
};

use tokio::{
    task::{JoinHandle, spawn_blocking},
    time::sleep,
};

use super::{CameraSearch, WorkerConfig};
use crate::{domain::Preparation, poses::ffmpeg_version, store::Store};

/// The capabilities of a worker, which are announced while this value lives.
pub(super) struct Capabilities {
    store: Store,
    worker: String,
    known: Arc<OnceLock<Preparation>>,
    announcing: JoinHandle<()>,
}

impl Capabilities {
    /// Finds out what the worker can do, and announces it from then on.
    pub(super) fn announce(store: &Store, config: &WorkerConfig) -> Self {
        let known = Arc::new(OnceLock::new());
        let (found, announcer, worker) = (Arc::clone(&known), store.clone(), config.id.clone());
        let (cameras, every) = (config.cameras.clone(), config.announce_every);
        let announcing = tokio::spawn(async move {
            let can = match cameras {
                Some(search) => spawn_blocking(move || abilities(&search)).await.unwrap_or_default(),
                None => Preparation::None,
            };
            let can = *found.get_or_init(|| can);
            loop {
                if let Err(error) = announcer.announce_worker(&worker, can).await {
                    tracing::warn!(error = &error as &dyn Error, "this worker cannot be announced: {error}");
                }
                sleep(every).await;
            }
        });
        Self { store: store.clone(), worker: config.id.clone(), known, announcing }
    }

    /// What the worker can do, as far as it is known already.
    pub(super) fn known(&self) -> Preparation {
        self.known.get().copied().unwrap_or_default()
    }

    /// Ends the announcements.
    pub(super) async fn withdraw(self) {
        self.announcing.abort();
        if let Err(error) = self.store.withdraw_worker(&self.worker).await {
            tracing::warn!(error = &error as &dyn Error, "this worker cannot be withdrawn: {error}");
        }
    }
}

fn abilities(search: &CameraSearch) -> Preparation {
    match search.estimator.probe() {
        Ok(program) => tracing::info!("cameras of photographs are found by {program}"),
        Err(error) => {
            tracing::info!("jobs of photographs without cameras are left to other workers: {error}");
            return Preparation::None;
        }
    }
    match ffmpeg_version(&search.estimator.ffmpeg) {
        Ok(_) => Preparation::Video,
        Err(error) => {
            tracing::info!("jobs of videos are left to other workers: {error}");
            Preparation::Poses
        }
    }
}
