//! One Adam step of one element (METHOD.md §2.5).

/// A parameter with its moments.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AdamElement {
    /// The parameter.
    pub value: f64,
    /// Running mean of its gradient.
    pub first: f64,
    /// Running mean of the gradient's square.
    pub second: f64,
}

/// Step `t` (from 1) with betas 0.9 and 0.999, epsilon outside the root. A gradient of 1e18 or more, whose square f32 might
/// not hold, changes nothing, nor does one that is not a number.
#[must_use]
pub fn adam(element: AdamElement, t: u32, learning_rate: f64, gradient: f64) -> AdamElement {
    if gradient.is_nan() || gradient.abs() >= 1e18 {
        return element;
    }
    let first = 0.9 * element.first + 0.1 * gradient;
    let second = 0.999 * element.second + 0.001 * gradient * gradient;
    let t = f64::from(t);
    let mean = first / (1.0 - 0.9_f64.powf(t));
    let root = (second / (1.0 - 0.999_f64.powf(t))).sqrt();
    AdamElement { value: element.value - learning_rate * mean / (root + 1e-15), first, second }
}
