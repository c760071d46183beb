//! From points to integer cells.

use std::collections::BTreeSet;

use super::neighbors::neighbor_distances;
use crate::domain::Lattice;

/// Largest distance of a cell from the origin, in cells: the file format's position coder takes 21 bits per axis.
pub const MAX_CELL: i32 = (1 << 20) - 1;

/// How the edge of a cell is chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum VoxelRule {
    /// This fraction of the median distance between neighboring points: a length, whatever the unit of the scene.
    OfSpacing(f32),
    /// The median of the mean squared distance to the three nearest points, taken for a length as the published code
    /// does (METHOD.md §2.1).
    Published,
    /// A fixed edge in world units.
    Fixed(f32),
}

/// Cells along a scene's extent where its points are too few or too much alike to have a spacing.
const CELLS_WITHOUT_SPACING: f32 = 256.0;

impl VoxelRule {
    /// The rule's edge for a set of points, fixed; by the `extent` of the scene where the points tell no distance.
    #[must_use]
    pub fn for_points(self, points: &[[f32; 3]], extent: f32) -> Self {
        let edge = self.edge(points);
        Self::Fixed(if edge.is_normal() && edge > 0.0 { edge } else { extent / CELLS_WITHOUT_SPACING })
    }

    fn edge(self, points: &[[f32; 3]]) -> f32 {
        match self {
            VoxelRule::OfSpacing(fraction) => fraction * median_spacing(points),
            VoxelRule::Published => median_squared_distance(points),
            VoxelRule::Fixed(edge) => edge,
        }
    }
}

/// Median of the positive neighbor distances, or 0 if there is none.
#[must_use]
pub fn median_spacing(points: &[[f32; 3]]) -> f32 {
    let mut distances: Vec<f32> =
        neighbor_distances(points).into_iter().filter(|d| *d > 0.0 && d.is_finite()).collect();
    distances.sort_by(f32::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(0.0)
}

/// The n/2-th smallest of the mean squared distances to the three nearest other points.
fn median_squared_distance(points: &[[f32; 3]]) -> f32 {
    let mut squares: Vec<f32> = neighbor_distances(points).into_iter().map(|d| d * d).collect();
    squares.sort_by(f32::total_cmp);
    // The n-th smallest counts from one.
    squares.get((squares.len() / 2).saturating_sub(1)).copied().unwrap_or(0.0)
}

/// Of this many points the outermost one, at either end of an axis, may be left out of a lattice.
const POINTS_A_STRAY: usize = 200;

/// Least edge of a cell.
const MIN_EDGE: f32 = f32::MIN_POSITIVE * 1e6;

/// The lattice for a set of points. The origin is the middle of their box, so that cells stay small, and the box may be
/// [`MAX_CELL`] cells long, since growth may leave it by half of it on each side.
///
/// In a larger box the outermost points of each axis, a half per cent at either end, do not count: reconstructions have
/// some that are far from everything, and those must not coarsen the cells of the others. Only where the rest does not fit
/// either are the cells larger than by the rule.
#[must_use]
pub fn choose_lattice(points: &[[f32; 3]], rule: VoxelRule) -> Lattice {
    let voxel = rule.edge(points).max(MIN_EDGE);
    let fits = |ranges: &[[f32; 2]; 3]| longest(ranges) <= voxel * MAX_CELL as f32;
    let whole = ranges(points, 0);
    let ranges = if fits(&whole) { whole } else { ranges(points, points.len() / POINTS_A_STRAY) };
    Lattice {
        voxel: voxel.max(longest(&ranges) / MAX_CELL as f32),
        origin: ranges.map(|[low, high]| 0.5 * low + 0.5 * high),
    }
}

/// Least and largest coordinate of each axis, but for the `strays` outermost at either end.
fn ranges(points: &[[f32; 3]], strays: usize) -> [[f32; 2]; 3] {
    std::array::from_fn(|axis| {
        let mut along: Vec<f32> = points.iter().map(|point| point[axis]).collect();
        along.sort_unstable_by(f32::total_cmp);
        let inner = &along[strays..along.len() - strays];
        inner.first().zip(inner.last()).map_or([0.0; 2], |(low, high)| [*low, *high])
    })
}

fn longest(ranges: &[[f32; 2]; 3]) -> f32 {
    ranges.iter().map(|[low, high]| high - low).fold(0.0_f32, f32::max)
}

/// The cell that a world position falls into: rounded half to even, clamped to what the file format codes.
#[must_use]
pub fn cell_of(lattice: &Lattice, position: [f32; 3]) -> [i32; 3] {
    rounded(lattice, position).map(|cell| cell.clamp(-MAX_CELL as f32, MAX_CELL as f32) as i32)
}

/// The cell that a world position falls into, if the file format codes it.
#[must_use]
pub fn cell_within(lattice: &Lattice, position: [f32; 3]) -> Option<[i32; 3]> {
    let cell = rounded(lattice, position);
    cell.iter().all(|cell| cell.abs() <= MAX_CELL as f32).then(|| cell.map(|cell| cell as i32))
}

fn rounded(lattice: &Lattice, position: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|axis| ((position[axis] - lattice.origin[axis]) / lattice.voxel).round_ties_even())
}

/// The cell of a lattice `factor` times as coarse that a cell belongs to: rounded half to even.
#[must_use]
pub fn coarse(cell: [i32; 3], factor: i32) -> [i32; 3] {
    cell.map(|c| (f64::from(c) / f64::from(factor)).round_ties_even() as i32)
}

