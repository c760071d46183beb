//! The anchor model on the host: lattice and voxelisation, the layout of parameters, the networks.
//!
//! An anchor is an integer cell from the start; no cell holds two anchors.

mod anchor_rows;
mod anchors_from_gaussians;
mod anchors_from_points;
mod first_anchors;
pub mod gaussian_rows;
mod init;
mod lattice;
mod networks;
mod principal;
mod symmetric_eigen;

pub use anchor_rows::{AnchorRows, Shape, retain_rows};
pub use anchors_from_gaussians::anchors_from_gaussians;
pub use anchors_from_points::anchors_from_points;
pub use first_anchors::{FirstAnchors, PassingUnits};
pub use gaussian_rows::{GaussianRows, initial_gaussians};
pub use init::{InitError, all_offsets, initial_rows, random_points};
pub use lattice::{
    MAX_CELL, VoxelRule, cell_of, cell_within, choose_lattice, coarse, median_spacing, voxelise,
};
pub use networks::{LayerSpec, NetworkLayout};
pub use symmetric_eigen::symmetric_eigen;
