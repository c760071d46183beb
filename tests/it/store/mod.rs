//! The store: jobs, datasets, totals and housekeeping on a manual clock, and databases of earlier versions.

mod datasets;
mod garbage;
mod migrations;
mod queue;
mod totals;
