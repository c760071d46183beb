//! The order in which attribute groups become coarser: always the one whose next byte saved costs the least squared error.

/// Size and error of the file with one group at this level of its quantization steps and the other groups at their finest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct QuantLevel {
    /// Bytes of the file.
    pub(super) bytes: u64,
    /// Mean squared error of the views.
    pub(super) error: f64,
}

/// A point on the path: one level for each group.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OperatingPoint {
    /// The level of each group.
    pub(super) levels: [usize; 3],
    /// Squared error per byte saved since the point before; 0 at the finest.
    pub(super) price: f64,
}

/// The path from every group's finest level to its coarsest. Skips levels above the lower convex hull.
pub(super) fn coarsening_path(groups: [&[QuantLevel]; 3]) -> Vec<OperatingPoint> {
    let mut steps: Vec<(f64, usize, usize)> = groups
        .iter()
        .enumerate()
        .flat_map(|(group, levels)| hull(levels).into_iter().map(move |(price, level)| (price, group, level)))
        .collect();
    // A stable sort: a group's own steps, whose prices rise, keep their order.
    steps.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut points = vec![OperatingPoint { levels: [0; 3], price: 0.0 }];
    let mut levels = [0; 3];
    for (price, group, level) in steps {
        levels[group] = level;
        points.push(OperatingPoint { levels, price });
    }
    points
}

/// The lower convex hull of errors over bytes saved: its levels, each with the price of the step to it.
fn hull(levels: &[QuantLevel]) -> Vec<(f64, usize)> {
    let mut steps = Vec::new();
    let mut from = 0;
    while from + 1 < levels.len() {
        let price = |to: usize| {
            let saved = levels[from].bytes as f64 - levels[to].bytes as f64;
            let lost = (levels[to].error - levels[from].error).max(0.0);
            if saved > 0.0 { lost / saved } else { f64::INFINITY }
        };
        let next = (from + 1..levels.len()).min_by(|a, b| price(*a).total_cmp(&price(*b)).then(b.cmp(a)));
        let Some(next) = next.filter(|next| price(*next).is_finite()) else { break };
        steps.push((price(next), next));
        from = next;
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    fn levels(values: &[(u64, f64)]) -> Vec<QuantLevel> {
        values.iter().map(|(bytes, error)| QuantLevel { bytes: *bytes, error: *error }).collect()
    }

    #[test]
    fn the_cheapest_byte_goes_first_and_prices_rise() {
        let a = levels(&[(1000, 0.0), (900, 1.0), (850, 3.0), (840, 9.0)]);
        let b = levels(&[(1000, 0.0), (990, 0.01), (980, 5.0)]);
        let points = coarsening_path([&a, &b, &[]]);
        let order: Vec<[usize; 3]> = points.iter().map(|point| point.levels).collect();
        assert_eq!(order, [[0, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0], [3, 2, 0]]);
        assert!(points.windows(2).all(|pair| pair[0].price <= pair[1].price));
    }

    #[test]
    fn a_level_above_the_line_between_its_neighbors_is_skipped() {
        let a = levels(&[(1000, 0.0), (990, 5.0), (900, 6.0), (905, 7.0)]);
        let order: Vec<[usize; 3]> =
            coarsening_path([&a, &[], &[]]).iter().map(|point| point.levels).collect();
        assert_eq!(order, [[0; 3], [2, 0, 0]], "nor is a level that saves nothing");
    }

    #[test]
    fn levels_that_cost_nothing_come_first() {
        let a = levels(&[(1000, 1.0), (990, 0.9), (980, 0.95)]);
        let points = coarsening_path([&a, &a, &a]);
        assert_eq!(points.last().map(|point| point.levels), Some([2; 3]));
        assert!(points.iter().all(|point| point.price == 0.0));
    }
}
