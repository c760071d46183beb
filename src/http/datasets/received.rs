//! Receives datasets from request bodies within quota and disk space, and keeps those that a scene or job refers to.
//!
//! Invariants: space is reserved before bytes are stored; a refused request, however late, leaves nothing behind. If the database fails
//! instead, the reference may be recorded nevertheless, so the bytes are left to garbage collection. A dataset that its project already
//! has takes no space, so if the quota is used up the body is hashed and not stored: a client that repeats a request whose answer was
//! lost is not refused. A few datasets are checked at a time; the others wait for it without a thread, and leave with their clients.

use std::{future::Future, path::Path, sync::Arc};

use axum::{body::BodyDataStream, http::HeaderMap};
use tokio::{task::spawn_blocking, time::timeout};
use tracing::Instrument as _;

use crate::{
    domain::{DatasetSummary, ProjectId, ReadOptions},
    http::{
        problem::{ApiResult, ProblemResponse},
        request::{Pieces, announced_length},
        shared::{Reservation, ReservationError},
        state::AppState,
    },
    store::{
        BlobCopy, BlobRef, BlobWriter, ContentHasher, Published, StagedBlob, StoreError, garbage::withdraw,
    },
};

/// Media types of datasets: archives and videos. What bytes are is seen by their content.
pub(crate) const ARCHIVES: [&str; 5] = [
    "application/zip",
    "application/x-zip-compressed",
    "application/octet-stream",
    "video/mp4",
    "video/quicktime",
];

/// A completely received dataset.
#[derive(Debug)]
pub(crate) struct ReceivedDataset {
    blob: BlobRef,
    content: ReceivedContent,
    /// Its space; that of an upload is kept by the upload's row.
    reservation: Option<Reservation>,
}

#[derive(Debug)]
enum ReceivedContent {
    Staged(StagedBlob),
    /// The project has it already.
    Known(Published, BlobCopy),
}

/// Where a body goes.
pub(super) enum Sink {
    Disk(BlobWriter, Reservation),
    /// Nowhere; it is refused with this problem unless its project has it.
    Hash(ContentHasher, ProblemResponse),
}

/// Receives a body.
///
/// # Errors
/// 413, 507, and what is wrong with the body.
pub(crate) async fn receive(
    state: &AppState,
    project: ProjectId,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
) -> ApiResult<ReceivedDataset> {
    let announced = announced_length(headers, state.limits.upload_bytes)?;
    let mut sink = Sink::open(state, project, announced.unwrap_or(0)).await?;
    let mut pieces = Pieces::new(body, &state.limits);
    while let Some(piece) = pieces.next().await? {
        sink = sink.write(state, project, &piece).await?;
    }
    sink.finish(state, project).await
}

impl Sink {
    pub(super) async fn open(state: &AppState, project: ProjectId, announced: u64) -> ApiResult<Self> {
        match state.reservations.reserve(project, announced).await {
            Ok(reservation) => {
                Ok(Self::Disk(state.blobs().stage(state.limits.upload_bytes).await?, reservation))
            }
            Err(ReservationError::Quota(error)) => {
                let largest = state.store().largest_dataset(project).await?;
                if announced > largest {
                    return Err(error);
                }
                Ok(Self::Hash(ContentHasher::new(largest), error))
            }
            Err(refusal) => Err(refusal.into()),
        }
    }

    pub(super) async fn write(self, state: &AppState, project: ProjectId, piece: &[u8]) -> ApiResult<Self> {
        match self {
            Self::Disk(mut staging, mut reservation) => {
                let length = piece.len() as u64;
                match reservation.cover(length).await {
                    Ok(()) => {
                        staging.write(piece).await?;
                        reservation.wrote(length);
                        Ok(Self::Disk(staging, reservation))
                    }
                    Err(ReservationError::Quota(error)) => {
                        let largest = state.store().largest_dataset(project).await?;
                        let content = staging.into_hasher(largest).await?;
                        Self::hash(content, piece, error)
                    }
                    Err(refusal) => Err(refusal.into()),
                }
            }
            Self::Hash(content, error) => Self::hash(content, piece, error),
        }
    }

