//! Rendering of finished scenes by camera, as the HTTP layer and the command line ask for it.

use crate::domain::{Background, Camera, Digest, Image, Problem, Scene};

/// A scene with the background that it was trained on.
#[derive(Debug, Clone)]
pub struct Viewable {
    /// The decoded scene.
    pub scene: Scene,
    /// What is behind it.
    pub background: Background,
}

/// What a [`ScalarImage`] tells of each pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ScalarKind {
    /// The depth that the pixel expects: the mean, over the Gaussians that it shows and weighted as it shows them, of their
    /// centres' coordinate along the camera's axis, in world units. 0 where alpha is below [`MIN_VISIBLE_ALPHA`].
    Depth,
    /// How much of the background is covered, from 0 to 1.
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
    /// What decides, beside scene and camera, on every bit of a view: the renderer's version, adapter and driver.
    fn identity(&self) -> String;

    /// The view of the scene of the file `artifact` from `camera`; `load` is called if the scene is not at hand.
    ///
    /// # Errors
    /// Whatever `load` refuses, or a problem of its own when the adapter fails.
    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem>;

    /// As [`RenderViews::render`], of one number a pixel instead of colours.
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
