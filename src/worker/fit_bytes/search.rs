//! The search for the best file within a number of bytes, whatever a file is made of.
//!
//! Two things make a file smaller: coarser steps, which are places on a path from the finest to the coarsest, and fewer
//! Gaussians. At each place there is a most that fits; of these files the best is wanted. Sizes and qualities are those of real
//! files: nothing here believes an estimate.

use std::collections::BTreeMap;

/// Share of what Gaussians may take that may be left unused while places are compared.
const SLACK: f64 = 0.01;
/// The same for the file that is chosen.
pub(super) const FINAL_SLACK: f64 = 0.001;
/// Sizes that are tried to find the most that fits at one place.
const TRIES: usize = 7;
/// The same for the place that is chosen.
pub(super) const FINAL_TRIES: usize = 14;
/// How far the first look around goes.
const FIRST_STRIDE: usize = 4;

/// A file that can be tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Point {
    /// How coarse: a place on the path, 0 the finest.
    pub(super) place: usize,
    /// Gaussians kept, the most worthy first.
    pub(super) kept: usize,
}

/// Makes and judges files. Both answers are functions of the point alone.
pub(super) trait Trials {
    /// Why one could not be made.
    type Fault;

    /// Bytes of the file.
    fn bytes(&mut self, point: Point) -> Result<u64, Self::Fault>;

    /// Quality of the file, larger is better.
    fn quality(&mut self, point: Point) -> Result<f64, Self::Fault>;
}

/// The best point whose file has at most `limit` bytes, of `places` places and `total` Gaussians; none if not even one
/// Gaussian at the coarsest place fits. `guess` names a place to begin at, given how many Gaussians fit at the finest.
pub(super) fn search<T: Trials>(
    trials: &mut T,
    places: usize,
    total: usize,
    limit: u64,
    guess: impl FnOnce(Option<usize>) -> usize,
) -> Result<Option<Point>, T::Fault> {
    let mut search = Search { trials, total, limit, sizes: BTreeMap::new(), seen: BTreeMap::new() };
    let finest = search.most(0, SLACK, TRIES)?;
    let mut best = guess(finest).min(places - 1);
    let mut most = search.judge(best)?;
    // Where Gaussians are hard to do without, files that lack any look much the same: then the way to coarser ones that lack
    // none is not seen from here.
    if let Some(whole) = search.first_whole(places)?
        && search.judge(whole)? > most
    {
        (best, most) = (whole, search.judge(whole)?);
    }
    let mut stride = FIRST_STRIDE;
    while stride > 0 {
        let around = [best + stride, best.wrapping_sub(stride)];
        let mut moved = false;
        for place in around.into_iter().filter(|place| *place < places) {
            let quality = search.judge(place)?;
            // Where nothing fits on either side, coarser is the way to go.
            let is_better = quality > most || (most == f64::NEG_INFINITY && place > best);
            if is_better {
                (best, most, moved) = (place, quality, true);
                break;
            }
        }
        if !moved {
            stride /= 2;
        }
    }
    let Some(kept) = search.most(best, FINAL_SLACK, FINAL_TRIES)? else { return Ok(None) };
    Ok(Some(Point { place: best, kept }))
}

struct Search<'a, T: Trials> {
    trials: &'a mut T,
    total: usize,
    limit: u64,
    sizes: BTreeMap<Point, u64>,
    /// Quality of the largest file that fits at a place, negative infinity where none does.
    seen: BTreeMap<usize, f64>,
}

