//! The basis in which a scene's features are learnt, quantized and coded from the context model's start on (METHOD.md §4.12).
//!
//! Features matter only through the first layers of the networks, so any invertible linear map of them, with its inverse in those
//! layers, leaves every picture as it is. [`FeatureBasis::of`] chooses the map whose channels are uncorrelated and in which an error
//! of any channel changes the pictures equally: one quantization step is then right for all channels, and those that vary by less
//! than a step is worth need no channel at all.
//!
//! Invariant: all numbers are f64 from sums of a fixed order.

use crate::init::symmetric_eigen;

/// Share of the mean sensitivity that every direction has at least, so that no map has an infinite inverse.
const MIN_SENSITIVITY: f64 = 1e-3;

/// Standard deviation below which a channel is dropped, in quantization steps, where all channels are scaled to make the error in
/// pictures that they make before.
const MIN_DEVIATION: f64 = 0.25;

/// Mean and covariance of features `[N][F]`, those that are not finite left out.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FeatureMoments {
    /// `[F]`.
    pub(super) mean: Vec<f64>,
    /// `[F][F]`.
    pub(super) covariance: Vec<f64>,
}

impl FeatureMoments {
    /// The moments of these rows.
    pub(super) fn of<'a>(rows: impl Iterator<Item = &'a [f32]> + Clone, width: usize) -> Self {
        let rows = rows.filter(|row| row.iter().all(|value| value.is_finite()));
        let count = rows.clone().count().max(1) as f64;
        let mut mean = vec![0.0; width];
        for row in rows.clone() {
            mean.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value));
        }
        mean.iter_mut().for_each(|sum| *sum /= count);
        let mut covariance = vec![0.0; width * width];
        for row in rows {
            let centered: Vec<f64> =
                row.iter().zip(&mean).map(|(value, mean)| f64::from(*value) - mean).collect();
            add_products(&mut covariance, &centered, 1.0 / count);
        }
        Self { mean, covariance }
    }
}

/// Adds `weight` times the products of all pairs of `values`.
pub(super) fn add_products(sums: &mut [f64], values: &[f64], weight: f64) {
    for (sums, value) in sums.chunks_exact_mut(values.len()).zip(values) {
        let factor = weight * value;
        sums.iter_mut().zip(values).for_each(|(sum, other)| *sum += factor * other);
    }
}

/// A linear map of centered features to fewer channels, and back.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FeatureBasis {
    /// Channels before.
    pub(super) width: usize,
    /// Channels after.
    pub(super) channels: usize,
    /// What is subtracted first, `[width]`.
    pub(super) mean: Vec<f64>,
    /// `[channels][width]`.
    pub(super) to: Vec<f64>,
    /// `[width][channels]`.
    pub(super) back: Vec<f64>,
    /// About the bits that a feature takes at the given quantization step, over those that it took, without a context.
    pub(super) bits_share: f64,
}

impl FeatureBasis {
    /// The basis for features of these `moments`, when `sensitivity` `[F][F]` is the mean product of a picture's derivatives by two
    /// channels. The scale keeps the error in pictures that a quantization step of all channels makes; here it is `quant_step`, and
    /// channels that vary little beside it are dropped. None where nothing depends on features, or nothing is finite.
    pub(super) fn of(moments: &FeatureMoments, sensitivity: &[f64], quant_step: f64) -> Option<Self> {
        let FeatureMoments { mean, covariance } = moments;
        let width = mean.len();
        let trace: f64 = (0..width).map(|i| sensitivity[i * width + i]).sum();
        let finite = sensitivity.iter().chain(covariance).all(|value| value.is_finite());
        if !finite || trace <= 0.0 {
            return None;
        }
        let mut sensitivity = sensitivity.to_vec();
        for i in 0..width {
            sensitivity[i * width + i] += MIN_SENSITIVITY * trace / width as f64;
        }
        let (values, vectors) = symmetric_eigen(&sensitivity, width);
        let power = |exponent: f64| {
            let mut sums = vec![0.0; width * width];
            for (value, vector) in values.iter().zip(vectors.chunks_exact(width)) {
                add_products(&mut sums, vector, value.powf(exponent));
            }
            sums
        };
        let (root, inverse_root) = (power(0.5), power(-0.5));
        let weighted = product(&product(&root, covariance, width), &root, width);
        let (variances, axes) = symmetric_eigen(&weighted, width);
        // Channels are judged by the scale of all of them: that of fewer is smaller, and would judge more of them too small.
        let large =
            |variance: &&f64| width as f64 / trace * **variance >= (MIN_DEVIATION * quant_step).powi(2);
        let channels = variances.iter().filter(large).count().max(1);
        let scale = (channels as f64 / trace).sqrt();
        let axes = &axes[..channels * width];
        let to = product(axes, &root, width).iter().map(|value| scale * value).collect();
        let columns = product(axes, &inverse_root, width);
        let back = (0..width)
            .flat_map(|row| (0..channels).map(move |channel| (row, channel)))
            .map(|(row, channel)| columns[channel * width + row] / scale)
            .collect();
        let bits = |variance: f64| (1.0 + 12.0 * variance.max(0.0) / quant_step.powi(2)).log2();
        let before: f64 = (0..width).map(|i| bits(covariance[i * width + i])).sum();
        let after: f64 = variances[..channels].iter().map(|variance| bits(scale * scale * variance)).sum();
        let bits_share = if before > 0.0 && after.is_finite() { (after / before).min(1.0) } else { 1.0 };
        Some(Self { width, channels, mean: mean.clone(), to, back, bits_share })
    }

