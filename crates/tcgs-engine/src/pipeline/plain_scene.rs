//! A finished scene as plain Gaussians: anchors are baked for some cameras and refined by renders from there.

use std::time::Instant;

use serde::Serialize;

use crate::{
    domain::{AnchorScene, Camera, GaussianScene, Problem, ProblemType, Scene, harmonics},
    export::bake::{self, BakeSettings},
    gpu::{AdapterChoice, Device},
    train::Refinement,
};

use super::scene_file::SceneFile;

/// Cameras on the sphere for baking a scene without training cameras.
pub(super) const SPHERE_VIEWS: usize = 96;

/// Width and height of pictures from the sphere.
pub(super) const SPHERE_SIDE: u32 = 320;

/// The highest degree of spherical harmonics.
pub(super) const MAX_DEGREE: u8 = 3;

/// Steps by which baked Gaussians are refined: twice as many take twice the time for another 1.5 dB on plush (docs/VIEWERS.md).
pub const REFINEMENT_STEPS: u32 = 100;

/// A scene as plain Gaussians.
#[derive(Debug, Clone)]
pub struct PlainScene {
    /// In its own frame.
    pub scene: GaussianScene,
    /// How anchors became Gaussians; `None` if the file holds plain ones.
    pub baking: Option<Baking>,
}

/// What an anchor scene was baked from.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Baking {
    /// "training views" or "sphere".
    pub from: &'static str,
    /// How many.
    pub views: usize,
    /// Unmasked offsets without a Gaussian visible in any of them.
    pub unseen: usize,
    /// How long it took.
    pub seconds: f64,
    /// How its Gaussians were refined; null if they were not.
    pub refined: Option<Refined>,
}

/// How baked Gaussians were refined.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Refined {
    /// Steps, each by one render of the scene.
    pub steps: u32,
    /// How long they took.
    pub seconds: f64,
}

/// Refines baked Gaussians on an adapter.
pub struct Refiner {
    adapter: AdapterChoice,
    memory: u64,
    steps: u32,
    report: Box<dyn Fn(u32) + Send + Sync>,
}

impl Refiner {
    /// On this adapter, with at most `memory` bytes of buffers there.
    #[must_use]
    pub fn new(adapter: AdapterChoice, memory: u64) -> Self {
        Self { adapter, memory, steps: REFINEMENT_STEPS, report: Box::new(|_| ()) }
    }

    /// In another number of steps; `report` is told of each.
    #[must_use]
    pub fn with_steps(self, steps: u32, report: Box<dyn Fn(u32) + Send + Sync>) -> Self {
        Self { steps, report, ..self }
    }

    /// The Gaussians refined; as they are where the adapter has no memory for that.
    fn refine(
        &self,
        file: &SceneFile,
        baked: &GaussianScene,
        cameras: &[Camera],
    ) -> Result<Option<(GaussianScene, Refined)>, Problem> {
        if self.steps == 0 {
            return Ok(None);
        }
        let started = Instant::now();
        let device = Device::new(&self.adapter)?;
        device.set_budget_bytes(self.memory);
        let refinement =
            Refinement { scene: &file.scene, background: file.background, cameras, steps: self.steps };
        match refinement.of(&device, baked, &*self.report).map_err(Problem::from) {
            Ok(scene) => {
                let refined = Refined { steps: self.steps, seconds: started.elapsed().as_secs_f64() };
                Ok(Some((scene, refined)))
            }
            Err(problem) if problem.is(ProblemType::GpuMemory) || problem.is(ProblemType::SceneTooLarge) => {
                tracing::warn!("an export is not refined: {}", problem.detail);
                Ok(None)
            }
            Err(problem) => Err(problem),
        }
    }
}

/// A scene as plain Gaussians of a degree. Anchors are baked from `cameras` and refined, or baked from a sphere without any.
///
/// # Errors
/// 422 for a scene that cannot be baked; faults of the refiner's device.
pub fn plain(
    file: &SceneFile,
    degree: u8,
    cameras: Option<&[Camera]>,
    refiner: Option<&Refiner>,
) -> Result<PlainScene, Problem> {
    match &file.scene {
        Scene::Gaussians(scene) => Ok(PlainScene { scene: lowered(scene.clone(), degree), baking: None }),
        Scene::Anchors(scene) => baked(file, scene, degree, cameras, refiner),
    }
}

fn baked(
    file: &SceneFile,
    scene: &AnchorScene,
    degree: u8,
    cameras: Option<&[Camera]>,
    refiner: Option<&Refiner>,
) -> Result<PlainScene, Problem> {
    let started = Instant::now();
    let settings = BakeSettings { degree, ..BakeSettings::default() };
    let (views, from) = match cameras {
        Some(cameras) => (bake::thinned(cameras), "training views"),
        None => (sphere(file, SPHERE_VIEWS)?, "sphere"),
    };
    let baked = bake::bake(scene, &views, settings).map_err(not_exportable)?;
    let seconds = started.elapsed().as_secs_f64();
    let refined = match (refiner, cameras) {
        (Some(refiner), Some(cameras)) => refiner.refine(file, &baked.scene, cameras)?,
        _ => None,
    };
    let (scene, refined) = match refined {
        Some((scene, refined)) => (scene, Some(refined)),
        None => (baked.scene, None),
    };
    let baking = Baking { from, views: baked.views, unseen: baked.unseen, seconds, refined };
    Ok(PlainScene { scene, baking: Some(baking) })
}

/// Cameras on a sphere around a scene, in the world.
///
/// # Errors
/// A problem of type `not-exportable` for a scene without extent.
pub fn sphere(file: &SceneFile, count: usize) -> Result<Vec<Camera>, Problem> {
    sphere_of(&file.scene, count)
}

pub(super) fn sphere_of(scene: &Scene, count: usize) -> Result<Vec<Camera>, Problem> {
    let cameras = match scene {
        Scene::Gaussians(scene) => bake::sphere(&scene.means, count, SPHERE_SIDE),
        Scene::Anchors(scene) => {
            let positions: Vec<[f32; 3]> =
                scene.cells.iter().map(|cell| scene.lattice.position(*cell)).collect();
            bake::sphere(&positions, count, SPHERE_SIDE)
        }
    };
    let frame = scene.frame();
    let in_world =
        |cameras: Vec<Camera>| cameras.iter().map(|camera| frame.camera_to_world(camera)).collect();
    cameras.map(in_world).map_err(not_exportable)
}

/// The scene without harmonics above `degree`.
fn lowered(mut scene: GaussianScene, degree: u8) -> GaussianScene {
    if degree < scene.degree {
        scene.degree = degree;
        for row in &mut scene.sh {
            row[harmonics::functions(degree)..].fill([0.0; 3]);
        }
    }
    scene
}

pub(super) fn not_exportable(error: impl std::fmt::Display) -> Problem {
    Problem::new(ProblemType::NotExportable, error.to_string())
}
