//! Fits the distribution under which a set of symbols takes the fewest bits.

use super::{
    bytes::{Reader, Writer},
    error::Result,
    gaussian::Gaussian,
    gaussian_constants::SCALES,
    symbols::{Distribution, MAX_SYMBOL},
};

/// Stored in place of a scale's index where all symbols are equal.
const CONSTANT: u8 = SCALES as u8;

/// Scales tried first; the neighborhood of the best is searched afterwards.
const COARSE: usize = 4;

/// The distribution for `symbols`; without any symbol, the constant zero.
pub(super) fn fit(symbols: Vec<i32>) -> Distribution {
    let (Some(min), Some(max)) = (symbols.iter().min().copied(), symbols.iter().max().copied()) else {
        return Distribution::Constant(0);
    };
    if min == max {
        return Distribution::Constant(min);
    }
    let count = symbols.len();
    let sum: i64 = symbols.iter().map(|symbol| i64::from(*symbol)).sum();
    let mean16 = (16 * sum).div_euclid(count as i64) as i32;
    let histogram = histogram(symbols, min, max);
    let median16 = 16 * median(&histogram, count);

    let mut search = Search { histogram: &histogram, best: (f64::INFINITY, Gaussian { mean16, scale: 0 }) };
    for mean16 in [mean16, median16] {
        (0..SCALES).step_by(COARSE).for_each(|scale| search.consider(mean16, scale as i32));
    }
    search.refine_scale();
    let mut stride = 1;
    while stride > 0 {
        let Gaussian { mean16, scale } = search.best.1;
        let before = search.best.0;
        search.consider(mean16 - stride, scale.into());
        search.consider(mean16 + stride, scale.into());
        // Twice as far after a success, half as far after a failure.
        stride = if search.best.0 < before { stride * 2 } else { stride / 2 };
    }
    search.refine_scale();
    Distribution::Gaussian(search.best.1)
}

struct Search<'a> {
    histogram: &'a [(i32, f64)],
    best: (f64, Gaussian),
}

impl Search<'_> {
    fn consider(&mut self, mean16: i32, scale: i32) {
        if !(0..SCALES as i32).contains(&scale) || mean16.abs() > 16 * MAX_SYMBOL {
            return;
        }
        let gaussian = Gaussian { mean16, scale: scale as u8 };
        let distribution = Distribution::Gaussian(gaussian);
        let bits = self.histogram.iter().map(|(symbol, count)| count * distribution.cost(*symbol)).sum();
        if bits < self.best.0 {
            self.best = (bits, gaussian);
        }
    }

    fn refine_scale(&mut self) {
        let Gaussian { mean16, scale } = self.best.1;
        let reach = COARSE as i32 - 1;
        (-reach..=reach).for_each(|step| self.consider(mean16, i32::from(scale) + step));
    }
}

/// Widest range of symbols that are counted; others are sorted.
const MAX_COUNTED_RANGE: u32 = 1 << 16;

/// Each symbol that occurs, ascending, with how often it does.
fn histogram(mut symbols: Vec<i32>, min: i32, max: i32) -> Vec<(i32, f64)> {
    let range = max.abs_diff(min);
    if range >= MAX_COUNTED_RANGE {
        symbols.sort_unstable();
        return symbols.chunk_by(|a, b| a == b).map(|run| (run[0], run.len() as f64)).collect();
    }
    let mut counts = vec![0_u32; range as usize + 1];
    symbols.iter().for_each(|symbol| counts[symbol.abs_diff(min) as usize] += 1);
    let occurring = (min..).zip(counts).filter(|(_, count)| *count > 0);
    occurring.map(|(symbol, count)| (symbol, f64::from(count))).collect()
}

/// The symbol in the middle of `count`.
fn median(histogram: &[(i32, f64)], count: usize) -> i32 {
    let mut before = 0.0;
    let middle = histogram.iter().find(|(_, count_here)| {
        before += count_here;
        before > (count / 2) as f64
    });
    middle.map_or(0, |(symbol, _)| *symbol)
}

/// Stores a distribution: zigzag varint of the mean in sixteenths, then the scale's index (64: constant).
pub(super) fn write(distribution: Distribution, writer: &mut Writer) {
    match distribution {
        Distribution::Constant(value) => {
            writer.signed(i64::from(value));
            writer.u8(CONSTANT);
        }
        Distribution::Gaussian(Gaussian { mean16, scale }) => {
            writer.signed(i64::from(mean16));
            writer.u8(scale);
        }
    }
}

