//! Milliseconds of a view against its error to the f64 reference, on made scenes of stated sizes.
//!
//! The renderer has one algorithm: Gaussians that reach no tile are culled, a stable radix sort orders the others by depth, another
//! groups them by tile. What can be varied is how kernels divide that work, so the variants are those; all have the same order. What
//! culling of faint contributions costs is told by the reference, which can do without.

use std::{sync::Arc, time::Instant};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};
use tcgs::{
    domain::{
        Background, Camera, GaussianScene, Intrinsics, NearPlane, Pose, Problem, ProblemType, Scene,
        gaussians::SH_COEFFICIENTS,
    },
    eval::{ColorError, reference_view},
    gpu::{AdapterChoice, Device, DeviceSettings, KernelVariant, Subgroups},
    render::{RenderError, SceneRenderer, twin::Cutoffs},
};

use super::{ADVICE, machine::Machine, matrix::RenderSweep};
use crate::cli::{CliError, json_lines::JsonLines, notice::notice, signals::Interruption};

/// How kernels divide their work, by name; the first is the adapter's own.
const VARIANTS: [(&str, DeviceSettings); 4] = {
    const DEFAULT: DeviceSettings = DeviceSettings {
        variant: None,
        subgroups: None,
        max_wait: None,
        max_binding_bytes: None,
        profile: false,
    };
    [
        ("as the adapter asks for", DEFAULT),
        ("without subgroups", DeviceSettings { subgroups: Some(Subgroups::Unused), ..DEFAULT }),
        (
            "sorting and lists as for a CPU",
            DeviceSettings { variant: Some(KernelVariant::Software), ..DEFAULT },
        ),
        (
            "sorting and lists as for a GPU",
            DeviceSettings { variant: Some(KernelVariant::Hardware), ..DEFAULT },
        ),
    ]
};

/// The renders of one scene at one size, of all variants in turn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SweepRecord {
    /// The adapter that was asked for, and the adapter and driver in one line.
    pub(super) adapter: [String; 2],
    /// Width and height in pixels.
    pub(super) side: u32,
    /// Gaussians in the scene.
    pub(super) gaussians: usize,
    /// Timed renders of each variant.
    pub(super) repeats: usize,
    pub(super) machine: [Machine; 2],
    pub(super) variants: Vec<VariantRecord>,
    /// Root of the mean squared difference of the reference from itself without the cut-offs of blending.
    pub(super) cutoff_rmse: f64,
    /// Seconds of the reference on a core.
    pub(super) reference_seconds: f64,
}

/// The renders of a variant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct VariantRecord {
    pub(super) name: String,
    /// Milliseconds of each timed render, with the reading back of the picture.
    pub(super) milliseconds: Vec<f64>,
    /// Against the reference.
    pub(super) error: ColorError,
}

/// The records of every size, those that there are and those that are missing.
pub(super) fn make(
    sweep: &RenderSweep,
    adapter: &AdapterChoice,
    records: &mut JsonLines<SweepRecord>,
    interruption: &Interruption,
) -> Result<Vec<SweepRecord>, CliError> {
    let mut done = Vec::new();
    let mut devices: Vec<Arc<Device>> = Vec::new();
    for gaussians in sweep.gaussians.iter().map(|count| count.0) {
        for side in sweep.sides.iter().map(|side| side.0) {
            let is_it = |record: &&SweepRecord| {
                record.adapter[0] == adapter.to_string()
                    && record.side == side
                    && record.gaussians == gaussians
                    && record.repeats == sweep.repeats
            };
            if let Some(record) = records.all().iter().find(is_it) {
                done.push(record.clone());
                continue;
            }
            if interruption.cancel.is_cancelled() {
                return Err(interruption.error(ADVICE));
            }
            if devices.is_empty() {
                for (_, settings) in &VARIANTS {
                    devices.push(
                        Device::with_settings(adapter, settings)
                            .map_err(RenderError::from)
                            .map_err(problem)?,
                    );
                }
            }
            notice(format_args!("tcgs: renders of {gaussians} Gaussians, {side} x {side} pixels"));
            let record = measure(adapter, &devices, gaussians, side, sweep.repeats).map_err(problem)?;
            done.push(records.add(&record)?);
        }
    }
    Ok(done)
}

/// The records that there are of a sweep.
pub(super) fn kept(sweep: &RenderSweep, records: &JsonLines<SweepRecord>) -> Vec<SweepRecord> {
    let is_of_it = |record: &&SweepRecord| {
        sweep.sides.iter().any(|side| side.0 == record.side)
            && sweep.gaussians.iter().any(|count| count.0 == record.gaussians)
    };
    records.all().iter().filter(is_of_it).cloned().collect()
}

