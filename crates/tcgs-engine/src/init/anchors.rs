//! Initial values of the anchors' parameters.

use rand::{Rng, RngExt};
use thiserror::Error;

use super::{
    VoxelRule, choose_lattice,
    lattice::{coarse, voxelise},
    neighbors::neighbor_distances,
};
use crate::model::{AnchorRows, ModelShape, all_offsets};

/// A point set that cannot initialize a scene.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum InitError {
    /// No points.
    #[error("there are no points")]
    NoPoints,
    /// A coordinate is NaN or infinite.
    #[error("point {0} is not finite")]
    NonFinite(usize),
}

/// `count` points uniform in the box, for sets without a point cloud (METHOD.md §1.1). An axis whose corners are one has one value.
#[must_use]
pub fn random_points(rng: &mut impl Rng, count: usize, low: [f32; 3], high: [f32; 3]) -> Vec<[f32; 3]> {
    let mut along = |axis: usize| {
        let (low, high) = (low[axis], high[axis]);
        if low < high { rng.random_range(low..high) } else { low }
    };
    (0..count).map(|_| std::array::from_fn(&mut along)).collect()
}

/// Anchors from points: voxelised, offsets and features zero, all six log-scalings the logarithm of the distance to
/// the anchor's neighbors (METHOD.md §2.1). A cloud that would make more than `max_anchors` anchors is thinned evenly.
///
/// # Errors
/// [`InitError`] for an empty or non-finite point set.
pub fn initial_rows(
    points: &[[f32; 3]],
    rule: VoxelRule,
    shape: ModelShape,
    max_anchors: usize,
) -> Result<AnchorRows, InitError> {
    Ok(thinned_rows(points, rule, shape, max_anchors)?.0)
}

/// The anchors of [`initial_rows`], and the edge of the blocks of cells that became one anchor each, in cells.
pub(super) fn thinned_rows(
    points: &[[f32; 3]],
    rule: VoxelRule,
    shape: ModelShape,
    max_anchors: usize,
) -> Result<(AnchorRows, i32), InitError> {
    if points.is_empty() {
        return Err(InitError::NoPoints);
    }
    if let Some(index) = points.iter().position(|point| point.iter().any(|v| !v.is_finite())) {
        return Err(InitError::NonFinite(index));
    }
    let lattice = choose_lattice(points, rule);
    let (cells, block) = thin(voxelise(&lattice, points), max_anchors);
    let positions: Vec<[f32; 3]> = cells.iter().map(|cell| lattice.position(*cell)).collect();
    let mut values = vec![0.0; cells.len() * shape.row()];
    for (row, distance) in values.chunks_exact_mut(shape.row()).zip(neighbor_distances(&positions)) {
        let log_scale = distance.max(lattice.voxel).ln();
        row[shape.scaling_column()..shape.offset_column()].fill(log_scale);
    }
    let masks = vec![all_offsets(shape); cells.len()];
    Ok((AnchorRows { shape, lattice, cells, values, masks }, block))
}

/// Largest edge of a block, in cells: one block has all of them.
const MAX_BLOCK: i32 = 1 << 21;

/// At most `max_cells` of the cells (but at least one), and the edge of the blocks that have one each: the smallest blocks that are few
/// enough. A block keeps the cell nearest to the mean of its cells.
fn thin(cells: Vec<[i32; 3]>, max_cells: usize) -> (Vec<[i32; 3]>, i32) {
    let max_cells = max_cells.max(1);
    if cells.len() <= max_cells {
        return (cells, 1);
    }
    let mut blocks = Vec::with_capacity(cells.len());
    let mut count = |edge: i32| {
        blocks.clear();
        blocks.extend(cells.iter().map(|cell| coarse(*cell, edge)));
        blocks.sort_unstable();
        blocks.dedup();
        blocks.len()
    };
    // Blocks of `small` are too many.
    let (mut small, mut large) = (1, 2);
    while large < MAX_BLOCK && count(large) > max_cells {
        (small, large) = (large, 2 * large);
    }
    while large - small > 1 {
        let middle = small + (large - small) / 2;
        if count(middle) > max_cells { small = middle } else { large = middle }
    }
    let mut members: Vec<_> = cells.into_iter().map(|cell| (coarse(cell, large), cell)).collect();
    members.sort_unstable();
    let mut kept: Vec<_> = members.chunk_by(|a, b| a.0 == b.0).map(most_central).collect();
    kept.sort_unstable();
    (kept, large)
}

