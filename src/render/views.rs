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

/// Renders views of finished scenes. Implementations may keep recently used scenes by their file's digest.
///
/// Calls block; an asynchronous caller uses a blocking task.
pub trait RenderViews: Send + Sync + 'static {
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
}
