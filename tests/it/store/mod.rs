//! The store: jobs, datasets, totals and garbage collection on a manual clock, and databases of earlier versions.

mod datasets;
mod garbage;
mod migrations;
mod queue;
mod totals;
