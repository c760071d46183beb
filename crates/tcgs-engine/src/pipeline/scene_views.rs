//! Views of one finished scene on an adapter.

use std::sync::Arc;

use super::scene_file::SceneFile;
use crate::{
    domain::{Camera, Digest, Image, Problem},
    gpu::AdapterChoice,
    render::{RenderViews, SceneViewer, views::Viewable},
};

/// Renders views of one scene.
pub struct SceneViews {
    /// Adapter and driver in one line.
    pub adapter: String,
    views: Arc<dyn RenderViews>,
    key: Digest,
    pub(super) viewable: Viewable,
}

impl SceneViews {
    /// Opens the adapter for the scene of a file.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn open(file: SceneFile, adapter: &AdapterChoice) -> Result<Self, Problem> {
        let views = SceneViewer::within(adapter.clone(), u64::MAX)?;
        let (adapter, views) = (views.adapter_line(), Arc::new(views));
        let viewable = Viewable { scene: file.scene, background: file.background };
        // Any hash that differs between scenes serves as the key.
        Ok(Self { adapter, views, key: file.decode_sha256, viewable })
    }

    /// With a renderer that is already open, for the scene of a file with this hash.
    #[must_use]
    pub fn over(views: Arc<dyn RenderViews>, key: Digest, file: SceneFile) -> Self {
        let viewable = Viewable { scene: file.scene, background: file.background };
        Self { adapter: views.identity(), views, key, viewable }
    }

    /// Another scene on the same adapter.
    #[must_use]
    pub fn beside(&self, file: SceneFile) -> Self {
        Self {
            adapter: self.adapter.clone(),
            views: Arc::clone(&self.views),
            key: file.decode_sha256,
            viewable: Viewable { scene: file.scene, background: file.background },
        }
    }

    /// The view from `camera`, over the background that the scene was trained on.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn view(&self, camera: &Camera) -> Result<Image, Problem> {
        self.views.render(self.key, &|| Ok(self.viewable.clone()), camera)
    }
}