    fn hash(mut content: ContentHasher, piece: &[u8], error: ProblemResponse) -> ApiResult<Self> {
        match content.update(piece) {
            Ok(()) => Ok(Self::Hash(content, error)),
            Err(_) => Err(error),
        }
    }

    pub(super) async fn finish(self, state: &AppState, project: ProjectId) -> ApiResult<ReceivedDataset> {
        match self {
            Self::Disk(staging, mut reservation) => {
                let staged = staging.finish().await?;
                reservation.settle();
                Ok(ReceivedDataset {
                    blob: staged.blob(),
                    content: ReceivedContent::Staged(staged),
                    reservation: Some(reservation),
                })
            }
            Self::Hash(content, error) => {
                let known = state.store().owned_archive(project, content.finish().digest).await?;
                let there = match known {
                    Some(blob) => state.blobs().republish(blob).await?,
                    None => None,
                };
                let (published, copy) = there.ok_or(error)?;
                let blob = published.blob;
                Ok(ReceivedDataset {
                    blob,
                    content: ReceivedContent::Known(published, copy),
                    reservation: None,
                })
            }
        }
    }
}

impl ReceivedDataset {
    /// The dataset of a finished upload.
    pub(super) fn of_upload(staged: StagedBlob) -> Self {
        Self { blob: staged.blob(), content: ReceivedContent::Staged(staged), reservation: None }
    }

    pub(crate) fn blob(&self) -> BlobRef {
        self.blob
    }

    /// Checks the dataset, once one of few permits is free.
    ///
    /// # Errors
    /// What is wrong with the dataset; 503 if none is free in time.
    pub(crate) async fn check(
        self,
        state: &AppState,
        read: ReadOptions,
    ) -> ApiResult<(Self, DatasetSummary)> {
        let permit = Arc::clone(&state.checks).acquire_owned();
        let Ok(Ok(permit)) = timeout(state.limits.check_time, permit).await else {
            return Err(ProblemResponse::busy("other datasets are being checked; try again later"));
        };
        let engine = Arc::clone(&state.services.engine);
        let checked = spawn_blocking(move || {
            // Held as long as the thread works, also if the client disconnects: the process has a limited number of them.
            let _permit = permit;
            let checked = engine.check(self.path(), &read);
            (self, checked)
        });
        let (received, checked) = checked.await?;
        Ok((received, checked?))
    }

    /// The file with the content.
    fn path(&self) -> &Path {
        match &self.content {
            ReceivedContent::Staged(staged) => staged.path(),
            ReceivedContent::Known(_, copy) => copy.path(),
        }
    }

    /// Publishes the dataset and records the reference to it. If that is refused the dataset is removed again, even if the client
    /// has disconnected. If it is unknown whether the reference is recorded, the dataset stays for the grace time of garbage collection.
    ///
    /// # Errors
    /// Outer: errors of the disk; inner: errors of `refer`.
    pub(crate) async fn keep<T: Send + 'static>(
        self,
        state: &AppState,
        refer: impl Future<Output = Result<T, StoreError>> + Send + 'static,
    ) -> ApiResult<Result<T, StoreError>> {
        let state = state.clone();
        let keeping = async move {
            let Self { content, reservation, .. } = self;
            let published = match &content {
                ReceivedContent::Staged(staged) => state.blobs().publish(staged).await?,
                ReceivedContent::Known(published, _) => *published,
            };
            let referred = refer.await;
            if referred.as_ref().is_err_and(StoreError::has_written_nothing) {
                withdraw_blob(&state, published).await;
            }
            drop((content, reservation));
            Ok(referred)
        };
        // A task of its own, so that it ends even if the request is cancelled.
        tokio::spawn(keeping.in_current_span()).await?
    }
}

/// Removes a published blob that nothing came to refer to.
pub(crate) async fn withdraw_blob(state: &AppState, published: Published) {
    if let Err(error) = withdraw(state.store(), state.blobs(), published).await {
        let digest = published.blob.digest;
        tracing::warn!(%digest, error = &error as &dyn std::error::Error, "blob {digest} is not removed yet: {error}");
    }
}
