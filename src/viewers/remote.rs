//! The engine whose views and exports are made by the viewers of a pool.

use std::{path::Path, sync::Arc};

use super::{
    pool::{NoViewer, ViewerPool, unexpected},
    protocol::{self, Channels, ExportHead, ExportRequest, PictureHead, RenderRequest},
};
use crate::{
    domain::{
        Camera, DatasetSummary, Digest, ExportedScene, Image, NamedCamera, Problem, ReadOptions, SceneFormat,
    },
    engine::{SceneEngine, SceneSource},
    ingest::DatasetChecker,
    render::{
        RenderViews,
        views::{ScalarImage, ScalarKind, Viewable},
    },
};

/// Checks datasets in this process, and has viewers render and export.
pub struct RemoteEngine {
    checker: DatasetChecker,
    pool: Arc<ViewerPool>,
}

impl RemoteEngine {
    /// With what checks datasets and the viewers.
    #[must_use]
    pub fn new(checker: DatasetChecker, pool: Arc<ViewerPool>) -> Self {
        Self { checker, pool }
    }
}

impl SceneEngine for RemoteEngine {
    fn check(&self, archive: &Path, read: &ReadOptions) -> Result<DatasetSummary, Problem> {
        self.checker.check(archive, read)
    }

    fn renderer(&self, file: Digest) -> Result<Arc<dyn RenderViews>, Problem> {
        Ok(renderer(&self.pool, file)?)
    }

    fn export(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem> {
        export(&self.pool, source.digest, format, cameras)
    }

    fn viewers(&self) -> Option<usize> {
        Some(self.pool.len())
    }
}

/// The renderer of a scene: the viewer that is asked for it first, with those of the same identity in reserve.
///
/// # Errors
/// [`NoViewer`].
pub fn renderer(pool: &Arc<ViewerPool>, artifact: Digest) -> Result<Arc<dyn RenderViews>, NoViewer> {
    let identity = pool.in_order(artifact).into_iter().next().ok_or(NoViewer)?.identity;
    Ok(Arc::new(RemoteRenderer { pool: Arc::clone(pool), identity }))
}

/// A scene in another format, made by any viewer; blocks.
///
/// # Errors
/// [`NoViewer`] and the viewer's problems.
pub fn export(
    pool: &ViewerPool,
    artifact: Digest,
    format: SceneFormat,
    cameras: &[NamedCamera],
) -> Result<ExportedScene, Problem> {
    let request = ExportRequest { artifact, format, cameras: cameras.to_vec() };
    let answer = pool.ask(&pool.in_order(artifact), protocol::EXPORT, &request)?;
    let (head, bytes) = protocol::read(&answer).map_err(|error| unexpected(&error))?;
    let ExportHead { gaussians, sh_degree, fidelity } = head;
    Ok(ExportedScene { bytes: bytes.to_vec(), gaussians, sh_degree, fidelity })
}

/// The viewers of one identity.
struct RemoteRenderer {
    pool: Arc<ViewerPool>,
    identity: String,
}

impl RemoteRenderer {
    fn ask(&self, artifact: Digest, camera: &Camera, channels: Channels) -> Result<Vec<u8>, Problem> {
        let mut viewers = self.pool.in_order(artifact);
        viewers.retain(|viewer| viewer.identity == self.identity);
        self.pool.ask(&viewers, protocol::RENDER, &RenderRequest { artifact, camera: *camera, channels })
    }
}

impl RenderViews for RemoteRenderer {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn render(
        &self,
        artifact: Digest,
        _: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let answer = self.ask(artifact, camera, Channels::Color)?;
        let (PictureHead { channels }, samples) =
            protocol::read(&answer).map_err(|error| unexpected(&error))?;
        Image::new(camera.intrinsics.width, camera.intrinsics.height, channels, samples.to_vec())
            .map_err(|error| unexpected(&error))
    }

    fn render_scalars(
        &self,
        artifact: Digest,
        _: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem> {
        let answer = self.ask(artifact, camera, Channels::Scalars(kind))?;
        let (PictureHead { .. }, bytes) = protocol::read(&answer).map_err(|error| unexpected(&error))?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let (values, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() || values.len() as u64 != u64::from(width) * u64::from(height) {
            return Err(unexpected(&protocol::MessageError::Truncated));
        }
        Ok(ScalarImage {
            width,
            height,
            values: values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect(),
        })
    }
}
