//! The store: jobs, datasets, totals and housekeeping on a manual clock, and databases of earlier versions.

mod housekeeping;
mod migrations;
mod queue;
mod scenes;
mod totals;
