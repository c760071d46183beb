//! Cases of image sizes.

use std::sync::Arc;

use super::{
    case::{Case, Errors},
    error::CaseError,
    raster::{PLAIN, bounds, compare},
    scenes::{camera, gaussians},
};
use tcgs_render::gpu::Device;

const AS_ANY: &str = "as any other image";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case { name: "image-1x1", bounds: &bounds(1e-4, 1e-4, AS_ANY), measure: one_by_one },
    Case { name: "image-1x5000", bounds: &bounds(1e-4, 1e-4, AS_ANY), measure: one_by_5000 },
    Case { name: "image-5000x1", bounds: &bounds(1e-4, 1e-4, AS_ANY), measure: wide },
    Case { name: "odd-tiles", bounds: &bounds(1e-4, 1e-4, AS_ANY), measure: odd_tiles },
];

fn one_by_one(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, PLAIN, &gaussians(31, 60, 0.5), &camera(1, 1))
}

fn one_by_5000(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, PLAIN, &gaussians(32, 60, 0.1), &camera(1, 5000))
}

fn wide(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, PLAIN, &gaussians(33, 60, 0.1), &camera(5000, 1))
}

/// Three by five tiles, of which the last are a pixel wide and fifteen pixels high.
fn odd_tiles(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, PLAIN, &gaussians(34, 80, 0.15), &camera(33, 79))
}
