//! Discretised Gaussians as integer tables of 24-bit counts, with an escape for what lies outside.
//!
//! A Gaussian is named by a mean in sixteenths of a step and one of 64 standard deviations, so there are
//! 64 x 16 tables. They are computed in integers from the two committed tables of `gaussian_constants`; every
//! entry has at least one count.

use std::sync::OnceLock;

use super::gaussian_constants::{INVERSE_SCALE, SCALES, UPPER_TAIL};

/// Bits of a table's counts.
pub(super) const GAUSSIAN_PRECISION: usize = 24;

/// Sub-step positions of the mean.
const PHASES: usize = 16;

/// Fraction bits of the interpolation between entries of the tail table.
const FRACTION_BITS: u32 = 20;

/// A discretised Gaussian over the integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Gaussian {
    /// Mean in sixteenths of a step.
    pub(super) mean16: i32,
    /// Index of the standard deviation, below 64.
    pub(super) scale: u8,
}

impl Gaussian {
    /// The integer of the table's middle entry: the mean rounded down.
    pub(super) fn center(self) -> i32 {
        self.mean16 >> 4
    }

    /// The counts around the center, made on first use.
    pub(super) fn table(self) -> &'static Table {
        static TABLES: [OnceLock<Table>; SCALES * PHASES] = [const { OnceLock::new() }; SCALES * PHASES];
        let phase = (self.mean16 & 15) as usize;
        let scale = usize::from(self.scale);
        TABLES[scale * PHASES + phase].get_or_init(|| Table::new(scale, phase))
    }
}

/// Upper bits of a quantile by which the search for its entry begins: most entries of a narrow table are found by
/// them alone, and 1 kB a table still lets the tables of a scene stay in a core's second cache.
const LOOKUP_BITS: usize = 9;

const LOOKUP_SHIFT: u32 = (GAUSSIAN_PRECISION - LOOKUP_BITS) as u32;

/// Cumulative counts of the integers from `-radius` to `radius` around a center, then of the escape.
#[derive(Debug)]
pub(super) struct Table {
    radius: i32,
    /// Start of each entry's interval, the escape's last; then 2^24, where the escape ends.
    starts: Vec<u32>,
    /// For each value of a quantile's upper bits, the entry that holds the least such quantile; then the escape.
    lookup: [u16; (1 << LOOKUP_BITS) + 1],
}

impl Table {
    fn new(scale: usize, phase: usize) -> Self {
        let inverse = i64::from(INVERSE_SCALE[scale]);
        // 5.5 standard deviations and a little more; beyond them the escape is cheaper than a longer table.
        let radius = (11 << 21) / inverse + 2;
        let entries = 2 * radius as u64 + 2;
        let free = (1 << GAUSSIAN_PRECISION) - entries;
        // Sixteenths of a step from the mean to the lower edge of the bin of `difference`.
        let edge = |difference: i64| phi((16 * difference - phase as i64 - 8) * inverse);
        let first = edge(-radius);
        let mut starts: Vec<u32> = (-radius..=radius + 1)
            .zip(0_u64..)
            .map(|(difference, index)| (index + (((edge(difference) - first) * free) >> 32)) as u32)
            .collect();
        starts.push(1 << GAUSSIAN_PRECISION);
        let mut lookup = [0; (1 << LOOKUP_BITS) + 1];
        for (upper, entry) in lookup.iter_mut().enumerate() {
            let min = ((upper as u32) << LOOKUP_SHIFT).min((1 << GAUSSIAN_PRECISION) - 1);
            *entry = (starts.partition_point(|start| *start <= min) - 1) as u16;
        }
        Self { radius: radius as i32, starts, lookup }
    }

    /// Largest distance from the center that has its own entry.
    pub(super) fn radius(&self) -> i32 {
        self.radius
    }

    /// Index of the escape.
    pub(super) fn escape(&self) -> usize {
        self.starts.len() - 2
    }

    /// Start and count of an entry.
    pub(super) fn interval(&self, index: usize) -> Option<(u32, u32)> {
        let end = *self.starts.get(index + 1)?;
        let start = self.starts[index];
        Some((start, end - start))
    }