/// Reads what [`write`] stored.
pub(super) fn read(reader: &mut Reader<'_>) -> Result<Distribution> {
    let mean = reader.signed("a mean")?;
    let scale = reader.u8("a scale")?;
    let limit = if scale == CONSTANT { MAX_SYMBOL } else { 16 * MAX_SYMBOL };
    if mean.unsigned_abs() > u64::from(limit.unsigned_abs()) {
        return Err(reader.malformed("a mean", mean));
    }
    let mean = mean as i32;
    match scale {
        CONSTANT => Ok(Distribution::Constant(mean)),
        ..CONSTANT => Ok(Distribution::Gaussian(Gaussian { mean16: mean, scale })),
        _ => Err(reader.malformed("a scale", scale)),
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::error::DecodeError;

    fn normal(random: &mut Pcg64Mcg) -> f64 {
        let (u, v): (f64, f64) = (random.random(), random.random());
        (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }

    fn total(distribution: Distribution, symbols: &[i32]) -> f64 {
        symbols.iter().map(|symbol| distribution.cost(*symbol)).sum()
    }

    #[test]
    fn the_fit_is_within_a_half_percent_of_the_true_gaussian() {
        let mut random = Pcg64Mcg::seed_from_u64(3);
        for (mean, sigma) in [(0.0, 0.3), (2.3, 5.0), (-40.7, 1.1), (900.0, 80.0), (0.5, 1000.0)] {
            let symbols: Vec<i32> =
                (0..20_000).map(|_| (mean + sigma * normal(&mut random)).round_ties_even() as i32).collect();
            let cumulative = |x: f64| 0.5 * libm::erfc(-(x - mean) / sigma / std::f64::consts::SQRT_2);
            let ideal: f64 = symbols
                .iter()
                .map(|q| -(cumulative(f64::from(*q) + 0.5) - cumulative(f64::from(*q) - 0.5)).log2())
                .sum();
            let bits = total(fit(symbols.clone()), &symbols);
            assert!(bits < 1.005 * ideal, "mean {mean} sigma {sigma}: {bits} bits for {ideal}");
        }
    }

    #[test]
    fn a_few_outliers_do_not_spoil_the_fit() {
        let mut random = Pcg64Mcg::seed_from_u64(4);
        let mut symbols: Vec<i32> = (0..5000).map(|_| (2.0 * normal(&mut random)).round() as i32).collect();
        let alone = total(fit(symbols.clone()), &symbols);
        symbols.extend([1_000_000, -5_000_000]);
        let with = total(fit(symbols.clone()), &symbols);
        assert!(with - alone < 200.0, "{alone} bits became {with}");
    }

    #[test]
    fn equal_symbols_are_a_constant_and_distributions_are_stored() {
        assert_eq!(fit(vec![7; 9]), Distribution::Constant(7));
        assert_eq!(fit(Vec::new()), Distribution::Constant(0));
        for distribution in [
            Distribution::Constant(-MAX_SYMBOL),
            Distribution::Gaussian(Gaussian { mean16: -16 * MAX_SYMBOL, scale: 63 }),
        ] {
            let mut writer = Writer::new();
            write(distribution, &mut writer);
            let bytes = writer.into_bytes();
            assert_eq!(read(&mut Reader::new("t", &bytes)), Ok(distribution));
        }
        assert!(read(&mut Reader::new("t", &[0, 65])).is_err());
    }

    #[test]
    fn means_beyond_the_largest_symbol_are_refused() {
        let read = |mean: i64, scale: u8| {
            let mut writer = Writer::new();
            writer.signed(mean);
            writer.u8(scale);
            let bytes = writer.into_bytes();
            read(&mut Reader::new("t", &bytes))
        };
        for (scale, limit) in [(CONSTANT, 1 << 24), (0, 1 << 28)] {
            assert!(read(limit, scale).is_ok() && read(-limit, scale).is_ok());
            for mean in [limit + 1, -limit - 1, 1 << 32, i64::MAX, i64::MIN] {
                assert_eq!(read(mean, scale), Err(DecodeError::malformed("t", "a mean", mean)));
            }
        }
    }
}
