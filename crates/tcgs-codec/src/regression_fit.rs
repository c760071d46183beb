//! Fits the regression of a coded group: how each channel's mean and standard deviation follow from the anchor's earlier channels.
//!
//! Means are linear in the residuals of the channels before, standard deviations in the model's and in what the mean was shifted by, each
//! by weighted least squares in turn (METHOD.md §4.13). The result depends on the symbols alone, not on threads or platform.

use rayon::prelude::*;

use super::{
    attributes::CodedGroup,
    context::{
        ChannelRegression, GroupRegression,
        regression::{MAX_SHIFT, MAX_WEIGHT, ONE, residual},
    },
    decode::MAX_MULTIPLICATIONS,
    gaussian_constants::INVERSE_SCALE,
    groups::GroupCoder,
    symbols::Distribution,
};

/// Most and fewest anchors that a regression is fitted to, evenly spread, where there are as many.
const MAX_SAMPLE: usize = 8192;
const MIN_SAMPLE: usize = 2048;

/// Anchors times squared channels of a sample: the normal equations of 50 channels shall not take longer than coding does.
const SAMPLE_PRODUCTS: usize = 1 << 22;

/// Fewest symbols for each number that is fitted.
const MIN_SYMBOLS_PER_NUMBER: usize = 4;

/// Rounds of means, then standard deviations.
const ROUNDS: usize = 5;

/// Added to the diagonal of the normal equations, relative to its entries.
const RIDGE: f64 = 1e-9;

/// What is left of a diagonal entry, relative to it, of a column that earlier ones determine but for rounding.
const DEPENDENT: f64 = 1e-7;

/// Factors of the fitted standard deviations that are tried: tails are heavier than a Gaussian's, and the coder takes the next wider of
/// its 64.
const DEVIATION_FACTORS: [f64; 9] = [0.7, 0.78, 0.85, 0.92, 1.0, 1.09, 1.19, 1.3, 1.5];

/// A bound on the bits of a number in the file.
const NUMBER_BITS: f64 = 12.0;

/// The regression under which the symbols of `coded` take fewer bits; `None` if no channel gains.
pub(super) fn fit(coder: &GroupCoder<'_>, coded: &CodedGroup) -> Option<GroupRegression> {
    let anchors = coder.shape.anchors;
    let channels = coder.channels();
    // All three groups together stay within the format's bound.
    let work = GroupRegression::multiplications(channels).saturating_mul(anchors as u64);
    if work > MAX_MULTIPLICATIONS / 3 {
        return None;
    }
    let sample = Sample::of(coder, coded);
    let fitted: Vec<_> =
        (0..channels).into_par_iter().map(|channel| fit_channel(&sample, channel, anchors)).collect();
    fitted.iter().any(Option::is_some).then_some(GroupRegression { channels: fitted })
}

/// Some anchors of a group.
struct Sample {
    channels: usize,
    /// `[n][channels]`, the base model's.
    distributions: Vec<Distribution>,
    /// `[n][channels]`; `None` where a symbol is not coded.
    symbols: Vec<Option<i32>>,
    /// `[n][channels]`.
    residuals: Vec<i64>,
}

impl Sample {
    fn of(coder: &GroupCoder<'_>, coded: &CodedGroup) -> Self {
        let channels = coder.channels();
        let size = (SAMPLE_PRODUCTS / (channels * channels).max(1)).clamp(MIN_SAMPLE, MAX_SAMPLE);
        let stride = coder.shape.anchors.div_ceil(size).max(1);
        let count = coder.shape.anchors.div_ceil(stride) * channels;
        let mut sample = Self {
            channels,
            distributions: Vec::with_capacity(count),
            symbols: Vec::with_capacity(count),
            residuals: Vec::with_capacity(count),
        };
        let mut predictions = coded.model.predictions(coder.anchors);
        for anchor in (0..coder.shape.anchors).step_by(stride) {
            predictions.begin(anchor);
            let row = &coded.symbols[anchor * channels..(anchor + 1) * channels];
            for (channel, (symbol, base)) in row.iter().zip(predictions.base()).enumerate() {
                let symbol = coder.is_coded(anchor, channel).then_some(*symbol);
                sample.symbols.push(symbol);
                sample.residuals.push(residual(*base, symbol));
            }
            sample.distributions.extend_from_slice(predictions.base());
        }
        sample
    }

