//! What measures the product and is not part of it. The commands of `tcgs bench` call it.

#![allow(missing_docs, reason = "records and tables name their columns, and only the command line uses them")]

pub mod accuracy;
pub mod bjontegaard;
pub mod context_trials;
pub mod lpips;
pub mod report;
