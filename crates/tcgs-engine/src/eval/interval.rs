//! Means over repeated runs with their 95 % confidence intervals.
//!
//! Student's t with n - 1 degrees of freedom. One run has a mean and no interval.

use serde::Serialize;

/// A mean over runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// Arithmetic mean.
    pub mean: f64,
    /// Half the width of the 95 % interval of the mean; `None` for a single run.
    pub half_width: Option<f64>,
    /// How many runs.
    pub runs: usize,
}

impl Estimate {
    /// The mean of `values`; `None` without any, or with one that is not finite.
    #[must_use]
    pub fn of(values: &[f64]) -> Option<Self> {
        if values.is_empty() || values.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let runs = values.len();
        let mean = values.iter().sum::<f64>() / runs as f64;
        let half_width = (runs > 1).then(|| {
            let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
            let error = (squares / (runs - 1) as f64 / runs as f64).sqrt();
            student_t_975(runs - 1) * error
        });
        Some(Self { mean, half_width, runs })
    }

    /// Whether the interval excludes zero; `None` for a single run.
    #[must_use]
    pub fn excludes_zero(&self) -> Option<bool> {
        self.half_width.map(|half| self.mean.abs() > half)
    }

    /// The figure with `decimals` decimals, as `29.62 ± 0.31`; a single run has no `±`.
    #[must_use]
    pub fn text(&self, decimals: usize) -> String {
        let mean = self.mean;
        match self.half_width {
            Some(half) => format!("{mean:.decimals$} ± {half:.decimals$}"),
            None => format!("{mean:.decimals$}"),
        }
    }
}

/// The 97.5 % quantile of Student's t with `freedom` >= 1 degrees of freedom: half of a two-sided 95 % interval in standard errors.
#[must_use]
pub fn student_t_975(freedom: usize) -> f64 {
    let (mut low, mut high) = (0.0, 13.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if within(middle, freedom) < 0.95 {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// The probability that Student's t lies within `t` of zero: the finite sums of Abramowitz and Stegun, 26.7.3 and 26.7.4.
fn within(t: f64, freedom: usize) -> f64 {
    let angle = (t / (freedom as f64).sqrt()).atan();
    let (sine, cosine) = angle.sin_cos();
    let is_odd = freedom % 2 == 1;
    // Odd: cos + 2/3 cos³ + 2·4/(3·5) cos⁵ + …; even: 1 + 1/2 cos² + 1·3/(2·4) cos⁴ + …; both end at cos^(n - 2).
    let mut term = if is_odd { cosine } else { 1.0 };
    let mut sum = 0.0;
    let mut power = usize::from(is_odd);
    while power + 2 <= freedom {
        sum += term;
        term *= cosine * cosine * (power + 1) as f64 / (power + 2) as f64;
        power += 2;
    }
    if is_odd { (angle + sine * sum) * std::f64::consts::FRAC_2_PI } else { sine * sum }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_printed_tables() {
        // Any table of Student's t, such as NIST's handbook of statistical methods, 1.3.6.7.2.
        for (freedom, expected) in [
            (1, 12.706),
            (2, 4.303),
            (3, 3.182),
            (4, 2.776),
            (5, 2.571),
            (9, 2.262),
            (10, 2.228),
            (30, 2.042),
            (100, 1.984),
        ] {
            let found = student_t_975(freedom);
            assert!((found - expected).abs() < 6e-4, "{freedom}: {found}");
        }
    }

    #[test]
    fn three_runs_have_the_interval_worked_by_hand() {
        // Deviations -1, 0, 1: s = 1, standard error 1/sqrt(3).
        let estimate = Estimate::of(&[9.0, 10.0, 11.0]).expect("an estimate");
        assert_eq!((estimate.mean, estimate.runs), (10.0, 3));
        let half = estimate.half_width.expect("an interval");
        assert!((half - 4.302_653 / 3.0_f64.sqrt()).abs() < 1e-5, "{half}");
        assert_eq!(estimate.excludes_zero(), Some(true));
        assert_eq!(estimate.text(2), "10.00 ± 2.48");
    }

    #[test]
    fn one_run_has_no_interval_and_none_no_mean() {
        let one = Estimate::of(&[3.5]).expect("an estimate");
        assert_eq!((one.half_width, one.excludes_zero(), one.text(1)), (None, None, "3.5".to_owned()));
        assert_eq!(Estimate::of(&[]), None);
        assert_eq!(Estimate::of(&[1.0, f64::NAN]), None);
        let far = Estimate::of(&[-1.0, 1.0]).expect("an estimate");
        assert_eq!(far.excludes_zero(), Some(false));
    }
}
