//! Codebooks of 256 values: one byte stands for the nearest of them.

/// Values in a codebook.
const SIZE: usize = 256;

/// Bins of the histogram that places the first values.
const BINS: usize = 4096;

/// Rounds of Lloyd's algorithm.
const ROUNDS: usize = 12;

/// Ascending values.
pub(super) struct Codebook(Vec<f32>);

impl Codebook {
    /// Values with a small mean squared distance from the given ones: first by a third of their density's logarithm, which is best for
    /// fine steps (Panter and Dite), then by Lloyd's algorithm.
    pub(super) fn of(values: impl Iterator<Item = f32>) -> Self {
        let mut sorted: Vec<f32> = values.collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let (Some(first), Some(last)) = (sorted.first().copied(), sorted.last().copied()) else {
            return Self(vec![0.0; SIZE]);
        };
        let mut book = initial(&sorted, first, last);
        let mut sums = Vec::with_capacity(sorted.len() + 1);
        sums.push(0.0_f64);
        for value in &sorted {
            sums.push(sums.last().copied().unwrap_or_default() + f64::from(*value));
        }
        for _ in 0..ROUNDS {
            let mut start = 0;
            for code in 0..SIZE {
                let end = match book.get(code + 1) {
                    Some(next) => sorted.partition_point(|value| *value <= f32::midpoint(book[code], *next)),
                    None => sorted.len(),
                };
                let end = end.max(start);
                if end > start {
                    book[code] = ((sums[end] - sums[start]) / (end - start) as f64) as f32;
                }
                start = end;
            }
            book.sort_unstable_by(f32::total_cmp);
        }
        Self(book)
    }

    pub(super) fn nearest(&self, value: f32) -> u8 {
        let after = self.0.partition_point(|code| *code < value).min(SIZE - 1);
        let before = after.saturating_sub(1);
        let nearest =
            if (value - self.0[before]).abs() <= (self.0[after] - value).abs() { before } else { after };
        nearest as u8
    }

    pub(super) fn value(&self, code: u8) -> f32 {
        self.0[usize::from(code)]
    }

    pub(super) fn values(&self) -> &[f32] {
        &self.0
    }
}

fn initial(sorted: &[f32], first: f32, last: f32) -> Vec<f32> {
    let (low, width) = (f64::from(first), f64::from(last) - f64::from(first));
    let mut weights = vec![0.0_f64; BINS];
    for value in sorted {
        let bin = (f64::from(*value) - low) / width.max(f64::MIN_POSITIVE) * BINS as f64;
        weights[(bin as usize).min(BINS - 1)] += 1.0;
    }
    weights.iter_mut().for_each(|weight| *weight = weight.cbrt());
    let total: f64 = weights.iter().sum();
    let (mut book, mut passed) = (Vec::with_capacity(SIZE), 0.0);
    for (bin, weight) in weights.into_iter().enumerate() {
        passed += weight;
        while book.len() < SIZE && passed >= total * (book.len() as f64 + 0.5) / SIZE as f64 {
            book.push((low + width * (bin as f64 + 0.5) / BINS as f64) as f32);
        }
    }
    book.resize(SIZE, last);
    book
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_values_are_kept_and_many_are_near() {
        let book = Codebook::of([-2.0, 0.25, 7.0].into_iter().cycle().take(99));
        for value in [-2.0, 0.25, 7.0] {
            assert_eq!(book.value(book.nearest(value)), value);
        }
        let many: Vec<f32> = (0..10_000).map(|i| (i as f32 / 5000.0 - 1.0).powi(3)).collect();
        let book = Codebook::of(many.iter().copied());
        assert!(book.values().is_sorted());
        let error = |value: &f32| f64::from(value - book.value(book.nearest(*value))).powi(2);
        let deviation = (many.iter().map(error).sum::<f64>() / many.len() as f64).sqrt();
        assert!(deviation < 0.002, "{deviation}");
        let empty = Codebook::of(std::iter::empty());
        assert_eq!(empty.value(empty.nearest(1.0)), 0.0);
    }
}
