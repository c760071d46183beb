//! A few of many, evenly along their order.

/// At most `most` of `all`, evenly along their order, from the first on.
pub fn evenly_spaced<T>(all: &[T], max: usize) -> impl ExactSizeIterator<Item = &T> {
    let count = all.len().min(max);
    (0..count).map(move |place| &all[place * all.len() / count])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_taken_is_spread_from_the_first_on() {
        let taken = |all: usize, max: usize| -> Vec<usize> {
            evenly_spaced(&(0..all).collect::<Vec<_>>(), max).copied().collect()
        };
        assert_eq!(taken(10, 4), [0, 2, 5, 7]);
        assert_eq!(taken(3, 8), [0, 1, 2]);
        assert!(taken(0, 8).is_empty() && taken(5, 0).is_empty());
    }
}
