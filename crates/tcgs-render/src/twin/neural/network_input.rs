//! The networks' inputs.

use glam::DVec3;

use super::LIMIT;
use crate::{Projection, domain::SceneScale, model::ModelShape};

/// Feature, unit view direction, distance in units of `scene_scale`, harmonics of the direction (METHOD.md §2.2). A feature value that is
/// not finite reads as zero.
#[must_use]
pub fn network_input(
    projection: &Projection,
    position: DVec3,
    shape: ModelShape,
    row: &[f64],
    scene_scale: SceneScale,
) -> Vec<f64> {
    let center = -(projection.rotation.transpose() * projection.translation);
    let ray = position - center;
    let distance = ray.length().max(1e-12);
    let finite = |value: &f64| if value.abs() < LIMIT { *value } else { 0.0 };
    let mut input: Vec<f64> = row[..shape.features].iter().map(finite).collect();
    let direction = ray / distance;
    input.extend(direction.to_array());
    input.push(distance / f64::from(scene_scale.length()));
    input.extend(shape.view_degree.harmonics(direction));
    input
}
