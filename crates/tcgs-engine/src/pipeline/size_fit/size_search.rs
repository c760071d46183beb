//! The search for the file of the best quality within a number of bytes, independent of how files are made.
//!
//! Two things make a file smaller: coarser steps (points on a path from the finest to the coarsest) and fewer Gaussians. At each
//! point there is a largest number of Gaussians that fits; the search returns the best of these files. All sizes and qualities are
//! measured on real files, never estimated.

use std::collections::BTreeMap;

/// Share of the bytes for Gaussians that may stay unused while points are compared.
const SLACK: f64 = 0.01;
/// The same for the chosen file.
pub(super) const FINAL_SLACK: f64 = 0.001;
/// Files tried to find the largest that fits at one point.
const TRIES: usize = 7;
/// The same for the chosen point.
pub(super) const FINAL_TRIES: usize = 14;
/// Distance of the first neighbors, in points of the path.
const FIRST_STRIDE: usize = 4;

/// A file that can be tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Candidate {
    /// Index on the coarsening path, 0 the finest.
    pub(super) point: usize,
    /// Gaussians kept, the most important first.
    pub(super) kept: usize,
}

/// Makes files and measures them. Both results are functions of the candidate alone.
pub(super) trait Trials {
    /// Why a file could not be made.
    type Error;

    /// Bytes of the file.
    fn bytes(&mut self, candidate: Candidate) -> Result<u64, Self::Error>;

    /// Quality of the file; larger is better.
    fn quality(&mut self, candidate: Candidate) -> Result<f64, Self::Error>;
}

/// The best candidate whose file has at most `limit` bytes, of `points` points and `total` Gaussians; `None` if not even one Gaussian
/// at the coarsest point fits. `guess` returns the point to begin at, given how many Gaussians fit at the finest.
pub(super) fn search<T: Trials>(
    trials: &mut T,
    points: usize,
    total: usize,
    limit: u64,
    guess: impl FnOnce(Option<usize>) -> usize,
) -> Result<Option<Candidate>, T::Error> {
    let mut search = Search { trials, total, limit, sizes: BTreeMap::new(), qualities: BTreeMap::new() };
    let finest = search.largest_fitting(0, SLACK, TRIES)?;
    let mut best = guess(finest).min(points - 1);
    let mut best_quality = search.quality(best)?;
    // In scenes that need all their Gaussians, files without some of them are about equally bad, so the climb below would not find
    // coarser files that have all.
    if let Some(complete) = search.first_complete(points)?
        && search.quality(complete)? > best_quality
    {
        (best, best_quality) = (complete, search.quality(complete)?);
    }
    let mut stride = FIRST_STRIDE;
    while stride > 0 {
        let neighbors = [best + stride, best.wrapping_sub(stride)];
        let mut moved = false;
        for point in neighbors.into_iter().filter(|point| *point < points) {
            let quality = search.quality(point)?;
            // If nothing fits at either, go on to the coarser.
            let is_better = quality > best_quality || (best_quality == f64::NEG_INFINITY && point > best);
            if is_better {
                (best, best_quality, moved) = (point, quality, true);
                break;
            }
        }
        if !moved {
            stride /= 2;
        }
    }
    let Some(kept) = search.largest_fitting(best, FINAL_SLACK, FINAL_TRIES)? else { return Ok(None) };
    Ok(Some(Candidate { point: best, kept }))
}

struct Search<'a, T: Trials> {
    trials: &'a mut T,
    total: usize,
    limit: u64,
    sizes: BTreeMap<Candidate, u64>,
    /// Quality of the largest file that fits at a point; negative infinity if none does.
    qualities: BTreeMap<usize, f64>,
}

