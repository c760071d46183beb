//! Views of many scenes on one device: a cache of the most recently used, and recovery of a lost device.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::{
    RenderError, RenderViews, Renderer, Result,
    views::{ScalarImage, ScalarKind, Viewable},
};
use crate::{
    domain::{Camera, Digest, Image, Problem},
    gpu::{AdapterChoice, Device, GpuError},
};

/// Incremented with every change that alters the bits of a view.
const VERSION: u32 = 1;

/// Scenes that a [`SceneViewer`] keeps on the device.
const SCENES_KEPT: usize = 4;

/// Renders views of many scenes. Keeps the most recently used on the device, and reopens the device after it was lost or hung.
#[derive(Debug)]
pub struct SceneViewer {
    choice: AdapterChoice,
    identity: String,
    budget: u64,
    state: Mutex<ViewerState>,
}

#[derive(Debug)]
struct ViewerState {
    device: Arc<Device>,
    /// Latest used first.
    kept: Vec<(Digest, Renderer)>,
}

impl SceneViewer {
    /// Opens the adapter of choice, without a limit on its buffers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn open(choice: AdapterChoice) -> Result<Self, GpuError> {
        Self::within(choice, u64::MAX)
    }

    /// As [`SceneViewer::open`], with at most `budget` bytes of buffers. Least recently used scenes are evicted; a scene that
    /// exceeds the whole budget is refused as [`GpuError::OverBudget`].
    ///
    /// # Errors
    /// As [`SceneViewer::open`].
    pub fn within(choice: AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let state = ViewerState::open(&choice, budget)?;
        let identity = format!("{VERSION} on {}", state.device.adapter_line());
        Ok(Self { choice, identity, budget, state: Mutex::new(state) })
    }

    /// Adapter and driver in one line.
    #[must_use]
    pub fn adapter_line(&self) -> String {
        self.lock().device.adapter_line()
    }

    /// Peak bytes of buffers on the open device.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.lock().device.peak_bytes()
    }

    /// Destroys the device as a driver reset would, to test recovery.
    pub fn destroy_device(&self) {
        self.lock().device.destroy();
    }

    /// Makes the device count as hung, to test recovery.
    pub fn hang_device(&self) {
        self.lock().device.set_max_wait(Duration::ZERO);
    }

    fn lock(&self) -> MutexGuard<'_, ViewerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn draw<T>(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        draw: RenderFn<'_, T>,
    ) -> Result<T, Problem> {
        let mut state = self.lock();
        if state.device.check().is_err() {
            *state = ViewerState::open(&self.choice, self.budget)?;
        }
        match state.draw(artifact, load, draw) {
            // A loss may show only in the commands that it makes fail, and those can be repeated. Commands that hung the device
            // would hang it again while others wait, so only the next view reopens it.
            Err(error)
                if matches!(state.device.check(), Err(GpuError::DeviceLost(_) | GpuError::Rejected(_))) =>
            {
                tracing::warn!("reopening the device: {error}");
                *state = ViewerState::open(&self.choice, self.budget)?;
                state.draw(artifact, load, draw)
            }
            outcome => outcome,
        }
    }
}

impl RenderViews for SceneViewer {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        self.draw(artifact, load, &|renderer| renderer.render(camera))
    }

    fn render_scalars(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem> {
        self.draw(artifact, load, &|renderer| renderer.plane(camera, kind))
    }
}

/// A view rendered with a scene's renderer.
type RenderFn<'a, T> = &'a dyn Fn(&mut Renderer) -> Result<T>;

impl ViewerState {
    fn open(choice: &AdapterChoice, budget: u64) -> Result<Self, GpuError> {
        let device = Device::new(choice)?;
        device.set_budget_bytes(budget);
        Ok(Self { device, kept: Vec::new() })
    }

    fn draw<T>(
        &mut self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        draw: RenderFn<'_, T>,
    ) -> Result<T, Problem> {
        let found = self.kept.iter().position(|(digest, _)| *digest == artifact);
        let mut renderer = found.map(|index| self.kept.remove(index).1);
        let mut loaded = None;
        loop {
            let outcome = match &mut renderer {
                Some(renderer) => draw(renderer),
                None => {
                    let viewable = match loaded.take() {
                        Some(viewable) => viewable,
                        None => load()?,
                    };
                    let made = Renderer::of_scene(&self.device, &viewable.scene, viewable.background);
                    loaded = Some(viewable);
                    made.and_then(|made| draw(renderer.insert(made)))
                }
            };
            match outcome {
                Ok(drawn) => {
                    self.kept.splice(0..0, renderer.map(|renderer| (artifact, renderer)));
                    self.kept.truncate(SCENES_KEPT);
                    return Ok(drawn);
                }
                // Evict the least recently used scene first, then the grown buffers of this one.
                Err(RenderError::Gpu(GpuError::OverBudget { .. }))
                    if self.kept.pop().is_some() || loaded.is_none() =>
                {
                    renderer = None;
                }
                Err(error) => return Err(error.into()),
            }
        }
    }
}
