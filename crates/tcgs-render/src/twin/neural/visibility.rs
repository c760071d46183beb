//! The visible anchors of a view, the networks' inputs, and the statistics that a view adds.

use glam::{DVec2, DVec3};

use super::{Gaussian, LIMIT, Projection};
use crate::{
    domain::SceneScale,
    gpu::{BLOCK, twin::scan},
    model::Shape,
    twin::SplatGradient,
};

/// Whether the three-sigma box of the anchor, projected as an axis-aligned Gaussian of its offset scale, touches the
/// image (METHOD.md §2.3).
#[must_use]
pub fn anchor_visible(projection: &Projection, position: DVec3, shape: Shape, row: &[f64]) -> bool {
    // A constant of this test, independent of the rasteriser's settings.
    const LOW_PASS: f64 = 0.3;
    let view = projection.rotation;
    let p = view * position + projection.translation;
    let beyond_near = p.z > projection.near;
    if !beyond_near {
        return false;
    }
    let reach = DVec3::from_slice(&row[shape.scaling_column()..][..3]).map(f64::exp);
    let (low, high) = projection.slopes();
    let slope = (p.truncate() / p.z).clamp(low, high);
    let variance = DVec2::from([0, 1].map(|i| {
        let across = projection.focal[i] / p.z * (view.row(i) - slope[i] * view.row(2)) * reach;
        across.length_squared() + LOW_PASS
    }));
    let radius = 3.0 * variance.map(f64::sqrt);
    let center = projection.focal * p.truncate() / p.z + projection.center;
    (center + radius).cmpgt(DVec2::ZERO).all() && (center - radius).cmplt(projection.size.as_dvec2()).all()
}

/// The visible anchors in ascending order.
#[must_use]
pub fn compact_anchors(visible: &[bool]) -> Vec<u32> {
    (0..).zip(visible).filter(|(_, visible)| **visible).map(|(anchor, _)| anchor).collect()
}

/// How many anchors of each block are visible.
#[must_use]
pub fn count_visible_anchors(visible: &[bool]) -> Vec<u32> {
    visible.chunks(BLOCK).map(|block| block.iter().filter(|flag| **flag).count() as u32).collect()
}

/// The visible anchors in ascending order, from the counts of their blocks.
#[must_use]
pub fn list_visible_anchors(visible: &[bool], block_counts: &[u32]) -> Vec<u32> {
    let (starts, total) = scan(block_counts);
    let mut list = vec![0; total as usize];
    for (block, (flags, start)) in visible.chunks(BLOCK).zip(starts).enumerate() {
        let set = (0..).zip(flags).filter(|(_, flag)| **flag).map(|(i, _)| (block * BLOCK) as u32 + i);
        list.iter_mut().skip(start as usize).zip(set).for_each(|(entry, anchor)| *entry = anchor);
    }
    list
}

/// Whether a visible anchor makes a Gaussian, by the opacities' outputs: some offset is opaque and its mask on.
#[must_use]
pub fn opaque_anchors(mask: u32, outputs: &[f64]) -> bool {
    outputs.iter().enumerate().any(|(k, output)| (mask >> k) & 1 == 1 && output.is_finite() && *output > 0.0)
}

/// Feature, unit view direction, distance in units of `unit` (METHOD.md §2.2). A feature value that is not finite reads as
/// zero.
#[must_use]
pub fn network_input(
    projection: &Projection,
    position: DVec3,
    shape: Shape,
    row: &[f64],
    scene_scale: SceneScale,
) -> Vec<f64> {
    let center = -(projection.rotation.transpose() * projection.translation);
    let ray = position - center;
    let distance = ray.length().max(1e-12);
    let finite = |value: &f64| if value.abs() < LIMIT { *value } else { 0.0 };
    let mut input: Vec<f64> = row[..shape.features].iter().map(finite).collect();
    input.extend((ray / distance).to_array());
    input.push(distance / f64::from(scene_scale.length()));
    input
}

/// Writes the feature's part of the input gradient into the anchor's row.
pub fn feature_gradient(shape: Shape, d_input: &[f64], d_row: &mut [f64]) {
    d_row[..shape.features].copy_from_slice(&d_input[..shape.features]);
}

/// Adds one view to an anchor's row of statistics (METHOD.md §2.6): K sums of screen-gradient norms in half-image units,
/// K counts of views, the sum of positive opacities, visits. `tiles` is what each Gaussian touches; 0 is culled.
pub fn anchor_statistics(
    projection: &Projection,
    gaussians: &[Option<Gaussian>],
    v_splats: &[SplatGradient],
    tiles: &[u32],
    statistics: &mut [f64],
) {
    let offsets = gaussians.len();
    for (k, gaussian) in gaussians.iter().enumerate() {
        let Some(gaussian) = gaussian else { continue };
        statistics[2 * offsets] += gaussian.opacity;
        if tiles[k] > 0 {
            statistics[k] += (v_splats[k].center * 0.5 * projection.size.as_dvec2()).length();
            statistics[offsets + k] += 1.0;
        }
    }
    statistics[2 * offsets + 1] += 1.0;
}