/// The distinct cells of a set of points, ascending (METHOD.md §2.1), without points that the lattice does not reach.
#[must_use]
pub fn voxelise(lattice: &Lattice, points: &[[f32; 3]]) -> Vec<[i32; 3]> {
    let cells: BTreeSet<[i32; 3]> = points.iter().filter_map(|point| cell_within(lattice, *point)).collect();
    cells.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_that_are_not_finite_do_not_end_the_choice_of_a_voxel() {
        let points = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, f32::NAN, 0.0], [0.0, 2.0, 0.0]];
        for rule in [VoxelRule::OfSpacing(0.5), VoxelRule::Published] {
            assert!(matches!(rule.for_points(&points, 1.0), VoxelRule::Fixed(edge) if edge > 0.0));
        }
    }

    #[test]
    fn spacing_is_a_length_and_scales_with_the_scene() {
        let grid: Vec<[f32; 3]> =
            (0..1000).map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32]).collect();
        assert!((median_spacing(&grid) - 1.0).abs() < 1e-6);
        let millimeters: Vec<[f32; 3]> = grid.iter().map(|p| p.map(|v| v * 1000.0)).collect();
        assert!((median_spacing(&millimeters) - 1000.0).abs() < 1e-3);
    }

    #[test]
    fn the_published_rule_is_a_median_of_squared_distances() {
        let spaced = |step: f32| -> Vec<[f32; 3]> { (0..100).map(|i| [i as f32 * step, 0.0, 0.0]).collect() };
        // Inner points of a line have neighbors at one, one and two steps.
        for (step, edge) in [(1.0, 2.0), (0.1, 0.02), (10.0, 200.0)] {
            let VoxelRule::Fixed(found) = VoxelRule::Published.for_points(&spaced(step), 1.0) else {
                panic!("the rule is not fixed")
            };
            assert!((found / edge - 1.0).abs() < 1e-4, "{found} for steps of {step}");
        }
    }

    #[test]
    fn points_without_distances_make_cells_of_the_scenes_size() {
        for points in [vec![[1.0, 2.0, 3.0]], vec![[0.5; 3]; 7]] {
            for rule in [VoxelRule::OfSpacing(1.0 / 16.0), VoxelRule::Published] {
                let rule = rule.for_points(&points, 12.8);
                let lattice = choose_lattice(&points, rule);
                assert!((lattice.voxel - 0.05).abs() < 1e-6, "{lattice:?}");
            }
        }
        assert_eq!(VoxelRule::Fixed(0.3).for_points(&[[0.0; 3]], 1.0), VoxelRule::Fixed(0.3));
    }

    #[test]
    fn cells_are_distinct_and_near_their_points() {
        let points = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [5.0, 5.0, 5.0], [5.01, 5.0, 5.0]];
        let lattice = choose_lattice(&points, VoxelRule::Fixed(0.05));
        let cells = voxelise(&lattice, &points);
        assert_eq!(cells.len(), 3);
        for point in points {
            let near = lattice.position(cell_of(&lattice, point));
            assert!((0..3).all(|axis| (near[axis] - point[axis]).abs() <= 0.0251));
        }
    }

    #[test]
    fn identical_points_have_no_spacing_but_their_neighbors_do() {
        let mut points = vec![[1.0, 1.0, 1.0]; 200];
        points.extend((0..400).map(|i| [i as f32, 0.0, 0.0]));
        let spacing = median_spacing(&points);
        assert!((spacing - 1.4).abs() < 0.2, "{spacing}");
    }

    #[test]
    fn stray_points_neither_coarsen_the_cells_nor_become_anchors() {
        let grid: Vec<[f32; 3]> = (0..1000)
            .map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32].map(|v| 0.01 * v))
            .collect();
        let rule = VoxelRule::OfSpacing(1.0 / 16.0);
        let alone = choose_lattice(&grid, rule);
        for stray in [[1e6, 0.0, 0.0], [0.0, -1e9, 1e9], [3e38, -3e38, 0.0]] {
            let points = [&grid[..], &[stray]].concat();
            let lattice = choose_lattice(&points, rule);
            assert!((lattice.voxel / alone.voxel - 1.0).abs() < 0.01, "{} for {stray:?}", lattice.voxel);
            assert_eq!(voxelise(&lattice, &points).len(), grid.len());
        }
        // What is far but within reach stays.
        let points = [&grid[..], &[[300.0, 0.0, 0.0]]].concat();
        assert_eq!(voxelise(&choose_lattice(&points, rule), &points).len(), 1001);
    }

    #[test]
    fn cells_are_larger_than_asked_for_only_where_most_points_do_not_fit_otherwise() {
        let line: Vec<[f32; 3]> = (0..1000).map(|i| [i as f32, 0.0, 0.0]).collect();
        let lattice = choose_lattice(&line, VoxelRule::Fixed(1e-6));
        assert!((lattice.voxel * MAX_CELL as f32 - 989.0).abs() < 0.1, "{lattice:?}");
        assert!(voxelise(&lattice, &line).len() > 990);
    }

    #[test]
    fn degenerate_clouds_still_give_a_lattice() {
        for points in [vec![[1.0, 2.0, 3.0]], vec![[1.0, 2.0, 3.0]; 5], vec![[0.0; 3], [1e30, 0.0, 0.0]]] {
            let lattice = choose_lattice(&points, VoxelRule::OfSpacing(0.25));
            assert!(lattice.voxel > 0.0 && lattice.voxel.is_finite(), "{points:?}");
            assert!(!voxelise(&lattice, &points).is_empty());
        }
    }
}
