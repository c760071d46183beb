//! Rows of the table of cases.

use std::sync::Arc;

use serde::Serialize;

use super::error::{AccuracyError, CaseError};
use tcgs_render::gpu::Device;

/// Errors that a case measured, by quantity.
pub(super) type Errors = Vec<(&'static str, f64)>;

/// How a case is measured.
pub(super) type Measure = fn(&Arc<Device>) -> Result<Errors, CaseError>;

/// A hard case.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// Kebab-case name, unique.
    pub name: &'static str,
    /// Bounds on what it measures.
    pub bounds: &'static [Bound],
    pub(super) measure: Measure,
}

/// A bound on the error of a quantity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bound {
    /// What is compared, and in which norm.
    pub quantity: &'static str,
    /// The largest error.
    pub largest: f64,
    /// Why so large.
    pub why: &'static str,
}

/// A measured error beside its bound.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Outcome {
    /// Name of the case.
    pub name: &'static str,
    /// What was compared, and in which norm.
    pub quantity: &'static str,
    /// The error; `null` in JSON if it is not finite.
    pub error: f64,
    /// The largest error allowed.
    pub bound: f64,
    /// Whether the error is a number within the bound.
    pub held: bool,
}

impl Case {
    /// Measures the case: one outcome for each bound.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn outcomes(&self, device: &Arc<Device>) -> Result<Vec<Outcome>, AccuracyError> {
        let errors = (self.measure)(device).map_err(|error| AccuracyError { case: self.name, error })?;
        let error_of = |bound: &Bound| {
            let found = errors.iter().find(|(quantity, _)| *quantity == bound.quantity);
            found.map_or(f64::NAN, |(_, error)| *error)
        };
        Ok(self.bounds.iter().map(|bound| Outcome::new(self.name, bound, error_of(bound))).collect())
    }
}

impl Outcome {
    fn new(name: &'static str, bound: &Bound, error: f64) -> Self {
        // False for NaN.
        let held = error <= bound.largest;
        Self { name, quantity: bound.quantity, error, bound: bound.largest, held }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_is_no_number_is_not_held_and_is_null_in_json() {
        let bound = Bound { quantity: "image", largest: 1.0, why: "" };
        for error in [f64::NAN, f64::INFINITY] {
            let outcome = Outcome::new("case", &bound, error);
            assert!(!outcome.held);
            let json = serde_json::to_value(outcome).expect("JSON");
            assert!(json["error"].is_null() && json["held"] == false, "{json}");
        }
        assert!(Outcome::new("case", &bound, 1.0).held && !Outcome::new("case", &bound, 1.1).held);
    }
}