fn problem(fault: RenderError) -> CliError {
    Problem::new(ProblemType::Internal, fault.to_string()).into()
}

fn measure(
    adapter: &AdapterChoice,
    devices: &[Arc<Device>],
    gaussians: usize,
    side: u32,
    repeats: usize,
) -> Result<SweepRecord, RenderError> {
    let before = Machine::now();
    let (scene, camera) = (Scene::Gaussians(shell(gaussians)), camera(side)?);
    let background = Background::Black;
    let began = Instant::now();
    let exact = reference_view(&scene, &camera, background, Cutoffs::default())?;
    let reference_seconds = began.elapsed().as_secs_f64();
    let whole = reference_view(&scene, &camera, background, Cutoffs::FINE)?;
    let different = || RenderError::Scene("a view and its reference differ in size".to_owned());
    let rounded: Vec<[f32; 4]> =
        exact.iter().map(|[r, g, b]| [*r as f32, *g as f32, *b as f32, 0.0]).collect();
    let cutoff_rmse = ColorError::of(&rounded, &whole).ok_or_else(different)?.rmse;
    let mut renderers = Vec::new();
    let mut variants = Vec::new();
    for ((name, _), device) in VARIANTS.iter().zip(devices) {
        let mut renderer = SceneRenderer::of_scene(device, &scene, background)?;
        // Makes kernels and buffers.
        let error = ColorError::of(&renderer.colors(&camera)?, &exact).ok_or_else(different)?;
        renderers.push(renderer);
        variants.push(VariantRecord { name: (*name).to_owned(), milliseconds: Vec::new(), error });
    }
    // Variants in turn, so that all meet the machine in the same states.
    for _ in 0..repeats {
        for (renderer, variant) in renderers.iter_mut().zip(&mut variants) {
            let began = Instant::now();
            renderer.colors(&camera)?;
            variant.milliseconds.push(1e3 * began.elapsed().as_secs_f64());
        }
    }
    let line = devices.first().map(|device| device.adapter_line()).unwrap_or_default();
    Ok(SweepRecord {
        adapter: [adapter.to_string(), line],
        side,
        gaussians,
        repeats,
        machine: [before, Machine::now()],
        variants,
        cutoff_rmse,
        reference_seconds,
    })
}

/// A square view from outside the shell.
fn camera(side: u32) -> Result<Camera, RenderError> {
    let fault = |what: &str| RenderError::Scene(format!("no {what} for a view of {side} pixels"));
    let pose = Pose::look_at(DVec3::new(3.0, 1.0, 1.5), DVec3::ZERO, DVec3::Z).map_err(|_| fault("pose"))?;
    let intrinsics = Intrinsics::from_horizontal_fov(0.7, side, side).map_err(|_| fault("camera"))?;
    Camera::new(intrinsics, pose).map_err(|_| fault("camera"))
}

/// Flat Gaussians on a shell of radius one, about as wide as the distance to their neighbours and turned at random, as on a surface.
fn shell(count: usize) -> GaussianScene {
    let mut rng = Pcg64::seed_from_u64(1);
    let spacing = (4.0 * std::f32::consts::PI / count.max(1) as f32).sqrt();
    let mut scene = GaussianScene { near: NearPlane::DEFAULT, ..GaussianScene::default() };
    while scene.means.len() < count {
        let at = glam::Vec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0_f32)));
        if !(0.01..1.0).contains(&at.length_squared()) {
            continue;
        }
        let width: f32 = spacing * rng.random_range(0.3..0.9);
        scene.means.push((at.normalize() * rng.random_range(0.97..1.0)).to_array());
        scene.log_scales.push([width, width * rng.random_range(0.4..1.0), 0.2 * width].map(f32::ln));
        scene.quats.push([0; 4].map(|_| rng.random_range(-1.0..1.0)));
        scene.opacity_logits.push(rng.random_range(-3.0..4.0));
        let mut sh = [[0.0; 3]; SH_COEFFICIENTS];
        sh[0] = [0; 3].map(|_| rng.random_range(-1.5..1.5));
        scene.sh.push(sh);
    }
    scene
}

impl VariantRecord {
    /// The least of its times: other work on the machine only adds to them.
    pub(super) fn least(&self) -> f64 {
        self.milliseconds.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn made_scenes_are_whole_and_the_same_every_time() {
        let scene = shell(200);
        assert_eq!(scene.len(), 200);
        assert!(scene.check().is_ok());
        assert_eq!(scene, shell(200));
        assert!(camera(16).is_ok());
    }
}