    /// A feature in the new basis.
    pub(super) fn feature(&self, feature: &[f32]) -> Vec<f32> {
        let centered: Vec<f64> =
            feature.iter().zip(&self.mean).map(|(value, mean)| f64::from(*value) - mean).collect();
        self.to.chunks_exact(self.width).map(|row| dot(row, &centered) as f32).collect()
    }

    /// Mean squares of gradients by a feature as those by the feature in the new basis, for uncorrelated gradients.
    pub(super) fn squared_gradient(&self, squares: &[f32]) -> Vec<f32> {
        self.back_sums(|row, weight| weight * weight * f64::from(squares[row]))
    }

    /// The sums over a feature's rows of a term of each and its weight in a channel.
    fn back_sums(&self, term: impl Fn(usize, f64) -> f64) -> Vec<f32> {
        let of = |channel: usize| {
            (0..self.width).map(|row| term(row, self.back[row * self.channels + channel])).sum::<f64>() as f32
        };
        (0..self.channels).map(of).collect()
    }

    /// The weights `[width]` of an output by features, as those by channels, and what is added to its bias.
    pub(super) fn weights(&self, weights: &[f32]) -> (Vec<f32>, f64) {
        let bias = weights.iter().zip(&self.mean).map(|(weight, mean)| f64::from(*weight) * mean).sum();
        (self.back_sums(|row, weight| weight * f64::from(weights[row])), bias)
    }

