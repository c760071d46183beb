//! Bits of a value in its bin under a normal distribution, with derivatives: `shaders/shared/gaussian.wgsl` in f64.

use std::f64::consts::{FRAC_1_SQRT_2, LN_2, LOG2_E, PI};

/// Nodes and weights of the ten-point Gauss-Legendre rule on the half from 0 to 1.
const RULE: [[f64; 2]; 5] = [
    [0.148_874_338_981_631_2, 0.295_524_224_714_752_9],
    [0.433_395_394_129_247_2, 0.269_266_719_309_996_4],
    [0.679_409_568_299_024_4, 0.219_086_362_515_982_04],
    [0.865_063_366_688_984_5, 0.149_451_349_150_580_6],
    [0.973_906_528_517_171_7, 0.066_671_344_308_688_14],
];

/// What a value costs, and how that changes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SymbolBits {
    /// Bits.
    pub bits: f64,
    /// By the value; by the mean it is the negative.
    pub by_value: f64,
    /// By the base-2 logarithm of the standard deviation.
    pub by_log_deviation: f64,
    /// By the base-2 logarithm of the bin's width.
    pub by_log_width: f64,
}

/// exp(x²) erfc(x) for x >= 0.
fn scaled_erfc(x: f64) -> f64 {
    if x < 25.0 {
        return (x * x).exp() * libm::erfc(x);
    }
    // The asymptotic series; its next term is below 1e-15 there.
    let t = 1.0 / (2.0 * x * x);
    (1.0 - t * (1.0 - 3.0 * t * (1.0 - 5.0 * t * (1.0 - 7.0 * t * (1.0 - 9.0 * t))))) / (x * PI.sqrt())
}

/// Bits of `value` in a bin of `width` around it under a normal distribution. The cases are the kernel's: see there.
#[must_use]
pub fn symbol_bits(value: f64, mean: f64, deviation: f64, width: f64) -> SymbolBits {
    let difference = value - mean;
    let d = difference.abs();
    let (z, w) = (d / deviation, width / deviation);
    let (a, b) = ((d - 0.5 * width) / deviation, (d + 0.5 * width) / deviation);
    let y = 0.5 * z * w;
    let rest = (-2.0 * y).exp();
    // Natural logarithm of the probability, and the density at `a` over it.
    let (log, ratio) = if a <= 0.0 {
        let outside = 0.5 * (libm::erfc(b * FRAC_1_SQRT_2) + libm::erfc(-a * FRAC_1_SQRT_2));
        let inside = 0.5 * (libm::erf(b * FRAC_1_SQRT_2) + libm::erf(-a * FRAC_1_SQRT_2));
        let log = if outside < 0.5 { (-outside).ln_1p() } else { inside.ln() };
        (log, (-0.5 * a * a).exp() / (2.0 * PI).sqrt() / inside)
    } else if y < 0.5 {
        let h = 0.5 * w;
        let term = |[v, weight]: [f64; 2]| weight * (y * v).cosh() * (-0.5 * (h * v).powi(2)).exp();
        let density = w * RULE.into_iter().map(term).sum::<f64>();
        (-0.5 * z * z + (density / (2.0 * PI).sqrt()).ln(), (y - 0.5 * h * h).exp() / density)
    } else {
        let twice = scaled_erfc(a * FRAC_1_SQRT_2) - rest * scaled_erfc(b * FRAC_1_SQRT_2);
        (-0.5 * a * a + (0.5 * twice).ln(), (2.0 / PI).sqrt() / twice)
    };
    let slope = ratio * -(-2.0 * y).exp_m1();
    let spread = 0.5 * w * ratio * (1.0 + rest);
    SymbolBits {
        bits: -log / LN_2,
        by_value: LOG2_E * slope / deviation * if difference < 0.0 { -1.0 } else { 1.0 },
        by_log_deviation: spread - z * slope,
        by_log_width: -spread,
    }
}