impl<T: Trials> Search<'_, T> {
    fn quality(&mut self, point: usize) -> Result<f64, T::Error> {
        if let Some(quality) = self.qualities.get(&point) {
            return Ok(*quality);
        }
        let quality = match self.largest_fitting(point, SLACK, TRIES)? {
            Some(kept) => self.trials.quality(Candidate { point, kept })?,
            None => f64::NEG_INFINITY,
        };
        self.qualities.insert(point, quality);
        Ok(quality)
    }

    fn bytes(&mut self, candidate: Candidate) -> Result<u64, T::Error> {
        if let Some(bytes) = self.sizes.get(&candidate) {
            return Ok(*bytes);
        }
        let bytes = self.trials.bytes(candidate)?;
        self.sizes.insert(candidate, bytes);
        Ok(bytes)
    }

    /// As [`largest_fitting`], of the Gaussians at `point`.
    fn largest_fitting(&mut self, point: usize, slack: f64, tries: usize) -> Result<Option<usize>, T::Error> {
        let (total, limit) = (self.total, self.limit);
        largest_fitting(total, limit, slack, tries, |kept| self.bytes(Candidate { point, kept }))
    }

    /// The first of `points` points at which all Gaussians fit, if there is one.
    fn first_complete(&mut self, points: usize) -> Result<Option<usize>, T::Error> {
        let (mut low, mut high) = (0, points);
        while low < high {
            let middle = usize::midpoint(low, high);
            if self.bytes(Candidate { point: middle, kept: self.total })? <= self.limit {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        Ok((high < points).then_some(high))
    }
}

/// The largest number of items, of `total`, whose file has at most `limit` bytes, to within a share `slack` of the items' bytes or
/// after `tries` files; `None` if not even one item fits.
pub(super) fn largest_fitting<F>(
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
        // Sizes grow almost linearly with the items kept; every third try bisects, in case they do not.
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

    /// Files with known bytes by point and Gaussians, and a quality with one best point for every limit.
    struct Model {
        files: usize,
        /// A point after which files hardly get smaller.
        best: f64,
    }

    impl Trials for Model {
        type Error = std::convert::Infallible;

        fn bytes(&mut self, Candidate { point, kept }: Candidate) -> Result<u64, Self::Error> {
            self.files += 1;
            let each = 20.0 * 0.9_f64.powi(point as i32) + 2.0;
            // Not quite linear, and not quite monotonic.
            let jitter = if kept % 7 == 3 { 5.0 } else { 0.0 };
            Ok((3000.0 + each * (kept as f64).powf(0.98) + jitter) as u64)
        }

        fn quality(&mut self, Candidate { point, kept }: Candidate) -> Result<f64, Self::Error> {
            Ok((kept as f64).ln() - 0.02 * (point as f64 - self.best).powi(2))
        }
    }

    fn exhaustive(model: &mut Model, points: usize, total: usize, limit: u64) -> Option<f64> {
        let fits = |model: &mut Model, point| {
            (1..=total)
                .rev()
                .map(|kept| Candidate { point, kept })
                .find(|p| model.bytes(*p).expect("bytes") <= limit)
        };
        let points: Vec<Candidate> = (0..points).filter_map(|point| fits(model, point)).collect();
        points.into_iter().map(|point| model.quality(point).expect("quality")).reduce(f64::max)
    }

    #[test]
    fn the_best_file_within_every_limit_is_found_in_few_tries() {
        for best in [0.0, 5.0, 9.0, 18.0] {
            for limit in [3500, 5000, 12_000, 30_000, 60_000] {
                let mut model = Model { files: 0, best };
                let found = search(&mut model, 20, 3000, limit, |_| 7).expect("no fault").expect("fits");
                assert!(model.bytes(found).expect("bytes") <= limit);
                assert!(model.files <= 110, "{} files for {limit}", model.files);
                let quality = model.quality(found).expect("quality");
                let wanted = exhaustive(&mut model, 20, 3000, limit).expect("fits");
                assert!(quality > wanted - 0.02, "{limit}, {best}: {found:?} has {quality} of {wanted}");
            }
        }
    }

    /// Files of a scene that loses much with every Gaussian dropped.
    struct Dense;

    impl Trials for Dense {
        type Error = std::convert::Infallible;

        fn bytes(&mut self, Candidate { point, kept }: Candidate) -> Result<u64, Self::Error> {
            let steps = [300, 295, 290, 285, 280, 275, 250, 245, 240, 235];
            Ok(1000 * steps[point] * (kept as u64 + 1000) / 2000)
        }

        fn quality(&mut self, Candidate { point, kept }: Candidate) -> Result<f64, Self::Error> {
            Ok(if kept == 1000 { 25.0 } else { 20.0 } - 0.01 * point as f64)
        }
    }

    #[test]
    fn complete_files_are_found_beyond_incomplete_ones_that_are_all_bad() {
        let found = search(&mut Dense, 10, 1000, 260_000, |_| 0).expect("no fault");
        assert_eq!(found, Some(Candidate { point: 6, kept: 1000 }));
    }

    #[test]
    fn a_guess_where_nothing_fits_does_not_hide_files_that_fit_elsewhere() {
        let mut model = Model { files: 0, best: 0.0 };
        let min = model.bytes(Candidate { point: 19, kept: 1 }).expect("bytes");
        let found = search(&mut model, 20, 3000, min, |_| 0).expect("no fault").expect("fits");
        assert!(model.bytes(found).expect("bytes") <= min);
        assert_eq!(search(&mut model, 20, 3000, min - 1, |_| 0).expect("no fault"), None);
    }

    #[test]
    fn nothing_is_dropped_if_everything_fits() {
        let mut model = Model { files: 0, best: 0.0 };
        let found = search(&mut model, 20, 500, u64::MAX, |_| 0).expect("no fault");
        assert_eq!(found, Some(Candidate { point: 0, kept: 500 }));
    }
}