impl<T: Trials> Search<'_, T> {
    fn judge(&mut self, place: usize) -> Result<f64, T::Fault> {
        if let Some(quality) = self.seen.get(&place) {
            return Ok(*quality);
        }
        let quality = match self.most(place, SLACK, TRIES)? {
            Some(kept) => self.trials.quality(Point { place, kept })?,
            None => f64::NEG_INFINITY,
        };
        self.seen.insert(place, quality);
        Ok(quality)
    }

    fn bytes(&mut self, point: Point) -> Result<u64, T::Fault> {
        if let Some(bytes) = self.sizes.get(&point) {
            return Ok(*bytes);
        }
        let bytes = self.trials.bytes(point)?;
        self.sizes.insert(point, bytes);
        Ok(bytes)
    }

    /// Gaussians of a file at `place` that fits and leaves no more than a share `slack` unused, or the most that were found
    /// to fit within `tries`.
    fn most(&mut self, place: usize, slack: f64, tries: usize) -> Result<Option<usize>, T::Fault> {
        let (total, limit) = (self.total, self.limit);
        most(total, limit, slack, tries, |kept| self.bytes(Point { place, kept }))
    }

    /// The first place at which nothing has to be dropped, if there is one among `places`.
    fn first_whole(&mut self, places: usize) -> Result<Option<usize>, T::Fault> {
        let (mut low, mut high) = (0, places);
        while low < high {
            let middle = usize::midpoint(low, high);
            if self.bytes(Point { place: middle, kept: self.total })? <= self.limit {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        Ok((high < places).then_some(high))
    }
}

/// The number of things, of `total`, whose file fits into `limit` and leaves no more than a share `slack` of what they take
/// unused, or the most that were found to fit within `tries`; none if not even one fits.
pub(super) fn most<F>(
    total: usize,
    limit: u64,
    slack: f64,
    tries: usize,
    mut bytes: impl FnMut(usize) -> Result<u64, F>,
) -> Result<Option<usize>, F> {
    let (mut low, mut high) = (1, total);
    let mut high_bytes = bytes(high)?;
    if high_bytes <= limit {
        return Ok(Some(high));
    }
    let mut low_bytes = bytes(low)?;
    if low_bytes > limit {
        return Ok(None);
    }
    let enough = limit - ((limit - low_bytes) as f64 * slack) as u64;
    for attempt in 0..tries {
        if high - low <= 1 || low_bytes >= enough {
            break;
        }
        // Sizes grow almost in a line with what is kept; every third time by halves, for where they do not.
        let share = (limit - low_bytes) as f64 / (high_bytes - low_bytes).max(1) as f64;
        let share = if attempt % 3 == 2 { 0.5 } else { share * (1.0 - slack / 2.0) };
        let middle = low + ((high - low) as f64 * share) as usize;
        let middle = middle.clamp(low + 1, high - 1);
        let size = bytes(middle)?;
        if size <= limit {
            (low, low_bytes) = (middle, size);
        } else {
            (high, high_bytes) = (middle, size);
        }
    }
    Ok(Some(low))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Files of a known shape: bytes by place and Gaussians, and a quality with one best place for every budget.
    struct Model {
        asked: usize,
        /// A place after which files hardly get smaller.
        best: f64,
    }

    impl Trials for Model {
        type Fault = std::convert::Infallible;

        fn bytes(&mut self, Point { place, kept }: Point) -> Result<u64, Self::Fault> {
            self.asked += 1;
            let each = 20.0 * 0.9_f64.powi(place as i32) + 2.0;
            // Not quite a line, and not quite even.
            let jitter = if kept % 7 == 3 { 5.0 } else { 0.0 };
            Ok((3000.0 + each * (kept as f64).powf(0.98) + jitter) as u64)
        }

        fn quality(&mut self, Point { place, kept }: Point) -> Result<f64, Self::Fault> {
            Ok((kept as f64).ln() - 0.02 * (place as f64 - self.best).powi(2))
        }
    }

    fn by_hand(model: &mut Model, places: usize, total: usize, limit: u64) -> Option<f64> {
        let fits = |model: &mut Model, place| {
            (1..=total)
                .rev()
                .map(|kept| Point { place, kept })
                .find(|p| model.bytes(*p).expect("bytes") <= limit)
        };
        let points: Vec<Point> = (0..places).filter_map(|place| fits(model, place)).collect();
        points.into_iter().map(|point| model.quality(point).expect("quality")).reduce(f64::max)
    }

    #[test]
    fn the_best_file_within_every_budget_is_found_in_few_tries() {
        for best in [0.0, 5.0, 9.0, 18.0] {
            for limit in [3500, 5000, 12_000, 30_000, 60_000] {
                let mut model = Model { asked: 0, best };
                let found = search(&mut model, 20, 3000, limit, |_| 7).expect("no fault").expect("fits");
                assert!(model.bytes(found).expect("bytes") <= limit);
                assert!(model.asked <= 110, "{} files for {limit}", model.asked);
                let quality = model.quality(found).expect("quality");
                let wanted = by_hand(&mut model, 20, 3000, limit).expect("fits");
                assert!(quality > wanted - 0.02, "{limit}, {best}: {found:?} has {quality} of {wanted}");
            }
        }
    }

    /// Files of a scene that suffers from every Gaussian that is left out.
    struct Dense;

    impl Trials for Dense {
        type Fault = std::convert::Infallible;

        fn bytes(&mut self, Point { place, kept }: Point) -> Result<u64, Self::Fault> {
            let steps = [300, 295, 290, 285, 280, 275, 250, 245, 240, 235];
            Ok(1000 * steps[place] * (kept as u64 + 1000) / 2000)
        }

        fn quality(&mut self, Point { place, kept }: Point) -> Result<f64, Self::Fault> {
            Ok(if kept == 1000 { 25.0 } else { 20.0 } - 0.01 * place as f64)
        }
    }

    #[test]
    fn files_that_lack_nothing_are_found_behind_others_that_all_look_bad() {
        let found = search(&mut Dense, 10, 1000, 260_000, |_| 0).expect("no fault");
        assert_eq!(found, Some(Point { place: 6, kept: 1000 }));
    }

    #[test]
    fn a_guess_where_nothing_fits_does_not_hide_what_fits_elsewhere() {
        let mut model = Model { asked: 0, best: 0.0 };
        let least = model.bytes(Point { place: 19, kept: 1 }).expect("bytes");
        let found = search(&mut model, 20, 3000, least, |_| 0).expect("no fault").expect("fits");
        assert!(model.bytes(found).expect("bytes") <= least);
        assert_eq!(search(&mut model, 20, 3000, least - 1, |_| 0).expect("no fault"), None);
    }

    #[test]
    fn nothing_is_dropped_where_everything_fits() {
        let mut model = Model { asked: 0, best: 0.0 };
        let found = search(&mut model, 20, 500, u64::MAX, |_| 0).expect("no fault");
        assert_eq!(found, Some(Point { place: 0, kept: 500 }));
    }
}