    /// The entry whose interval holds `quantile`, which is below 2^24, with the interval.
    pub(super) fn find(&self, quantile: u32) -> (usize, u32, u32) {
        let upper = (quantile >> LOOKUP_SHIFT) as usize;
        let (mut index, last) = (usize::from(self.lookup[upper]), usize::from(self.lookup[upper + 1]));
        if index < last {
            index += self.starts[index + 1..=last].partition_point(|start| *start <= quantile);
        }
        let start = self.starts[index];
        (index, start, self.starts[index + 1] - start)
    }
}

/// The normal distribution function in 2^-32, at `x` in 2^-26 standard deviations.
fn phi(x: i64) -> u64 {
    let distance = x.unsigned_abs();
    let index = (distance >> FRACTION_BITS) as usize;
    let tail = match (UPPER_TAIL.get(index), UPPER_TAIL.get(index + 1)) {
        (Some(here), Some(next)) => {
            let fraction = distance & ((1 << FRACTION_BITS) - 1);
            u64::from(*here) - ((u64::from(here - next) * fraction) >> FRACTION_BITS)
        }
        _ => 0,
    };
    if x < 0 { tail } else { (1 << 32) - tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_committed_tables_are_the_rounded_expressions() {
        for (scale, inverse) in INVERSE_SCALE.iter().enumerate() {
            let exact = libm::exp2((816.0 - 7.0 * scale as f64) / 32.0);
            assert_eq!(f64::from(*inverse), libm::round(exact), "scale {scale}");
        }
        for (index, tail) in UPPER_TAIL.iter().enumerate() {
            let exact = libm::exp2(31.0) * libm::erfc(index as f64 / 64.0 / std::f64::consts::SQRT_2);
            assert!((f64::from(*tail) - exact).abs() <= 0.5 + 1e-5, "tail {index}: {tail} for {exact}");
        }
    }

    #[test]
    fn every_table_is_a_distribution_with_no_empty_entry() {
        for scale in 0..SCALES as u8 {
            for mean16 in 0..PHASES as i32 {
                let table = Gaussian { mean16, scale }.table();
                assert_eq!(table.starts[0], 0);
                assert_eq!(table.starts.len(), 2 * table.radius as usize + 3);
                assert!(
                    table.starts.windows(2).all(|pair| pair[0] < pair[1]),
                    "scale {scale} phase {mean16}"
                );
                assert!(table.starts[table.escape()] < 1 << GAUSSIAN_PRECISION);
            }
        }
    }

    #[test]
    fn counts_follow_the_distribution_to_a_hundredth_of_a_percent_of_the_bits() {
        let distribution = |x: f64| 0.5 * libm::erfc(-x / std::f64::consts::SQRT_2);
        for scale in [0_u8, 5, 11, 16, 24, 40, 63] {
            let sigma = libm::exp2(-3.5 + 7.0 * f64::from(scale) / 32.0);
            for phase in [0, 5, 8, 15] {
                let table = Gaussian { mean16: phase, scale }.table();
                let (mut exact_bits, mut table_bits) = (0.0, 0.0);
                for index in 0..table.escape() {
                    let offset = (index as i32 - table.radius) as f64 - f64::from(phase) / 16.0;
                    let exact = distribution((offset + 0.5) / sigma) - distribution((offset - 0.5) / sigma);
                    if exact > 0.0 {
                        let count = f64::from(table.interval(index).expect("in range").1);
                        exact_bits -= exact * exact.log2();
                        table_bits -= exact * (count / f64::from(1 << GAUSSIAN_PRECISION)).log2();
                    }
                }
                let loss = table_bits - exact_bits;
                assert!(
                    loss < 1e-4 * exact_bits + 2e-3,
                    "scale {scale} phase {phase}: {loss} of {exact_bits}"
                );
            }
        }
    }

    #[test]
    fn a_quantile_finds_the_entry_that_holds_it() {
        for scale in [0, 7, 20, 41, 63] {
            let table = Gaussian { mean16: -37, scale }.table();
            for index in 0..=table.escape() {
                let (start, count) = table.interval(index).expect("in range");
                assert_eq!(table.find(start), (index, start, count));
                assert_eq!(table.find(start + count - 1), (index, start, count));
            }
            assert_eq!(table.interval(table.escape() + 1), None);
        }
    }
}
