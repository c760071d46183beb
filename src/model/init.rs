//! First values of the anchors' parameters.

use rand::{Rng, RngExt};
use thiserror::Error;

use super::{
    AnchorRows, Shape, VoxelRule, choose_lattice,
    lattice::{neighbour_distances, voxelise},
};

/// A point set that no scene can begin with.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum InitError {
    /// No points.
    #[error("there are no points to begin with")]
    NoPoints,
    /// A coordinate is NaN or infinite.
    #[error("point {0} is not finite")]
    NonFinite(usize),
}

/// `count` points uniform in the box, for sets without a point cloud (method.md §1.1).
#[must_use]
pub fn random_points(rng: &mut impl Rng, count: usize, low: [f32; 3], high: [f32; 3]) -> Vec<[f32; 3]> {
    (0..count).map(|_| std::array::from_fn(|axis| rng.random_range(low[axis]..high[axis]))).collect()
}

/// Anchors from points: voxelised, offsets and features zero, all six log-scalings the logarithm of the distance to
/// the anchor's neighbours (method.md §1.2).
///
/// # Errors
/// [`InitError`] for an empty or non-finite point set.
pub fn initial_rows(points: &[[f32; 3]], rule: VoxelRule, shape: Shape) -> Result<AnchorRows, InitError> {
    if points.is_empty() {
        return Err(InitError::NoPoints);
    }
    if let Some(index) = points.iter().position(|point| point.iter().any(|v| !v.is_finite())) {
        return Err(InitError::NonFinite(index));
    }
    let lattice = choose_lattice(points, rule);
    let cells = voxelise(&lattice, points);
    let positions: Vec<[f32; 3]> = cells.iter().map(|cell| lattice.position(*cell)).collect();
    let mut values = vec![0.0; cells.len() * shape.row()];
    for (row, distance) in values.chunks_exact_mut(shape.row()).zip(neighbour_distances(&positions)) {
        let log_scale = distance.max(lattice.voxel).ln();
        row[shape.scaling_column()..shape.offset_column()].fill(log_scale);
    }
    let masks = vec![all_offsets(shape); cells.len()];
    Ok(AnchorRows { shape, lattice, cells, values, masks })
}

/// The mask with every offset on.
#[must_use]
pub fn all_offsets(shape: Shape) -> u32 {
    if shape.offsets >= 32 { u32::MAX } else { (1 << shape.offsets) - 1 }
}
