//! Publishes pictures of the model in training. A picture that cannot be published is left out: the next one follows.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use thiserror::Error;
use tokio::{
    task::{JoinError, spawn_blocking},
    time::timeout,
};

use super::deps::WorkerDeps;
use crate::{
    domain::{Image, Preview, Progress},
    pipeline::preview_file,
    store::{BlobError, BlobRef, Lease, StoreError},
};

/// Longest time for a picture. Nothing else is reported meanwhile.
const PATIENCE: Duration = Duration::from_secs(10);

/// Why a picture is not published.
#[derive(Debug, Error)]
enum PreviewError {
    #[error("the picture cannot be encoded: {0}")]
    Encoding(String),
    #[error(transparent)]
    Thread(#[from] JoinError),
    #[error(transparent)]
    Blobs(#[from] BlobError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("it took longer than {} s", PATIENCE.as_secs())]
    TooSlow,
}

/// The pictures of an attempt; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Previews(Arc<Mutex<Pictures>>);

#[derive(Debug, Default)]
struct Pictures {
    /// The latest that was reported.
    latest: Option<Preview>,
    /// Whether it is still to be published.
    is_new: bool,
    /// The photograph, once it is published.
    photograph: Option<BlobRef>,
}

impl Previews {
    /// Takes the picture of a report, if it is new: a run may report one more than once.
    pub(super) fn add(&self, progress: &Progress) {
        let mut pictures = self.lock();
        if progress.preview.is_some() && progress.preview != pictures.latest {
            pictures.latest.clone_from(&progress.preview);
            pictures.is_new = true;
        }
    }

    /// Publishes the latest picture, if that has not been tried.
    pub(super) async fn publish(&self, deps: &WorkerDeps, lease: &Lease) {
        let (preview, photograph) = {
            let mut pictures = self.lock();
            if !std::mem::take(&mut pictures.is_new) {
                return;
            }
            (pictures.latest.clone(), pictures.photograph)
        };
        let Some(preview) = preview else { return };
        let publishing = async {
            let photograph = match photograph {
                Some(published) => published,
                None => put(deps, Arc::clone(&preview.photograph)).await?,
            };
            let render = put(deps, preview.render).await?;
            deps.store.set_preview(lease, [render, photograph]).await?;
            Ok::<_, PreviewError>(photograph)
        };
        match timeout(PATIENCE, publishing).await.unwrap_or(Err(PreviewError::TooSlow)) {
            // Its blob is referred to from now on.
            Ok(photograph) => self.lock().photograph = Some(photograph),
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, "no preview: {error}");
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, Pictures> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

async fn put(deps: &WorkerDeps, picture: Arc<Image>) -> Result<BlobRef, PreviewError> {
    let file = spawn_blocking(move || preview_file(&picture)).await?;
    let file = file.map_err(|error| PreviewError::Encoding(error.to_string()))?;
    Ok(deps.blobs.put(file.into()).await?)
}
