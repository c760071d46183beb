//! The interface by which the HTTP layer and the command line render finished scenes.

use serde::{Deserialize, Serialize};

use crate::domain::{Background, Camera, Digest, Image, Problem, Scene};

/// A scene and the background that it was trained on.
#[derive(Debug, Clone)]
pub struct Viewable {
    /// The decoded scene.
    pub scene: Scene,
    /// The background.
    pub background: Background,
}

/// What the numbers of a [`ScalarImage`] are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum ScalarKind {
    /// Expected depth: the mean of the Gaussians' depths (of their centers, along the camera's axis, in world units), with their
    /// blending weights. 0 where alpha is below [`MIN_VISIBLE_ALPHA`].
    Depth,
    /// Opacity of the pixel, from 0 to 1.
    Alpha,
}

/// Alpha below which a pixel shows nothing: one step of eight bits.
pub const MIN_VISIBLE_ALPHA: f32 = 1.0 / 255.0;

/// One number a pixel, row by row from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct ScalarImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `width * height` numbers, finite and not negative.
    pub values: Vec<f32>,
}

/// Renders views of finished scenes. Implementations may keep recently used scenes by their file's digest.
///
/// Calls block; an asynchronous caller uses a blocking task.
pub trait RenderViews: Send + Sync + 'static {
    /// Everything beside scene and camera that determines the bits of a view: the renderer's version, adapter and driver.
    fn identity(&self) -> String;

    /// The view of the scene of the file `artifact` from `camera`; `load` is called if the scene is not cached.
    ///
    /// # Errors
    /// Problems of `load`, or of the adapter.
    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem>;

    /// As [`RenderViews::render`], one number a pixel instead of colors.
    ///
    /// # Errors
    /// As [`RenderViews::render`].
    fn render_scalars(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem>;
}
