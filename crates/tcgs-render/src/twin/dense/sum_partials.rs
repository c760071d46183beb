//! The sum of the runs of weight gradients.

/// Adds the runs.
#[must_use]
pub fn sum_partials(parameters: usize, partials: &[Vec<f64>]) -> Vec<f64> {
    (0..parameters).map(|parameter| partials.iter().map(|run| run[parameter]).sum()).collect()
}
