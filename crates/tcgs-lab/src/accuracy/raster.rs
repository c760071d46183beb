//! The rasterizer on a device beside its f64 twin, forward and backward.
//!
//! A pixel at which the twin's decision (a contribution at the cut-off or the clamp of its opacity, the end of the pixel) lies
//! within [`MARGIN`] of the other one is not compared, and its derivative is zero: rounding may decide it either way.

use std::sync::Arc;

use glam::DVec3;

use super::{
    case::{Bound, Errors},
    error::CaseError,
    norms::{largest_difference, relative_l2},
    scenes,
};
use tcgs_codec::domain::Camera;
use tcgs_render::{
    GEOMETRY_SECTIONS, GaussianGradients, Gaussians, Projection, RasterCounts, RasterSettings, Rasterizer,
    RenderError, TILE,
    gpu::Device,
    twin::{self, ALPHA_MAX, Cutoffs, Gaussian, GaussianGradient, Rendering},
};

pub(super) const IMAGE: &str = "image, largest difference";
pub(super) const D_MEANS: &str = "gradient by positions, relative L2";
pub(super) const D_OPACITIES: &str = "gradient by opacities, relative L2";
pub(super) const D_SCALES: &str = "gradient by scales, relative L2";
pub(super) const D_QUATS: &str = "gradient by quaternions, relative L2";
pub(super) const D_COLORS: &str = "gradient by colors, relative L2";

/// Color behind all scenes.
pub(super) const BACKGROUND: [f32; 3] = [0.25, 0.5, 0.75];

/// The usual settings.
pub(super) const PLAIN: RasterSettings = RasterSettings { near: 0.2, antialiased: false, low_pass: 0.3 };

/// Relative distance from a cut-off within which rounding may decide.
const MARGIN: f64 = 1e-4;

/// Bounds on the image and on all gradients.
pub(super) const fn bounds(image: f64, gradients: f64, why: &'static str) -> [Bound; 6] {
    [
        Bound { quantity: IMAGE, largest: image, why },
        Bound { quantity: D_MEANS, largest: gradients, why },
        Bound { quantity: D_OPACITIES, largest: gradients, why },
        Bound { quantity: D_SCALES, largest: gradients, why },
        Bound { quantity: D_QUATS, largest: gradients, why },
        Bound { quantity: D_COLORS, largest: gradients, why },
    ]
}

/// What the device computed.
pub(super) struct Rendered {
    pub(super) counts: RasterCounts,
    /// Color and transmittance.
    pub(super) image: Vec<[f32; 4]>,
    /// Gradients by means and opacities, scales, quaternions, colors.
    pub(super) gradients: [Vec<[f32; 4]>; 4],
}

impl Rendered {
    /// Whether there is nothing but the background, and no gradient.
    pub(super) fn is_background(&self) -> bool {
        let [r, g, b] = BACKGROUND;
        self.counts.visible == 0
            && self.image.iter().all(|pixel| *pixel == [r, g, b, 1.0])
            && self.gradients.iter().flatten().all(|row| *row == [0.0; 4])
    }

    /// Whether the image and all gradients are finite.
    pub(super) fn is_finite(&self) -> bool {
        let mut values = self.gradients.iter().chain([&self.image]).flatten().flatten();
        values.all(|value| value.is_finite())
    }
}

/// Gaussians as rows of the device's buffers.
fn upload(device: &Device, scene: &[Gaussian]) -> Result<Gaussians, CaseError> {
    let rows = |row: fn(&Gaussian) -> [f32; 4]| scene.iter().map(row);
    let geometry: Vec<[f32; 4]> = rows(|g| g.mean.extend(g.opacity).as_vec4().to_array())
        .chain(rows(|g| g.scale.extend(0.0).as_vec4().to_array()))
        .chain(rows(|g| g.quat.map(|v| v as f32)))
        .collect();
    let colors: Vec<[f32; 4]> = rows(|g| g.color.extend(0.0).as_vec4().to_array()).collect();
    Ok(Gaussians {
        count: device.upload("count", &[scene.len() as u32])?,
        capacity: scene.len(),
        origin: [0.0; 3],
        geometry: device.upload("geometry", &geometry)?,
        colors: device.upload("colors", &colors)?,
    })
}

/// Renders on the device.
pub(super) fn render_image(
    device: &Arc<Device>,
    settings: RasterSettings,
    scene: &[Gaussian],
    camera: &Camera,
) -> Result<(RasterCounts, Vec<[f32; 4]>), CaseError> {
    let mut rasterizer = Rasterizer::new(Arc::clone(device), settings)?;
    let counts = forward(&mut rasterizer, &upload(device, scene)?, camera)?;
    Ok((counts, device.read(rasterizer.image())?))
}

/// The forward pass, with as much room as it needs.
fn forward(
    rasterizer: &mut Rasterizer,
    gaussians: &Gaussians,
    camera: &Camera,
) -> Result<RasterCounts, RenderError> {
    rasterizer.submit_with_room("forward", |rasterizer, recorder| {
        rasterizer.forward(recorder, gaussians, camera, BACKGROUND)
    })
}

