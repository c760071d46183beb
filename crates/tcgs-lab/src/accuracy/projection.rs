//! Cases of the projection: shapes, distances, coordinates and parameters at the ends of their ranges.

use std::sync::Arc;

use glam::DVec3;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::unless,
    raster::{PLAIN, bounds, compare, render},
    scenes::{camera, camera_at, changed, d_image, forward_camera, gaussians},
};
use tcgs_render::{RasterSettings, gpu::Device, twin::Gaussian};

const FORTY: &str = "forty roundings of 6e-8 in a chain";
const CULLED: &str = "what is culled leaves exactly the background and no gradient";
const UNTOUCHED: &str = "the other Gaussians give the same bits as without it";

const EMPTY: &str = "image and gradients, 0 if those of an empty scene";
const ALONE: &str = "image and gradients, 0 if those of the others alone";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "needles",
        bounds: &bounds(
            1e-4,
            1e-3,
            "axis ratios to 1e4: the gradient by a rotation is a difference of terms that are so much larger",
        ),
        measure: needles,
    },
    Case { name: "discs", bounds: &bounds(1e-4, 1e-3, "as needles"), measure: discs },
    Case { name: "sub-pixel", bounds: &bounds(1e-4, 1e-4, FORTY), measure: sub_pixel },
    Case {
        name: "sub-pixel-antialiased",
        bounds: &bounds(1e-4, 1e-4, FORTY),
        measure: sub_pixel_antialiased,
    },
    Case { name: "screen-filling", bounds: &bounds(1e-4, 1e-4, FORTY), measure: screen_filling },
    Case { name: "camera-inside", bounds: &bounds(1e-4, 1e-4, FORTY), measure: camera_inside },
    Case {
        name: "near-plane-grazing",
        bounds: &bounds(
            1e-4,
            1e-3,
            "gradients grow with the inverse square of the depth, and with them what they are differences of",
        ),
        measure: near_plane,
    },
    Case {
        name: "behind-the-camera",
        bounds: &[Bound { quantity: EMPTY, largest: 0.0, why: CULLED }],
        measure: behind,
    },
    Case { name: "coordinates-of-1e-6", bounds: &bounds(1e-4, 1e-4, FORTY), measure: tiny },
    Case { name: "coordinates-of-1e6", bounds: &bounds(1e-4, 1e-4, FORTY), measure: huge },
    Case {
        name: "1e5-from-the-origin",
        bounds: &bounds(1e-4, 1e-4, "as near the origin: differences to the camera are exact"),
        measure: far,
    },
    Case { name: "quaternions-of-any-length", bounds: &bounds(1e-4, 1e-4, FORTY), measure: unnormalized },
    Case {
        name: "zero-quaternions",
        bounds: &[Bound { quantity: ALONE, largest: 0.0, why: UNTOUCHED }],
        measure: zero_quaternions,
    },
    Case {
        name: "parameters-not-finite",
        bounds: &[Bound { quantity: ALONE, largest: 0.0, why: UNTOUCHED }],
        measure: not_finite,
    },
    Case {
        name: "parameters-denormal",
        bounds: &bounds(1e-4, 1e-4, "whether a denormal number counts as zero makes no difference"),
        measure: denormal,
    },
];

fn needles(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(1, 40, 0.5), |i, g| {
        let ratio = 10_f64.powi(1 + i as i32 % 4);
        g.scale = g.scale.x * DVec3::new(1.0, 1.0 / ratio, 1.0 / ratio);
    });
    compare(device, PLAIN, &scene, &camera(48, 40))
}

fn discs(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(2, 40, 0.5), |i, g| {
        g.scale = g.scale.x * DVec3::new(1.0, 1.0, 10_f64.powi(-1 - i as i32 % 4));
    });
    compare(device, PLAIN, &scene, &camera(48, 40))
}

/// Standard deviations from a thousandth of a pixel to a pixel.
fn specks() -> Vec<Gaussian> {
    changed(gaussians(3, 80, 1.0), |i, g| g.scale *= 0.07 * 10_f64.powi(-(i as i32 % 4)))
}

fn sub_pixel(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, PLAIN, &specks(), &camera(48, 40))
}

fn sub_pixel_antialiased(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, RasterSettings { antialiased: true, ..PLAIN }, &specks(), &camera(48, 40))
}

/// Standard deviations from a screen to a thousand screens.
fn screen_filling(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(4, 12, 1.0), |i, g| {
        g.scale *= 4.0 * 10_f64.powi(i as i32 % 4);
        g.opacity *= 0.5;
    });
    compare(device, PLAIN, &scene, &camera(40, 36))
}

