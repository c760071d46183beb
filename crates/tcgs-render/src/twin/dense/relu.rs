//! The activation between layers, and its gradient.

/// max(x, 0).
#[must_use]
pub fn relu(column: Vec<f64>) -> Vec<f64> {
    column.into_iter().map(|v| v.max(0.0)).collect()
}

/// The gradient before the ReLU from the values after it.
#[must_use]
pub fn relu_gate(values: &[f64], gradient: Vec<f64>) -> Vec<f64> {
    gradient.into_iter().zip(values).map(|(d, v)| if *v > 0.0 { d } else { 0.0 }).collect()
}
