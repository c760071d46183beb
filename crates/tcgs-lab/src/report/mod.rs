//! Tables and charts of speed against error, from the records of a declared matrix of runs.

pub mod against_first;
mod cells;
pub mod content;
pub mod conventions;
pub mod csv;
pub mod equal_seconds;
pub mod machine;
pub mod markdown;
pub mod matrix;
pub mod page;
pub mod plots;
pub mod published;
pub mod record;
pub mod section;
pub mod summary;
pub mod sweep;
pub mod variant;
pub mod worst_views;
