//! Cases of blending: opacities at the cut-offs, many layers, equal depths.

use std::sync::Arc;

use super::{
    case::{Case, Errors},
    error::CaseError,
    raster::{PLAIN, bounds, compare},
    scenes::{camera, changed, forward_camera, gaussians},
};
use tcgs_render::gpu::Device;

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "opacities-at-the-cut-offs",
        bounds: &bounds(
            1e-4,
            1e-4,
            "what rounding may decide either way is left out; the slope of an opacity of 0.99 is divided by 0.01",
        ),
        measure: cut_offs,
    },
    Case {
        name: "layers-2000",
        bounds: &bounds(1e-4, 1e-4, "a chain of 2000 products, whose roundings of 6e-8 mostly cancel"),
        measure: layers_2000,
    },
    Case {
        name: "layers-20000",
        bounds: &bounds(1e-4, 1e-4, "a pixel blends some hundreds of them; a chain of as many products"),
        measure: layers_20000,
    },
    Case {
        name: "equal-depths",
        bounds: &bounds(1e-4, 1e-4, "equal depths keep index order, on the device as in the truth"),
        measure: equal_depths,
    },
];

/// Opacities around 1/255, around 0.99, and 1.
fn cut_offs(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let opacities = [1.0 / 255.0, 1.002 / 255.0, 0.998 / 255.0, 0.01, 0.98, 0.9899, 0.9901, 0.995, 1.0];
    let scene = changed(gaussians(21, 45, 0.3), |i, g| g.opacity = opacities[i % opacities.len()]);
    compare(device, PLAIN, &scene, &camera(40, 36))
}

/// Layers of a little more than the least opacity, one behind the other, all of which cover the image; the last of them end the
/// pixels.
fn layers_2000(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(22, 2000, 1.0), |i, g| {
        g.mean = g.mean.with_z(4.0 + 1e-3 * i as f64);
        g.scale = g.scale * 4.0 + 8.0;
        g.opacity = 0.0042 + 0.002 * g.opacity;
    });
    compare(device, PLAIN, &scene, &forward_camera(8, 8))
}

/// Layers about as wide as a pixel, all in one tile: of layers that cover whole pixels, none behind the 2350th is seen.
fn layers_20000(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(24, 20_000, 1.0), |i, g| {
        g.mean = (2.0 * g.mean).with_z(4.0 + 1e-4 * i as f64);
        g.scale = 0.25 + 0.25 * g.scale;
        g.opacity = 0.0045 + 0.004 * g.opacity;
    });
    compare(device, PLAIN, &scene, &forward_camera(8, 8))
}

fn equal_depths(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let scene = changed(gaussians(23, 60, 0.6), |i, g| {
        g.mean = g.mean.with_z(3.0);
        g.color.x = f64::from(u8::from(i % 2 == 0));
    });
    compare(device, PLAIN, &scene, &forward_camera(32, 32))
}
