//! The order in which attribute groups become coarser: always the one whose next byte saved costs least in the picture.

/// What a group at one rung of its steps does to file and picture while the other groups stay as they are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rung {
    /// Bytes of the file.
    pub(super) bytes: u64,
    /// Mean squared error of the views.
    pub(super) error: f64,
}

/// A place on the path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    /// The rung of each group.
    pub(super) rungs: [usize; 3],
    /// Squared error a byte that the step to here cost; 0 at the finest.
    pub(super) price: f64,
}

/// The path from every group's first rung to its last. Rungs that no price makes worth while are passed over.
pub(super) fn path(groups: [&[Rung]; 3]) -> Vec<Place> {
    let mut steps: Vec<(f64, usize, usize)> = groups
        .iter()
        .enumerate()
        .flat_map(|(group, rungs)| hull(rungs).into_iter().map(move |(price, rung)| (price, group, rung)))
        .collect();
    // A stable sort: a group's own steps, whose prices rise, stay in their order.
    steps.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut places = vec![Place { rungs: [0; 3], price: 0.0 }];
    let mut rungs = [0; 3];
    for (price, group, rung) in steps {
        rungs[group] = rung;
        places.push(Place { rungs, price });
    }
    places
}

/// The lower convex hull of errors over bytes saved: the rungs on it, each with the price of the way there.
fn hull(rungs: &[Rung]) -> Vec<(f64, usize)> {
    let mut steps = Vec::new();
    let mut from = 0;
    while from + 1 < rungs.len() {
        let price = |to: usize| {
            let saved = rungs[from].bytes as f64 - rungs[to].bytes as f64;
            let lost = (rungs[to].error - rungs[from].error).max(0.0);
            if saved > 0.0 { lost / saved } else { f64::INFINITY }
        };
        let next = (from + 1..rungs.len()).min_by(|a, b| price(*a).total_cmp(&price(*b)).then(b.cmp(a)));
        let Some(next) = next.filter(|next| price(*next).is_finite()) else { break };
        steps.push((price(next), next));
        from = next;
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rungs(values: &[(u64, f64)]) -> Vec<Rung> {
        values.iter().map(|(bytes, error)| Rung { bytes: *bytes, error: *error }).collect()
    }

    #[test]
    fn the_cheapest_byte_goes_first_and_prices_rise() {
        let a = rungs(&[(1000, 0.0), (900, 1.0), (850, 3.0), (840, 9.0)]);
        let b = rungs(&[(1000, 0.0), (990, 0.01), (980, 5.0)]);
        let places = path([&a, &b, &[]]);
        let order: Vec<[usize; 3]> = places.iter().map(|place| place.rungs).collect();
        assert_eq!(order, [[0, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0], [3, 2, 0]]);
        assert!(places.windows(2).all(|pair| pair[0].price <= pair[1].price));
    }

    #[test]
    fn a_rung_above_the_line_between_its_neighbours_is_passed_over() {
        let a = rungs(&[(1000, 0.0), (990, 5.0), (900, 6.0), (905, 7.0)]);
        let order: Vec<[usize; 3]> = path([&a, &[], &[]]).iter().map(|place| place.rungs).collect();
        assert_eq!(order, [[0; 3], [2, 0, 0]], "nor is one that saves nothing taken");
    }

    #[test]
    fn what_costs_nothing_is_taken_at_once() {
        let a = rungs(&[(1000, 1.0), (990, 0.9), (980, 0.95)]);
        let places = path([&a, &a, &a]);
        assert_eq!(places.last().map(|place| place.rungs), Some([2; 3]));
        assert!(places.iter().all(|place| place.price == 0.0));
    }
}
