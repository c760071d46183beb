//! Figures as cells of tables: with their interval, or a dash where there is none.

use tcgs_engine::eval::Estimate;

use super::section::NONE;

/// A mean with its interval, or a dash.
pub(super) fn shown(estimate: Option<Estimate>, decimals: usize) -> String {
    estimate.map_or_else(|| NONE.to_owned(), |estimate| estimate.text(decimals))
}

/// A figure, or a dash.
pub(super) fn decimal(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| NONE.to_owned(), |value| format!("{value:.decimals$}"))
}

/// A difference with its interval, signed, with a star where the interval excludes zero.
pub(super) fn signed(estimate: Option<Estimate>, decimals: usize) -> String {
    let Some(estimate) = estimate else { return NONE.to_owned() };
    let sign = if estimate.mean >= 0.0 { "+" } else { "" };
    let star = if estimate.excludes_zero() == Some(true) { " *" } else { "" };
    format!("{sign}{}{star}", estimate.text(decimals))
}
