//! Charts as SVG, for the report of a job and the report of a benchmark.
//!
//! They need no script, take the colors of the page around them, and can be printed; [`Chart::standalone`] brings its own colors,
//! for light and dark.

mod axis;
mod chart;

pub use axis::Scale;
pub use chart::{Chart, SERIES_STYLES, Series};