/// A camera in the middle of Gaussians that are larger than their distance; half of them are behind it.
fn camera_inside(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(5, 30, 1.5), |_, g| g.opacity *= 0.5);
    let camera = camera_at(DVec3::new(0.1, 0.0, -0.2), DVec3::new(1.0, 0.3, 0.1), 40, 36);
    compare(device, PLAIN, &scene, &camera)
}

/// Centers at the near plane, a few units in the last place before and behind it.
fn near_plane(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(6, 40, 0.02), |i, g| {
        let steps = [-2, -1, 0, 1, 2, 1000, 100_000][i % 7];
        let depth = f32::from_bits(PLAIN.near.to_bits().wrapping_add_signed(steps));
        g.mean = (g.mean * 0.06).with_z(f64::from(depth));
    });
    compare(device, PLAIN, &scene, &forward_camera(40, 36))
}

fn behind(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(7, 40, 0.5), |_, g| g.mean.z -= 3.0);
    let found = render(device, PLAIN, &scene, &forward_camera(24, 20), &d_image(9, 480))?;
    Ok(vec![(EMPTY, unless(found.is_background()))])
}

/// The scene and the camera at another scale.
fn scaled(device: &Arc<Device>, by: f64) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(8, 60, 0.2), |_, g| {
        g.mean *= by;
        g.scale *= by;
    });
    let camera = camera_at(by * DVec3::new(3.0, -2.0, 1.7), DVec3::ZERO, 48, 40);
    compare(device, RasterSettings { near: (0.2 * by) as f32, ..PLAIN }, &scene, &camera)
}

fn tiny(device: &Arc<Device>) -> Result<Errors, CaseError> {
    scaled(device, 1e-6)
}

fn huge(device: &Arc<Device>) -> Result<Errors, CaseError> {
    scaled(device, 1e6)
}

/// A scene 1e5 from the origin along each axis, where neighboring f32 are 0.008 apart.
fn far(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let origin = DVec3::new(1e5, -1e5, 1e5);
    let scene = changed(gaussians(9, 60, 0.2), |_, g| g.mean += origin);
    let camera = camera_at(origin + DVec3::new(3.0, -2.0, 1.7), origin, 48, 40);
    compare(device, PLAIN, &scene, &camera)
}

fn unnormalized(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(10, 60, 0.2), |i, g| {
        let length = 10_f64.powi(3 * (i as i32 % 5) - 6);
        g.quat = g.quat.map(|v| v * length);
    });
    compare(device, PLAIN, &scene, &camera(48, 40))
}

/// Whether `bad` Gaussians before, among and behind good ones change nothing.
fn without_effect(device: &Arc<Device>, bad: &[Gaussian]) -> Result<Errors, CaseError> {
    let good = gaussians(11, 30, 0.2);
    let (camera, d_image) = (camera(40, 36), d_image(9, 40 * 36));
    let alone = render(device, PLAIN, &good, &camera, &d_image)?;
    let mixed: Vec<Gaussian> = good.iter().chain(bad).copied().collect();
    let mixed = render(device, PLAIN, &mixed, &camera, &d_image)?;
    let same = alone.image == mixed.image
        && alone.gradients.iter().zip(&mixed.gradients).all(|(alone, mixed)| {
            let (of_good, of_bad) = mixed.split_at(good.len());
            *alone == of_good && of_bad.iter().all(|row| *row == [0.0; 4])
        });
    Ok(vec![(ALONE, unless(same && alone.is_finite()))])
}

fn zero_quaternions(device: &Arc<Device>) -> Result<Errors, CaseError> {
    without_effect(device, &changed(gaussians(12, 8, 0.5), |i, g| g.quat = [[0.0; 4], [1e-20; 4]][i % 2]))
}

fn not_finite(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
    let scene = changed(gaussians(13, 15, 0.5), |i, g| {
        let v = bad[i % 3];
        match i / 3 {
            0 => g.mean.x = v,
            1 => g.opacity = v,
            2 => g.scale.y = v,
            3 => g.quat[2] = v,
            _ => g.color.z = v,
        }
    });
    without_effect(device, &scene)
}

fn denormal(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(14, 30, 0.2), |i, g| {
        let v = 1e-40;
        match i % 6 {
            0 => g.mean.x = v,
            1 => g.opacity = v,
            2 => g.scale.y = v,
            3 => g.scale = DVec3::splat(v),
            4 => g.quat = [v; 4],
            _ => g.color = DVec3::splat(v),
        }
    });
    compare(device, PLAIN, &scene, &camera(40, 36))
}
