//! The adaptive wavelet constraint: how much each band of the two-level Haar transform counts in the loss, and when.
//!
//! The published formula, as it was designed (TC-GS (6), METHOD.md §4.7): early in a run what the low band misses counts,
//! later what the high bands miss. The published program never passes the step, so that its high bands count nothing.
//!
//! | fraction t of the run | low | LH, HL, HH of the finest level | of the second level |
//! |---|---|---|---|
//! | to 5/6 | 1 - t | 0.2 t each | 0.2 t each |
//! | after | 0 | (0.4, 0.3, 0.3) (1 - t) | (0.4, 0.3, 0.3) t |
//!
//! So in the last sixth the second level takes over from the finest, as published.

/// Weight of the whole constraint in the loss.
const CONSTRAINT: f64 = 0.02;

/// Weight of each high band until [`LATE`].
const EARLY_HIGH: f64 = 0.2;

/// Weights of LH, HL and HH from [`LATE`] on.
const LATE_HIGH: [f64; 3] = [0.4, 0.3, 0.3];

/// Fraction of the run after which only high bands count: 25 000 of 30 000 steps.
const LATE: f64 = 5.0 / 6.0;

/// Weights of the bands' mean absolute differences in the loss, not negative. The bands are those of the orthonormal
/// Haar transform: the low band is four times the mean of 4 x 4 pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WaveletWeights {
    /// LL of the second level.
    pub low: f64,
    /// LH, HL and HH of the first level, the finest.
    pub fine: [f64; 3],
    /// LH, HL and HH of the second level.
    pub coarse: [f64; 3],
}

impl WaveletWeights {
    /// The published weights at a fraction of the run (λ_w included; TC-GS II-E).
    #[must_use]
    pub fn at(fraction: f64) -> Self {
        let fraction = fraction.clamp(0.0, 1.0);
        let (first, second) = (CONSTRAINT * (1.0 - fraction), CONSTRAINT * fraction);
        if fraction <= LATE {
            let high = [second * EARLY_HIGH; 3];
            Self { low: first, fine: high, coarse: high }
        } else {
            let of = |weight: f64| LATE_HIGH.map(|band| weight * band);
            Self { low: 0.0, fine: of(first), coarse: of(second) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// λ_w is taken out.
    fn assert_weights(step: u32, low: f64, fine: [f64; 3], coarse: [f64; 3]) {
        let found = WaveletWeights::at(f64::from(step) / 30_000.0);
        let all = |w: WaveletWeights| [w.low].into_iter().chain(w.fine).chain(w.coarse);
        for (found, expected) in all(found).zip(all(WaveletWeights { low, fine, coarse })) {
            assert!((found / 0.02 - expected).abs() < 1e-12, "step {step}: {found:?}");
        }
    }

    #[test]
    fn a_run_of_30_000_has_the_published_weights() {
        assert_weights(0, 1.0, [0.0; 3], [0.0; 3]);
        assert_weights(7_500, 0.75, [0.05; 3], [0.05; 3]);
        assert_weights(15_000, 0.5, [0.1; 3], [0.1; 3]);
        let sixth = 1.0 / 6.0;
        assert_weights(25_000, sixth, [sixth; 3], [sixth; 3]);
        assert_weights(27_000, 0.0, [0.04, 0.03, 0.03], [0.36, 0.27, 0.27]);
        assert_weights(30_000, 0.0, [0.0; 3], [0.4, 0.3, 0.3]);
    }

    #[test]
    fn the_low_band_counts_less_and_the_high_bands_more_as_the_run_goes_on() {
        let at: Vec<_> = (0..=60).map(|part| WaveletWeights::at(f64::from(part) / 60.0)).collect();
        let high = |w: &WaveletWeights| w.fine.iter().chain(&w.coarse).sum::<f64>();
        assert!(at.windows(2).all(|pair| pair[1].low < pair[0].low || pair[1].low == 0.0));
        // Within each phase; where they meet, six bands at 0.2 give way to weights that sum to one.
        for phase in [&at[..=50], &at[51..]] {
            assert!(phase.windows(2).all(|pair| high(&pair[1]) >= high(&pair[0]) - 1e-15));
        }
        assert!(at[1..].iter().all(|w| high(w) > 0.0) && high(&at[60]) > 0.9 * at[0].low);
    }

    #[test]
    fn outside_a_run_its_ends_hold() {
        assert_eq!(WaveletWeights::at(-1.0), WaveletWeights::at(0.0));
        assert_eq!(WaveletWeights::at(1.5), WaveletWeights::at(1.0));
    }
}