    /// Places of the anchors whose symbol of `channel` is coded with a Gaussian.
    fn rows(&self, channel: usize) -> Vec<usize> {
        let gaussian = |row: &usize| {
            matches!(self.distributions[row * self.channels + channel], Distribution::Gaussian(_))
        };
        let coded = |row: &usize| self.symbols[row * self.channels + channel].is_some();
        (0..self.symbols.len() / self.channels).filter(coded).filter(gaussian).collect()
    }

    /// Residuals of the channels before `channel`.
    fn before(&self, row: usize, channel: usize) -> &[i64] {
        &self.residuals[row * self.channels..][..channel]
    }

    /// Bits of a channel's symbols, corrected or as the base model has them.
    fn bits(&self, rows: &[usize], channel: usize, regression: Option<&ChannelRegression>) -> f64 {
        let bits = rows.iter().map(|row| {
            let place = row * self.channels + channel;
            let base = self.distributions[place];
            let distribution = match regression {
                None => base,
                Some(regression) => regression.corrected(base, self.before(*row, channel)),
            };
            self.symbols[place].map_or(0.0, |symbol| distribution.cost(symbol))
        });
        bits.sum()
    }
}

/// The regression of one channel, where it saves more than its own numbers take in a file of `anchors` anchors.
fn fit_channel(sample: &Sample, channel: usize, anchors: usize) -> Option<ChannelRegression> {
    let rows = sample.rows(channel);
    if rows.len() < MIN_SYMBOLS_PER_NUMBER * (channel + 3) {
        return None;
    }
    let Lines { mean, deviation } = Lines::of(sample, channel, &rows)?;
    let (weights, shift) = mean.split_at(channel);
    let weights: Vec<i32> = weights.iter().map(|weight| fixed(*weight, MAX_WEIGHT)).collect();
    let shift = (shift[0].round_ties_even() as i32).clamp(-MAX_SHIFT, MAX_SHIFT);
    let candidates = DEVIATION_FACTORS.map(|factor| ChannelRegression {
        shift,
        deviation: fixed(factor * deviation[0], MAX_WEIGHT).max(1),
        slope: fixed(factor * deviation[1], MAX_WEIGHT),
        weights: weights.clone(),
    });
    let measured = candidates.map(|candidate| (sample.bits(&rows, channel, Some(&candidate)), candidate));
    let (bits, best) = measured.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
    let all = anchors as f64 * sample.channels as f64 / sample.symbols.len() as f64;
    let saved = all * (sample.bits(&rows, channel, None) - bits);
    (saved > NUMBER_BITS * (channel + 3) as f64).then_some(best)
}

/// A number in the format's units.
fn fixed(value: f64, limit: i32) -> i32 {
    ((value * f64::from(ONE)).round_ties_even() as i32).clamp(-limit, limit)
}

/// The two linear functions of a channel.
struct Lines {
    /// Weights of the residuals before, then the shift in sixteenths of a step.
    mean: Vec<f64>,
    /// Of the base model's standard deviation, and of what the mean is shifted by.
    deviation: Vec<f64>,
}

impl Lines {
    fn of(sample: &Sample, channel: usize, rows: &[usize]) -> Option<Self> {
        let target = |row: usize| sample.residuals[row * sample.channels + channel] as f64;
        // In sixteenths of a step, as the residuals.
        let of_base: Vec<f64> = rows
            .iter()
            .map(|row| match sample.distributions[row * sample.channels + channel] {
                Distribution::Gaussian(gaussian) => {
                    f64::from(1_u32 << 26) / f64::from(INVERSE_SCALE[usize::from(gaussian.scale)])
                }
                Distribution::Constant(_) => 1.0,
            })
            .collect();
        let mut deviations = of_base.clone();
        let mut lines = None;
        for _ in 0..ROUNDS {
            let mut equations = NormalEquations::new(channel + 1);
            let mut values = vec![1.0; channel + 1];
            for (row, deviation) in rows.iter().zip(&deviations) {
                let before = sample.before(*row, channel);
                values.iter_mut().zip(before).for_each(|(value, residual)| *value = *residual as f64);
                equations.add(&values, target(*row), deviation.powi(-2));
            }
            let mean = equations.solve()?;
            let shifts: Vec<f64> = rows
                .iter()
                .map(|row| {
                    let before = sample.before(*row, channel).iter().map(|residual| *residual as f64);
                    before.chain([1.0]).zip(&mean).map(|(value, weight)| value * weight).sum()
                })
                .collect();
            let mut equations = NormalEquations::new(2);
            for (((row, base), shift), deviation) in rows.iter().zip(&of_base).zip(&shifts).zip(&deviations) {
                // The mean distance from the mean is sqrt(2 / pi) of a Gaussian's standard deviation.
                let distance = (target(*row) - shift).abs() * std::f64::consts::FRAC_PI_2.sqrt();
                equations.add(&[*base, *shift], distance, deviation.powi(-2));
            }
            let deviation = equations.solve()?;
            for ((next, base), shift) in deviations.iter_mut().zip(&of_base).zip(&shifts) {
                // A line may fall below zero far out; a symbol there is coded with the narrowest, and must not outweigh all others.
                *next = (deviation[0] * base + deviation[1] * shift).max(0.1 * base).max(4.0);
            }
            lines = Some(Self { mean, deviation });
        }
        lines
    }
}