/// Renders and differentiates on the device.
pub(super) fn render(
    device: &Arc<Device>,
    settings: RasterSettings,
    scene: &[Gaussian],
    camera: &Camera,
    d_image: &[[f32; 4]],
) -> Result<Rendered, CaseError> {
    let mut rasterizer = Rasterizer::new(Arc::clone(device), settings)?;
    let gaussians = upload(device, scene)?;
    let counts = forward(&mut rasterizer, &gaussians, camera)?;
    let d_image = device.upload("derivatives by the image", d_image)?;
    let out = GaussianGradients::plan(scene.len()).make(device)?;
    let mut recorder = device.recorder("backward");
    rasterizer.backward(&mut recorder, &gaussians, camera, &d_image, &out)?;
    recorder.submit()?;
    let mut section = device.read(&out.geometry)?;
    let [means, scales, quats] = [(); GEOMETRY_SECTIONS].map(|()| {
        let rest = section.split_off(scene.len());
        std::mem::replace(&mut section, rest)
    });
    Ok(Rendered {
        counts,
        image: device.read(rasterizer.image())?,
        gradients: [means, scales, quats, device.read(&out.colors)?],
    })
}

/// The errors of image and gradients of a scene.
pub(super) fn compare(
    device: &Arc<Device>,
    settings: RasterSettings,
    scene: &[Gaussian],
    camera: &Camera,
) -> Result<Errors, CaseError> {
    let projection = Projection::new(camera, &settings);
    let background = DVec3::from(BACKGROUND.map(f64::from));
    let rendering = twin::forward(&projection, scene, background, Cutoffs::default());
    let undecided = undecided(&projection, &rendering);
    let mut d_image = scenes::d_image(9, rendering.frame.image.len());
    for (v, undecided) in d_image.iter_mut().zip(&undecided) {
        if *undecided {
            *v = [0.0; 4];
        }
    }
    let found = render(device, settings, scene, camera, &d_image)?;
    let d_image: Vec<[f64; 4]> = d_image.iter().map(|v| v.map(f64::from)).collect();
    let (_, truth) = twin::backward(&projection, scene, &rendering, &d_image, Cutoffs::default());
    let decided = |image: Vec<[f64; 4]>| -> Vec<f64> {
        let pixels = image.into_iter().zip(&undecided).filter(|(_, undecided)| !**undecided);
        pixels.flat_map(|(pixel, _)| pixel).collect()
    };
    let image = decided(found.image.iter().map(|pixel| pixel.map(f64::from)).collect());
    let [means, scales, quats, colors] = &found.gradients;
    let gradient =
        |rows: &[[f32; 4]], columns: std::ops::Range<usize>, by: fn(&GaussianGradient) -> Vec<f64>| {
            let found: Vec<f64> =
                rows.iter().flat_map(|row| row[columns.clone()].to_vec()).map(f64::from).collect();
            relative_l2(&found, &truth.iter().flat_map(by).collect::<Vec<_>>())
        };
    Ok(vec![
        (IMAGE, largest_difference(&image, &decided(rendering.frame.image))),
        (D_MEANS, gradient(means, 0..3, |v| v.mean.to_array().to_vec())),
        (D_OPACITIES, gradient(means, 3..4, |v| vec![v.opacity])),
        (D_SCALES, gradient(scales, 0..3, |v| v.scale.to_array().to_vec())),
        (D_QUATS, gradient(quats, 0..4, |v| v.quat.to_vec())),
        (D_COLORS, gradient(colors, 0..3, |v| v.color.to_array().to_vec())),
    ])
}

/// Pixels at which rounding may decide.
pub(super) fn undecided(projection: &Projection, rendering: &Rendering) -> Vec<bool> {
    let cutoffs = Cutoffs::default();
    let near = |value: f64, cutoff: f64| (value / cutoff - 1.0).abs() < MARGIN;
    let lists = &rendering.lists;
    let is_undecided = |i: u32| {
        let (x, y) = (i % projection.size.x, i / projection.size.x);
        let [begin, end] = lists.ranges[(y / TILE * projection.tiles().x + x / TILE) as usize];
        let mut transmittance = 1.0;
        for slot in &lists.slots[begin as usize..end as usize] {
            let Some(splat) = &rendering.splats[lists.slot_ids[*slot as usize] as usize] else { continue };
            let d = splat.center - glam::DVec2::new(f64::from(x), f64::from(y)) - 0.5;
            let power =
                0.5 * (splat.conic.x * d.x * d.x + splat.conic.z * d.y * d.y) + splat.conic.y * d.x * d.y;
            let raw = splat.opacity * (-power).exp();
            if near(raw, cutoffs.alpha) || near(raw, ALPHA_MAX) {
                return true;
            }
            if raw < cutoffs.alpha {
                continue;
            }
            transmittance *= 1.0 - raw.min(ALPHA_MAX);
            if near(transmittance, cutoffs.transmittance) {
                return true;
            }
            if transmittance <= cutoffs.transmittance {
                break;
            }
        }
        false
    };
    (0..projection.size.element_product()).map(is_undecided).collect()
}