    /// Mean squares of gradients by the weights of an output, as those by the weights of channels, for uncorrelated gradients.
    pub(super) fn squared_weight_gradient(&self, squares: &[f32]) -> Vec<f32> {
        let sum =
            |row: &[f64]| row.iter().zip(squares).map(|(w, square)| w * w * f64::from(*square)).sum::<f64>();
        self.to.chunks_exact(self.width).map(|row| sum(row) as f32).collect()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// `[m][width]` times the square matrix `b`.
fn product(a: &[f64], b: &[f64], width: usize) -> Vec<f64> {
    let mut rows = vec![0.0; a.len()];
    for (row, sums) in a.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        for (factor, other) in row.iter().zip(b.chunks_exact(width)) {
            sums.iter_mut().zip(other).for_each(|(sum, value)| *sum += factor * value);
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    const WIDTH: usize = 8;

    /// Features of 500 anchors that vary in three directions, and a random sensitivity.
    fn features(rng: &mut Pcg64) -> Vec<f32> {
        let directions: Vec<f32> = (0..3 * WIDTH).map(|_| rng.random_range(-1.0..1.0)).collect();
        let mut rows = Vec::new();
        for _ in 0..500 {
            let weights: [f32; 3] = std::array::from_fn(|_| rng.random_range(-2.0..2.0));
            rows.extend((0..WIDTH).map(|channel| {
                0.5 + (0..3).map(|i| weights[i] * directions[i * WIDTH + channel]).sum::<f32>()
            }));
        }
        rows
    }

    fn sensitivity(rng: &mut Pcg64, rank: usize) -> Vec<f64> {
        let mut sums = vec![0.0; WIDTH * WIDTH];
        for _ in 0..rank {
            let row: Vec<f64> = (0..WIDTH).map(|_| rng.random_range(-1.0..1.0)).collect();
            add_products(&mut sums, &row, 1.0);
        }
        sums
    }

    fn moments(rows: &[f32]) -> FeatureMoments {
        FeatureMoments::of(rows.chunks_exact(WIDTH), WIDTH)
    }

    #[test]
    fn outputs_of_networks_stay_where_no_channel_is_dropped_and_where_those_that_never_vary_are() {
        let mut rng = Pcg64::seed_from_u64(1);
        let rows = features(&mut rng);
        for (quant_step, channels) in [(0.0, WIDTH), (4e-3, 3)] {
            let basis = FeatureBasis::of(&moments(&rows), &sensitivity(&mut rng, WIDTH), quant_step)
                .expect("a basis");
            assert_eq!(basis.channels, channels);
            let weights: Vec<f32> = (0..WIDTH).map(|_| rng.random_range(-1.0..1.0)).collect();
            let (mapped, bias) = basis.weights(&weights);
            for row in rows.chunks_exact(WIDTH) {
                let sum = |a: &[f32], b: &[f32]| {
                    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
                };
                let (before, after) = (sum(&weights, row), sum(&mapped, &basis.feature(row)) + bias);
                assert!((before - after).abs() < 1e-4 * (1.0 + before.abs()), "{before} is now {after}");
            }
        }
    }

    #[test]
    fn channels_are_uncorrelated_and_pictures_equally_sensitive_to_them_as_to_the_features_together() {
        let mut rng = Pcg64::seed_from_u64(2);
        let rows = features(&mut rng);
        let sensitivity = sensitivity(&mut rng, 20);
        let basis = FeatureBasis::of(&moments(&rows), &sensitivity, 4e-3).expect("a basis");
        assert!((0.2..0.6).contains(&basis.bits_share), "3 of 8 channels: {}", basis.bits_share);
        let mapped: Vec<f32> = rows.chunks_exact(WIDTH).flat_map(|row| basis.feature(row)).collect();
        let FeatureMoments { mean, covariance } = FeatureMoments::of(mapped.chunks_exact(3), 3);
        assert!(mean.iter().all(|value| value.abs() < 1e-4));
        let trace: f64 = (0..WIDTH).map(|i| sensitivity[i * WIDTH + i]).sum();
        for i in 0..3 {
            assert!(
                i == 0 || covariance[i * 3 + i] <= covariance[(i - 1) * 3 + i - 1] + 1e-6,
                "largest first"
            );
            for j in 0..3 {
                assert!(i == j || covariance[i * 3 + j].abs() < 1e-4 * covariance[0], "{covariance:?}");
                let by = |a: usize, b: usize| {
                    basis.back[a * 3 + i] * sensitivity[a * WIDTH + b] * basis.back[b * 3 + j]
                };
                let product: f64 = (0..WIDTH * WIDTH).map(|at| by(at / WIDTH, at % WIDTH)).sum();
                let expected = if i == j { trace / 3.0 } else { 0.0 };
                // But for the least sensitivity that every direction is given.
                assert!((product - expected).abs() < 0.02 * trace, "{product} for {expected}");
            }
        }
    }

    #[test]
    fn directions_that_no_picture_shows_are_dropped_although_features_vary_in_them() {
        let mut rng = Pcg64::seed_from_u64(3);
        let rows: Vec<f32> = (0..4000).map(|_| rng.random_range(-1.0..1.0)).collect();
        let basis = FeatureBasis::of(&moments(&rows), &sensitivity(&mut rng, 2), 0.4).expect("a basis");
        assert_eq!(basis.channels, 2);
        let all = FeatureBasis::of(&moments(&rows), &sensitivity(&mut rng, 2), 1e9).expect("a basis");
        assert_eq!(all.channels, 1, "at least one is left");
    }

    #[test]
    fn squared_gradients_are_those_of_independent_signs() {
        let mut rng = Pcg64::seed_from_u64(4);
        let rows = features(&mut rng);
        let basis = FeatureBasis::of(&moments(&rows), &sensitivity(&mut rng, 9), 4e-3).expect("a basis");
        let sizes: Vec<f32> = (0..WIDTH).map(|_| rng.random_range(0.1..1.0)).collect();
        let squares: Vec<f32> = sizes.iter().map(|size| size * size).collect();
        // A channel's change is a change of the feature along its column of `back`, and of a weight along its row of `to`.
        let (mut by_feature, mut by_weight) = ([0.0; 3], [0.0; 3]);
        let draws = 20_000;
        for _ in 0..draws {
            let gradient: Vec<f64> =
                sizes.iter().map(|size| f64::from(if rng.random() { *size } else { -size })).collect();
            for channel in 0..3 {
                let column: Vec<f64> = (0..WIDTH).map(|row| basis.back[row * 3 + channel]).collect();
                by_feature[channel] += dot(&column, &gradient).powi(2) / f64::from(draws);
                by_weight[channel] +=
                    dot(&basis.to[channel * WIDTH..][..WIDTH], &gradient).powi(2) / f64::from(draws);
            }
        }
        let near = |found: &[f32], expected: &[f64]| {
            for (found, expected) in found.iter().zip(expected) {
                assert!((f64::from(*found) / expected - 1.0).abs() < 0.05, "{found} for {expected}");
            }
        };
        near(&basis.squared_gradient(&squares), &by_feature);
        near(&basis.squared_weight_gradient(&squares), &by_weight);
    }

    #[test]
    fn nothing_is_chosen_from_nothing_or_from_nonsense() {
        let mut rng = Pcg64::seed_from_u64(5);
        let rows = features(&mut rng);
        assert_eq!(FeatureBasis::of(&moments(&rows), &[0.0; WIDTH * WIDTH], 0.1), None);
        assert_eq!(FeatureBasis::of(&moments(&rows), &[f64::NAN; WIDTH * WIDTH], 0.1), None);
        let mut spoiled = rows.clone();
        spoiled[3] = f32::INFINITY;
        assert_eq!(moments(&spoiled), moments(&rows[WIDTH..]));
        assert!(moments(&[]).covariance.iter().all(|value| *value == 0.0));
    }
}
