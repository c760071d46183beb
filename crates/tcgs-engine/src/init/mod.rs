//! The anchors and Gaussians that training begins with.
//!
//! An anchor is an integer cell from the start; no cell holds two anchors.

mod anchors;
mod anchors_from_gaussians;
mod anchors_from_points;
mod first_anchors;
mod gaussians;
mod lattice;
mod neighbors;
mod principal;
mod symmetric_eigen;

pub use anchors::{InitError, initial_rows, random_points};
pub use anchors_from_gaussians::anchors_from_gaussians;
pub use anchors_from_points::anchors_from_points;
pub use first_anchors::{FirstAnchors, PassingUnits};
pub use gaussians::{initial_gaussians, logit};
pub use lattice::{
    MAX_CELL, VoxelRule, cell_of, cell_within, choose_lattice, coarse, median_spacing, voxelise,
};
pub use symmetric_eigen::symmetric_eigen;
