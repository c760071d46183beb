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
use tcgs_codec::domain::{
    Background, Camera, GaussianScene, Intrinsics, NearPlane, Pose, Scene, gaussians::SH_COEFFICIENTS,
};
use tcgs_engine::eval::{ColorError, reference_view};
use tcgs_render::{
    RenderError, Renderer,
    gpu::{AdapterChoice, Device, DeviceSettings, KernelVariant, Subgroups},
    twin::Cutoffs,
};

use super::machine::Machine;

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
pub struct SweepRecord {
    /// The adapter that was asked for, and the adapter and driver in one line.
    pub adapter: [String; 2],
    /// Width and height in pixels.
    pub side: u32,
    /// Gaussians in the scene.
    pub gaussians: usize,
    /// Timed renders of each variant.
    pub repeats: usize,
    pub machine: [Machine; 2],
    pub variants: Vec<VariantRecord>,
    /// Root of the mean squared difference of the reference from itself without the cut-offs of blending.
    pub cutoff_rmse: f64,
    /// Seconds of the reference on a core.
    pub reference_seconds: f64,
}

/// The renders of a variant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VariantRecord {
    pub name: String,
    /// Milliseconds of each timed render, with the reading back of the picture.
    pub milliseconds: Vec<f64>,
    /// Against the reference.
    pub error: ColorError,
}

/// A device for each variant.
///
/// # Errors
/// Faults of the device.
pub fn devices(adapter: &AdapterChoice) -> Result<Vec<Arc<Device>>, RenderError> {
    let open = |(_, settings): &(_, DeviceSettings)| Ok(Device::with_settings(adapter, settings)?);
    VARIANTS.iter().map(open).collect()
}

/// Renders a made scene with every variant, on the [`devices`].
///
/// # Errors
/// Faults of the device, and sides that no camera has.
pub fn measure(
    adapter: &AdapterChoice,
    devices: &[Arc<Device>],
    gaussians: usize,
    side: u32,
    repeats: usize,
) -> Result<SweepRecord, RenderError> {
    let before = Machine::now();
    let (scene, camera) = (Scene::Gaussians(shell(gaussians)), camera(side)?);
    let background = Background::Black;
    let started = Instant::now();
    let exact = reference_view(&scene, &camera, background, Cutoffs::default())?;
    let reference_seconds = started.elapsed().as_secs_f64();
    let whole = reference_view(&scene, &camera, background, Cutoffs::FINE)?;
    let different = || RenderError::Scene("a view and its reference differ in size".to_owned());
    let rounded: Vec<[f32; 4]> =
        exact.iter().map(|[r, g, b]| [*r as f32, *g as f32, *b as f32, 0.0]).collect();
    let cutoff_rmse = ColorError::of(&rounded, &whole).ok_or_else(different)?.rmse;
    let mut renderers = Vec::new();
    let mut variants = Vec::new();
    for ((name, _), device) in VARIANTS.iter().zip(devices) {
        let mut renderer = Renderer::of_scene(device, &scene, background)?;
        // Makes kernels and buffers.
        let error = ColorError::of(&renderer.colors(&camera)?, &exact).ok_or_else(different)?;
        renderers.push(renderer);
        variants.push(VariantRecord { name: (*name).to_owned(), milliseconds: Vec::new(), error });
    }
    // Variants in turn, so that all meet the machine in the same states.
    for _ in 0..repeats {
        for (renderer, variant) in renderers.iter_mut().zip(&mut variants) {
            let started = Instant::now();
            renderer.colors(&camera)?;
            variant.milliseconds.push(1e3 * started.elapsed().as_secs_f64());
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
    let error = |what: &str| RenderError::Scene(format!("no {what} for a view of {side} pixels"));
    let pose = Pose::look_at(DVec3::new(3.0, 1.0, 1.5), DVec3::ZERO, DVec3::Z).map_err(|_| error("pose"))?;
    let intrinsics = Intrinsics::from_horizontal_fov(0.7, side, side).map_err(|_| error("camera"))?;
    Camera::new(intrinsics, pose).map_err(|_| error("camera"))
}

/// Flat Gaussians on a shell of radius one, about as wide as the distance to their neighbors and turned at random, as on a surface.
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
    pub fn fastest_ms(&self) -> f64 {
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
