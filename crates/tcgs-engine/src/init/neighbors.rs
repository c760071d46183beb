//! Distances to the nearest points, exact, in a time that no arrangement of the points makes quadratic.
//!
//! The search is a hierarchy of boxes. A box is divided across its longest side by the number of its points, not at a coordinate. So
//! points that coincide, or share coordinates, are divided like all others. A k-d tree that divides at coordinates, as that of
//! kiddo, takes time quadratic in such points: minutes for 200 000 copies of one. Tests compare with it on others.

use rayon::prelude::*;

/// Points in a box of the lowest level.
const LEAF: usize = 8;

/// Distances that are summed: those to a point itself and to its three nearest others.
const NEAREST: usize = 4;

/// Points from which both halves of a box are divided in parallel.
const PARALLEL: usize = 1 << 14;

type Point = [f32; 3];

/// Root of the mean squared distance to the three nearest other points, for each point, in the unit of the points. Zero for a point that
/// is not finite or has no others.
#[must_use]
pub(super) fn neighbor_distances(points: &[Point]) -> Vec<f32> {
    let is_finite = |(point, _): &(Point, u32)| point.iter().all(|value| value.is_finite());
    let mut indexed: Vec<(Point, u32)> = points.iter().copied().zip(0..).filter(is_finite).collect();
    divide(&mut indexed);
    let sorted: Vec<Point> = indexed.iter().map(|(point, _)| *point).collect();
    let hierarchy = Hierarchy::new(&sorted);
    let found: Vec<f32> = (0..sorted.len())
        .into_par_iter()
        .with_min_len(256)
        .map(|place| hierarchy.nearest(place).root_of_mean())
        .collect();
    let mut distances = vec![0.0; points.len()];
    for ((_, index), distance) in indexed.iter().zip(found) {
        distances[*index as usize] = distance;
    }
    distances
}

/// Orders points so that every aligned run of `LEAF` times a power of two of them fills a box.
fn divide(points: &mut [(Point, u32)]) {
    if points.len() <= LEAF {
        return;
    }
    // As many as the largest aligned run that leaves something for the other half.
    let half = LEAF * points.len().div_ceil(LEAF).next_power_of_two() / 2;
    let around = points.iter().fold(Bounds::EMPTY, |all, (point, _)| all.join(Bounds::of(*point)));
    let axis = around.longest_axis();
    points.select_nth_unstable_by(half, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    let is_large = points.len() > PARALLEL;
    let (low, high) = points.split_at_mut(half);
    if is_large {
        rayon::join(|| divide(low), || divide(high));
    } else {
        divide(low);
        divide(high);
    }
}

/// The least box around some points.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: Point,
    high: Point,
}

impl Bounds {
    const EMPTY: Self = Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3] };

    fn of(point: Point) -> Self {
        Self { low: point, high: point }
    }

    fn join(self, other: Self) -> Self {
        Self {
            low: std::array::from_fn(|axis| self.low[axis].min(other.low[axis])),
            high: std::array::from_fn(|axis| self.high[axis].max(other.high[axis])),
        }
    }

    fn longest_axis(&self) -> usize {
        let side = |axis: &usize| self.high[*axis] - self.low[*axis];
        (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0)
    }

    /// Squared distance to the nearest place in the box. As rounding is monotonic, no point of the box has a smaller one.
    fn squared_distance(&self, point: Point) -> f32 {
        squared_distance(
            point,
            std::array::from_fn(|axis| point[axis].clamp(self.low[axis], self.high[axis])),
        )
    }
}

fn squared_distance(a: Point, b: Point) -> f32 {
    let [x, y, z] = std::array::from_fn(|axis| a[axis] - b[axis]);
    x * x + y * y + z * z
}

/// Boxes around pairs of boxes, around runs of `LEAF` points.
struct Hierarchy<'a> {
    points: &'a [Point],
    /// From the leaves up to one box.
    levels: Vec<Vec<Bounds>>,
}

impl<'a> Hierarchy<'a> {
    /// Of points in the order of [`divide`].
    fn new(points: &'a [Point]) -> Self {
        let around =
            |run: &[Point]| run.iter().fold(Bounds::EMPTY, |all, point| all.join(Bounds::of(*point)));
        let pair = |run: &[Bounds]| run.iter().fold(Bounds::EMPTY, |all, bounds| all.join(*bounds));
        let mut levels: Vec<Vec<Bounds>> = vec![points.chunks(LEAF).map(around).collect()];
        while let Some(top) = levels.last().filter(|level| level.len() > 1) {
            levels.push(top.chunks(2).map(pair).collect());
        }
        Self { points, levels }
    }

    /// The nearest points of the one at `place`, itself included.
    fn nearest(&self, place: usize) -> Nearest {
        let mut nearest = Nearest { point: self.points[place], squares: [f32::INFINITY; NEAREST] };
        // The own leaf first: its distances leave out most of the rest.
        let own = place / LEAF;
        self.scan(own, &mut nearest);
        self.visit(self.levels.len() - 1, 0, own, &mut nearest);
        nearest
    }

