//! Datasets that requests bring: received within the room that there is, and kept if something comes to refer to them.
//!
//! What always holds: room is reserved before bytes are stored, and what is refused, however late, leaves nothing behind. A
//! dataset that its owner has already takes no room, so where the quota is used up the body is hashed and not stored: whoever sends
//! one again, to repeat a request whose answer was lost, is not refused.

use std::{
    future::Future,
    path::{Path, PathBuf},
};

use axum::{body::BodyDataStream, http::HeaderMap};
use tracing::Instrument as _;

use super::{
    body::{Pieces, announced_length},
    problem::Fault,
    space::{Refusal, Reservation, Space},
    state::AppState,
};
use crate::{
    domain::KeyId,
    store::{BlobRef, BlobWriter, ContentHasher, Published, StagedBlob, StoreError, garbage::withdraw},
};

/// A dataset that has come whole.
#[derive(Debug)]
pub(super) struct Received {
    blob: BlobRef,
    content: Content,
    /// The room for it; an upload's own is kept by its row.
    reservation: Option<Reservation>,
}

#[derive(Debug)]
enum Content {
    Staged(StagedBlob),
    /// The owner has it.
    Known(Published, PathBuf),
}

/// Where a body goes.
enum Sink {
    Disk(BlobWriter, Reservation),
    /// Nowhere; it is refused with the fault unless its owner has it.
    Hash(ContentHasher, Fault),
}

/// Receives a body.
///
/// # Errors
/// 413, 507, and what is wrong with the body.
pub(super) async fn receive(
    state: &AppState,
    owner: Option<KeyId>,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
) -> Result<Received, Fault> {
    let announced = announced_length(headers, state.limits().upload_bytes)?;
    let mut sink = Sink::open(state, owner, announced.unwrap_or(0)).await?;
    let mut pieces = Pieces::new(body, state.limits());
    while let Some(piece) = pieces.next().await? {
        sink = sink.write(state, &piece).await?;
    }
    sink.finish(state, owner).await
}

impl Sink {
    async fn open(state: &AppState, owner: Option<KeyId>, announced: u64) -> Result<Self, Fault> {
        match Space::reserve(state, owner, announced).await {
            Ok(reservation) => {
                Ok(Self::Disk(state.blobs().stage(state.limits().upload_bytes).await?, reservation))
            }
            Err(Refusal::Quota { fault, largest_dataset }) if announced <= largest_dataset => {
                Ok(Self::Hash(ContentHasher::new(largest_dataset), fault))
            }
            Err(refusal) => Err(refusal.into()),
        }
    }

    async fn write(self, state: &AppState, piece: &[u8]) -> Result<Self, Fault> {
        match self {
            Self::Disk(mut staging, mut reservation) => {
                let length = piece.len() as u64;
                match reservation.cover(state, length).await {
                    Ok(()) => {
                        staging.write(piece).await?;
                        reservation.wrote(length);
                        Ok(Self::Disk(staging, reservation))
                    }
                    Err(Refusal::Quota { fault, largest_dataset }) => {
                        let content = staging.into_hasher(largest_dataset).await?;
                        Self::hash(content, piece, fault)
                    }
                    Err(refusal) => Err(refusal.into()),
                }
            }
            Self::Hash(content, fault) => Self::hash(content, piece, fault),
        }
    }

    fn hash(mut content: ContentHasher, piece: &[u8], fault: Fault) -> Result<Self, Fault> {
        match content.update(piece) {
            Ok(()) => Ok(Self::Hash(content, fault)),
            Err(_) => Err(fault),
        }
    }

    async fn finish(self, state: &AppState, owner: Option<KeyId>) -> Result<Received, Fault> {
        match self {
            Self::Disk(staging, mut reservation) => {
                let staged = staging.finish().await?;
                reservation.settle();
                Ok(Received {
                    blob: staged.blob(),
                    content: Content::Staged(staged),
                    reservation: Some(reservation),
                })
            }
            Self::Hash(content, fault) => {
                let known = state.store().owned_archive(owner, content.finish().digest).await?;
                let there = match known {
                    Some(blob) => state.blobs().republish(blob).await?,
                    None => None,
                };
                let (published, path) = there.ok_or(fault)?;
                let blob = published.blob;
                Ok(Received { blob, content: Content::Known(published, path), reservation: None })
            }
        }
    }
}

impl Received {
    /// What came in parts.
    pub(super) fn of_upload(staged: StagedBlob) -> Self {
        Self { blob: staged.blob(), content: Content::Staged(staged), reservation: None }
    }

    pub(super) fn blob(&self) -> BlobRef {
        self.blob
    }

    /// The file with the content.
    pub(super) fn path(&self) -> &Path {
        match &self.content {
            Content::Staged(staged) => staged.path(),
            Content::Known(_, path) => path,
        }
    }

    /// Publishes the dataset and writes down what refers to it. If that is refused the dataset is removed again, also if the client
    /// is gone by then.
    ///
    /// # Errors
    /// What is wrong with the disk; inside, what was wrong with the reference.
    pub(super) async fn keep<T: Send + 'static>(
        self,
        state: &AppState,
        refer: impl Future<Output = Result<T, StoreError>> + Send + 'static,
    ) -> Result<Result<T, StoreError>, Fault> {
        let state = state.clone();
        let keeping = async move {
            let Self { content, reservation, .. } = self;
            let published = match &content {
                Content::Staged(staged) => state.blobs().publish(staged).await?,
                Content::Known(published, _) => *published,
            };
            let referred = refer.await;
            if referred.is_err() {
                take_back(&state, published).await;
            }
            drop((content, reservation));
            Ok(referred)
        };
        // A task of its own, which ends however the request does.
        tokio::spawn(keeping.in_current_span()).await.map_err(|error| Fault::internal(&error))?
    }
}

/// Removes what was published and came to nothing.
pub(super) async fn take_back(state: &AppState, published: Published) {
    if let Err(error) = withdraw(state.store(), state.blobs(), published).await {
        let digest = published.blob.digest;
        tracing::warn!(%digest, error = &error as &dyn std::error::Error, "blob {digest} stays for a while: {error}");
    }
}