/// A weighted least-squares problem.
struct NormalEquations {
    unknowns: usize,
    /// `[unknowns][unknowns]`, its lower triangle.
    matrix: Vec<f64>,
    right: Vec<f64>,
}

impl NormalEquations {
    fn new(unknowns: usize) -> Self {
        Self { unknowns, matrix: vec![0.0; unknowns * unknowns], right: vec![0.0; unknowns] }
    }

    fn add(&mut self, values: &[f64], target: f64, weight: f64) {
        for (row, value) in values.iter().enumerate() {
            let weighted = weight * value;
            self.right[row] += weighted * target;
            let entries = &mut self.matrix[row * self.unknowns..][..=row];
            entries.iter_mut().zip(values).for_each(|(entry, other)| *entry += weighted * other);
        }
    }

    /// By Cholesky decomposition; an unknown that nothing determines is 0. `None` if a sum is not finite.
    fn solve(mut self) -> Option<Vec<f64>> {
        let n = self.unknowns;
        let at = |row: usize, column: usize| row * n + column;
        for row in 0..n {
            let diagonal = self.matrix[at(row, row)] * (1.0 + RIDGE);
            for column in 0..=row {
                let products: f64 =
                    (0..column).map(|k| self.matrix[at(row, k)] * self.matrix[at(column, k)]).sum();
                let entry = if row == column { diagonal } else { self.matrix[at(row, column)] } - products;
                self.matrix[at(row, column)] = if row == column {
                    if entry > DEPENDENT * diagonal { entry.sqrt() } else { f64::INFINITY }
                } else {
                    entry / self.matrix[at(column, column)]
                };
            }
        }
        for row in 0..n {
            let known: f64 = (0..row).map(|k| self.matrix[at(row, k)] * self.right[k]).sum();
            self.right[row] = (self.right[row] - known) / self.matrix[at(row, row)];
        }
        for row in (0..n).rev() {
            let known: f64 = (row + 1..n).map(|k| self.matrix[at(k, row)] * self.right[k]).sum();
            self.right[row] = (self.right[row] - known) / self.matrix[at(row, row)];
        }
        self.right.iter().all(|value| value.is_finite()).then_some(self.right)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_equations_find_the_weights_that_made_their_targets() {
        let wanted = [0.5, -2.0, 7.0];
        let mut equations = NormalEquations::new(3);
        for row in 0..50 {
            let x = f64::from(row);
            let values = [libm::sin(x), libm::cos(3.0 * x), 1.0];
            let target = values.iter().zip(wanted).map(|(value, weight)| value * weight).sum();
            equations.add(&values, target, 1.0 + x);
        }
        let found = equations.solve().expect("is finite");
        assert!(found.iter().zip(wanted).all(|(found, wanted)| (found - wanted).abs() < 1e-6), "{found:?}");
    }

    #[test]
    fn what_nothing_determines_is_zero_and_what_is_not_finite_is_refused() {
        let mut equations = NormalEquations::new(3);
        for row in 1..9 {
            let x = f64::from(row);
            equations.add(&[0.0, x, 2.0 * x], 4.0 * x, 1.0);
        }
        let found = equations.solve().expect("is finite");
        assert_eq!((found[0], found[2]), (0.0, 0.0));
        assert!((found[1] - 4.0).abs() < 1e-6, "{found:?}");
        let mut equations = NormalEquations::new(1);
        equations.add(&[f64::INFINITY], 1.0, 1.0);
        assert_eq!(equations.solve(), None);
    }
}