/// The cell of a block that is nearest to the mean of its cells.
fn most_central(members: &[([i32; 3], [i32; 3])]) -> [i32; 3] {
    let mean: [f64; 3] = std::array::from_fn(|axis| {
        members.iter().map(|(_, cell)| f64::from(cell[axis])).sum::<f64>() / members.len() as f64
    });
    let distance = |cell: &[i32; 3]| -> f64 {
        cell.iter().zip(mean).map(|(along, mean)| (f64::from(*along) - mean).powi(2)).sum()
    };
    let nearest = members.iter().map(|(_, cell)| cell).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    *nearest.expect("a block has a cell")
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    const SHAPE: ModelShape = ModelShape::new(4, 3);

    #[test]
    fn anchors_begin_with_zero_features_and_offsets_and_the_spacing_as_size() {
        let points: Vec<[f32; 3]> =
            (0..1000).map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32]).collect();
        let rows = initial_rows(&points, VoxelRule::OfSpacing(0.5), SHAPE, 1000).expect("anchors");
        assert_eq!(rows.len(), 1000);
        for anchor in 0..1000 {
            let row = rows.row(anchor);
            let (feature, rest) = row.split_at(4);
            let (scalings, offsets) = rest.split_at(6);
            assert!(feature.iter().chain(offsets).all(|v| *v == 0.0));
            // The three nearest neighbors of any point of the grid are at distance one; cells may move it by a quarter.
            assert!(scalings.iter().all(|log| *log == scalings[0] && log.abs() < 0.5), "{scalings:?}");
        }
        assert!(rows.masks.iter().all(|mask| *mask == 0b111));
    }

    #[test]
    fn a_dense_cloud_is_thinned_evenly_and_keeps_its_extent() {
        let points: Vec<[f32; 3]> =
            (0..8000).map(|i| [(i % 20) as f32, (i / 20 % 20) as f32, (i / 400) as f32]).collect();
        let all = initial_rows(&points, VoxelRule::Fixed(0.25), SHAPE, 10_000).expect("anchors");
        let some = initial_rows(&points, VoxelRule::Fixed(0.25), SHAPE, 2_000).expect("anchors");
        assert_eq!(all.len(), 8000);
        assert!((1_000..=2_000).contains(&some.len()), "{}", some.len());
        let extent = |rows: &AnchorRows| {
            let xs = rows.cells.iter().map(|cell| cell[0]);
            xs.clone().max().expect("cells") - xs.min().expect("cells")
        };
        assert!(extent(&some) * 10 >= extent(&all) * 9);
        let mean_scale = |rows: &AnchorRows| {
            let sum: f32 = (0..rows.len()).map(|anchor| rows.row(anchor)[SHAPE.scaling_column()].exp()).sum();
            sum / rows.len() as f32
        };
        assert!(mean_scale(&some) > 1.2 * mean_scale(&all), "fewer anchors are larger");
    }

    #[test]
    fn a_dense_surface_is_thinned_to_nearly_as_many_anchors_as_there_may_be() {
        // Doubled blocks would leave a quarter of them at worst.
        let points: Vec<[f32; 3]> =
            (0..40_000).map(|i| [(i % 200) as f32, (i / 200) as f32, (i % 200) as f32 * 0.5]).collect();
        for max in [1_000, 3_000, 9_000] {
            let rows = initial_rows(&points, VoxelRule::OfSpacing(0.0625), SHAPE, max).expect("anchors");
            assert!((max * 9 / 10..=max).contains(&rows.len()), "{} of {max}", rows.len());
            assert!(rows.cells.is_sorted());
        }
        let rows = initial_rows(&points, VoxelRule::OfSpacing(0.0625), SHAPE, 0).expect("an anchor");
        assert_eq!(rows.len(), 1);
        let middle = rows.lattice.position(rows.cells[0]);
        assert!((middle[0] - 99.5).abs() < 2.0 && (middle[1] - 99.5).abs() < 2.0, "{middle:?}");
    }

    #[test]
    fn a_lone_point_is_an_anchor_of_finite_size() {
        let rows =
            initial_rows(&[[1.0, 2.0, 3.0]], VoxelRule::OfSpacing(0.5), SHAPE, 1000).expect("an anchor");
        assert_eq!(rows.len(), 1);
        assert!(rows.values.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn points_that_no_scene_can_begin_with_are_named() {
        let begin = |points: &[[f32; 3]]| initial_rows(points, VoxelRule::Fixed(1.0), SHAPE, 9);
        assert_eq!(begin(&[]), Err(InitError::NoPoints));
        assert_eq!(begin(&[[0.0; 3], [0.0, f32::INFINITY, 0.0]]), Err(InitError::NonFinite(1)));
    }

    #[test]
    fn random_points_fill_their_box_and_follow_the_seed() {
        let points = |seed| {
            random_points(&mut rand_pcg::Pcg64::seed_from_u64(seed), 500, [-1.0, 0.0, 5.0], [1.0, 3.0, 6.0])
        };
        assert_eq!(points(1), points(1));
        assert_ne!(points(1), points(2));
        for (axis, (low, high)) in [(-1.0, 1.0), (0.0, 3.0), (5.0, 6.0)].into_iter().enumerate() {
            let along = || points(1).into_iter().map(move |point| point[axis]);
            let (min, max) = (along().fold(f32::MAX, f32::min), along().fold(f32::MIN, f32::max));
            assert!(min >= low && max < high && max - min > 0.9 * (high - low));
        }
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        assert!(random_points(&mut rng, 9, [1e8; 3], [1e8; 3]).iter().all(|point| *point == [1e8; 3]));
    }
}