    /// Offers what box `index` of `level` holds, without the leaf `own`.
    fn visit(&self, level: usize, index: usize, own: usize, nearest: &mut Nearest) {
        if level == 0 {
            if index != own {
                self.scan(index, nearest);
            }
            return;
        }
        let below = &self.levels[level - 1];
        let distance =
            |child: usize| below.get(child).map(|bounds| (bounds.squared_distance(nearest.point), child));
        let mut children = [distance(2 * index), distance(2 * index + 1)];
        // The nearer one first.
        if let [Some((first, _)), Some((second, _))] = children
            && second < first
        {
            children.swap(0, 1);
        }
        for (square, child) in children.into_iter().flatten() {
            if square < nearest.squares[NEAREST - 1] {
                self.visit(level - 1, child, own, nearest);
            }
        }
    }

    fn scan(&self, leaf: usize, nearest: &mut Nearest) {
        let start = leaf * LEAF;
        for point in &self.points[start..(start + LEAF).min(self.points.len())] {
            nearest.offer(squared_distance(nearest.point, *point));
        }
    }
}

/// The nearest points that were seen so far.
struct Nearest {
    point: Point,
    /// Ascending; infinite where there are fewer.
    squares: [f32; NEAREST],
}

impl Nearest {
    fn offer(&mut self, square: f32) {
        let place = self.squares.partition_point(|other| *other <= square);
        if place < NEAREST {
            self.squares[place..].rotate_right(1);
            self.squares[place] = square;
        }
    }

    fn root_of_mean(&self) -> f32 {
        let found = self.squares.partition_point(|square| square.is_finite());
        let sum: f32 = self.squares[..found].iter().sum();
        // The point itself is among them, at distance zero.
        (sum / found.saturating_sub(1).max(1) as f32).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZero;

    use kiddo::{ImmutableKdTree, SquaredEuclidean};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    /// Compares every point with every other.
    fn by_all_pairs(points: &[Point]) -> Vec<f32> {
        let of = |point: &Point| {
            let mut nearest = Nearest { point: *point, squares: [f32::INFINITY; NEAREST] };
            points.iter().for_each(|other| nearest.offer(squared_distance(*point, *other)));
            nearest.root_of_mean()
        };
        points.iter().map(of).collect()
    }

    fn random(count: usize, mut of: impl FnMut(&mut Pcg64, usize) -> Point) -> Vec<Point> {
        let mut rng = Pcg64::seed_from_u64(5);
        (0..count).map(|index| of(&mut rng, index)).collect()
    }

    #[test]
    fn distances_are_those_of_all_pairs_to_the_last_bit() {
        let uniform = |rng: &mut Pcg64, _| [0; 3].map(|_| rng.random_range(-1.0..1.0_f32));
        for count in [0, 1, 2, 3, 4, 7, 8, 9, 16, 17, 63, 65, 1000, 2049] {
            let points = random(count, uniform);
            assert_eq!(neighbor_distances(&points), by_all_pairs(&points), "{count} points");
        }
        // On a coarse grid, so that many coincide and have equal distances; clusters with strays far away.
        let grid = random(2000, |rng, _| [0; 3].map(|_| rng.random_range(0..9_i32) as f32));
        let strays = random(2000, |rng, index| {
            let size = if index % 50 == 0 { 1e9 } else { 10.0_f32.powi(index as i32 % 7 - 5) };
            [0; 3].map(|_| size * rng.random_range(-1.0..1.0))
        });
        for points in [grid, strays] {
            assert_eq!(neighbor_distances(&points), by_all_pairs(&points));
        }
    }

    #[test]
    fn a_k_d_tree_finds_the_same() {
        let points = random(50_000, |rng, _| [0; 3].map(|_| rng.random_range(-1.0..1.0_f32)));
        let tree = ImmutableKdTree::<f32, 3>::new_from_slice(&points).expect("a tree");
        let wanted = NonZero::new(NEAREST).expect("some");
        let by_tree = |point: &Point| {
            let near = tree.query(point).nearest_n::<SquaredEuclidean<f32>>(wanted).execute();
            let sum: f32 = near.iter().map(|neighbor| neighbor.distance).sum();
            (sum / (NEAREST - 1) as f32).sqrt()
        };
        assert_eq!(neighbor_distances(&points), points.iter().map(by_tree).collect::<Vec<_>>());
    }

    #[test]
    fn points_that_are_not_finite_have_no_distance_and_are_nobodys_neighbor() {
        let points = [[0.0; 3], [f32::NAN, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, f32::INFINITY, 0.0]];
        assert_eq!(neighbor_distances(&points), [5.0, 0.0, 5.0, 0.0]);
        assert_eq!(neighbor_distances(&[[0.0; 3], [3e38; 3]]), [0.0; 2], "farther than a number tells");
    }

    // Seconds at most; a search that is quadratic in points that coincide or share coordinates takes minutes.

    #[test]
    fn copies_of_one_point_take_no_quadratic_time() {
        let mut points = vec![[0.25, -3.0, 7.5]; 200_000];
        assert!(neighbor_distances(&points).iter().all(|distance| *distance == 0.0));
        points.push([0.25, -3.0, 8.5]);
        assert_eq!(neighbor_distances(&points).last(), Some(&1.0));
    }

    #[test]
    fn points_of_a_line_take_no_quadratic_time() {
        for axis in 0..3 {
            let mut points = vec![[1.0; 3]; 200_000];
            points.iter_mut().enumerate().for_each(|(place, point)| point[axis] = place as f32);
            let distances = neighbor_distances(&points);
            assert!(distances[1..199_999].iter().all(|distance| *distance == 2.0_f32.sqrt()));
        }
    }
}
