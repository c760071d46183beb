//! Measures the kernels' errors on hard cases, with the f64 twins, closed forms and integer arithmetic as truth.
//!
//! Invariants: one table holds every case; each error that a case measures has a bound in that table, with its reason; an error
//! that is not a number, and a bound without a measured error, is not held.

mod anchors;
mod blending;
mod case;
mod entropy;
mod error;
mod images;
mod loss;
mod norms;
mod optimizer;
mod primitives;
mod projection;
mod raster;
mod scenes;
mod sums;

use std::sync::Arc;

pub use case::{Bound, Case, Outcome};
pub use error::AccuracyError;

use tcgs_render::gpu::Device;

/// Every case, by area.
#[must_use]
pub fn cases() -> Vec<&'static Case> {
    let areas = [
        projection::CASES,
        blending::CASES,
        images::CASES,
        anchors::CASES,
        loss::CASES,
        entropy::CASES,
        optimizer::CASES,
        sums::CASES,
        primitives::CASES,
    ];
    areas.into_iter().flatten().collect()
}

/// Measures every case on a device, and calls `begin` with the name of each before it begins.
///
/// # Errors
/// Faults of the device, with the name of the case.
pub fn measure(device: &Arc<Device>, mut begin: impl FnMut(&str)) -> Result<Vec<Outcome>, AccuracyError> {
    let mut outcomes = Vec::new();
    for case in cases() {
        begin(case.name);
        outcomes.extend(case.outcomes(device)?);
    }
    Ok(outcomes)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn names_are_unique_and_every_bound_has_its_reason() {
        let names: BTreeSet<&str> = cases().iter().map(|case| case.name).collect();
        assert_eq!(names.len(), cases().len());
        for case in cases() {
            let kebab = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
            assert!(case.name.chars().all(kebab), "{}", case.name);
            let quantities: BTreeSet<&str> = case.bounds.iter().map(|bound| bound.quantity).collect();
            assert!(!quantities.is_empty() && quantities.len() == case.bounds.len(), "{}", case.name);
            for bound in case.bounds {
                assert!(bound.largest.is_finite() && bound.largest >= 0.0, "{}", case.name);
                assert!(!bound.why.is_empty(), "{}: {}", case.name, bound.quantity);
            }
        }
    }
}
