//! Random Gaussians, uploaded, rendered and read back.

use std::sync::Arc;

use glam::DVec3;
use tcgs_codec::domain::Camera;
use tcgs_render::{
    GEOMETRY_SECTIONS, GaussianGradients, Gaussians, RasterCounts, Rasterizer,
    gpu::{Buffer, Device},
    twin::Gaussian,
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

    /// The sections as the device holds them.
    pub fn geometry(&self) -> Vec<[f32; 4]> {
        [&self.means_opacity[..], &self.scales, &self.quats].concat()
    }

    pub fn upload(&self, device: &Device) -> Gaussians {
        Gaussians {
            count: device.upload("count", &[self.len() as u32]).expect("count"),
            capacity: self.len(),
            origin: [0.0; 3],
            geometry: device.upload("geometry", &self.geometry()).expect("geometry"),
            colors: device.upload("colors", &self.colors).expect("colors"),
        }
    }
}

/// Results read back from the device.
#[derive(Clone, PartialEq, Debug)]
pub struct Rendered {
    pub counts: RasterCounts,
    pub image: Vec<[f32; 4]>,
    pub d_means_opacity: Vec<[f32; 4]>,
    pub d_scales: Vec<[f32; 4]>,
    pub d_quats: Vec<[f32; 4]>,
    pub d_colors: Vec<[f32; 4]>,
    pub d_means2d: Vec<[f32; 4]>,
}

/// The first `count` rows of each section of a geometry: positions and opacities, scales, quaternions.
pub fn sections(device: &Device, geometry: &Buffer<[f32; 4]>, count: usize) -> [Vec<[f32; 4]>; 3] {
    let capacity = geometry.len() / GEOMETRY_SECTIONS;
    [0, 1, 2].map(|section| device.read_range(geometry, section * capacity, count).expect("a section"))
}

/// Gradients on the device, full of NaN, so that a row that is never written shows.
pub fn spoiled_gradients(device: &Device, capacity: usize) -> GaussianGradients {
    let spoiled = |rows| device.upload("spoiled", &vec![[f32::NAN; 4]; rows]).expect("a buffer");
    GaussianGradients {
        geometry: spoiled(GEOMETRY_SECTIONS * capacity),
        colors: spoiled(capacity),
        means2d: spoiled(capacity),
    }
}

/// Renders forward (growing where needed) and backward, and reads everything back.
pub fn render(
    device: &Arc<Device>,
    rasterizer: &mut Rasterizer,
    scene: &Scene,
    camera: &Camera,
    background: [f32; 3],
    d_image: &[[f32; 4]],
) -> Rendered {
    let gaussians = scene.upload(device);
    let counts = loop {
        let mut recorder = device.recorder("forward");
        rasterizer.forward(&mut recorder, &gaussians, camera, background).expect("recorded");
        recorder.submit().expect("submitted");
        let counts = rasterizer.counts().expect("counts");
        if !counts.overflowed {
            break counts;
        }
        rasterizer.grow(&counts).expect("grown");
    };
    let d_image = device.upload("v_image", d_image).expect("v_image");
    let out = spoiled_gradients(device, scene.len());
    let mut recorder = device.recorder("backward");
    rasterizer.backward(&mut recorder, &gaussians, camera, &d_image, &out).expect("recorded");
    recorder.submit().expect("submitted");
    let read = |buffer| device.read(buffer).expect("read");
    let [d_means_opacity, d_scales, d_quats] = sections(device, &out.geometry, scene.len());
    Rendered {
        counts,
        image: read(rasterizer.image()),
        d_means_opacity,
        d_scales,
        d_quats,
        d_colors: read(&out.colors),
        d_means2d: read(&out.means2d),
    }
}

/// The first `width` numbers of each row, in f64.
pub fn flat(rows: &[[f32; 4]], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| row[..width].iter().map(|v| f64::from(*v))).collect()
}
