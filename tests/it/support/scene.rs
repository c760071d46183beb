//! Gaussians on their way to the device and back.

use std::sync::Arc;

use glam::DVec3;
use tcgs::{
    domain::Camera,
    gpu::Context,
    render::{Counts, GaussianGradients, Gaussians, Rasterizer, twin::Gaussian},
};

/// Gaussians on the host.
#[derive(Clone, Default, Debug)]
pub struct Scene {
    /// Positions and opacity.
    pub means_opacity: Vec<[f32; 4]>,
    pub scales: Vec<[f32; 4]>,
    pub quats: Vec<[f32; 4]>,
    pub colors: Vec<[f32; 4]>,
}

impl Scene {
    pub fn new(gaussians: &[Gaussian]) -> Self {
        let four = |v: DVec3, w: f64| v.extend(w).as_vec4().to_array();
        Self {
            means_opacity: gaussians.iter().map(|g| four(g.mean, g.opacity)).collect(),
            scales: gaussians.iter().map(|g| four(g.scale, 0.0)).collect(),
            quats: gaussians.iter().map(|g| g.quat.map(|v| v as f32)).collect(),
            colors: gaussians.iter().map(|g| four(g.color, 0.0)).collect(),
        }
    }

    pub fn len(&self) -> usize {
        self.means_opacity.len()
    }

    pub fn upload(&self, context: &Context) -> Gaussians {
        Gaussians {
            count: context.upload("count", &[self.len() as u32]).expect("count"),
            capacity: self.len(),
            means_opacity: context.upload("means", &self.means_opacity).expect("means"),
            scales: context.upload("scales", &self.scales).expect("scales"),
            quats: context.upload("quats", &self.quats).expect("quats"),
            colors: context.upload("colors", &self.colors).expect("colors"),
        }
    }
}

/// What came back from the device.
#[derive(Clone, PartialEq, Debug)]
pub struct Rendered {
    pub counts: Counts,
    pub image: Vec<[f32; 4]>,
    pub v_means_opacity: Vec<[f32; 4]>,
    pub v_scales: Vec<[f32; 4]>,
    pub v_quats: Vec<[f32; 4]>,
    pub v_colors: Vec<[f32; 4]>,
    pub v_means2d: Vec<[f32; 4]>,
}

/// Gradients on the device, full of NaN, so that a row that is never written shows.
pub fn spoiled_gradients(context: &Context, capacity: usize) -> GaussianGradients {
    let spoiled = || context.upload("spoiled", &vec![[f32::NAN; 4]; capacity]).expect("a buffer");
    GaussianGradients {
        means_opacity: spoiled(),
        scales: spoiled(),
        quats: spoiled(),
        colors: spoiled(),
        means2d: spoiled(),
    }
}

/// Renders forward (growing where needed) and backward, and reads everything back.
pub fn render(
    context: &Arc<Context>,
    rasterizer: &mut Rasterizer,
    scene: &Scene,
    camera: &Camera,
    background: [f32; 3],
    v_image: &[[f32; 4]],
) -> Rendered {
    let gaussians = scene.upload(context);
    let counts = loop {
        let mut recorder = context.recorder("forward");
        rasterizer.forward(&mut recorder, &gaussians, camera, background).expect("recorded");
        recorder.submit().expect("submitted");
        let counts = rasterizer.counts().expect("counts");
        if !counts.overflowed {
            break counts;
        }
        rasterizer.grow(&counts).expect("grown");
    };
    let v_image = context.upload("v_image", v_image).expect("v_image");
    let out = spoiled_gradients(context, scene.len());
    let mut recorder = context.recorder("backward");
    rasterizer.backward(&mut recorder, &gaussians, camera, &v_image, &out).expect("recorded");
    recorder.submit().expect("submitted");
    let read = |buffer| context.read(buffer).expect("read");
    Rendered {
        counts,
        image: read(rasterizer.image()),
        v_means_opacity: read(&out.means_opacity),
        v_scales: read(&out.scales),
        v_quats: read(&out.quats),
        v_colors: read(&out.colors),
        v_means2d: read(&out.means2d),
    }
}

/// The first `width` numbers of each row, in f64.
pub fn flat(rows: &[[f32; 4]], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| row[..width].iter().map(|v| f64::from(*v))).collect()
}
