//! The anchor model on the host: lattice and voxelisation, the layout of parameters, the networks.
//!
//! An anchor is an integer cell from the start; no cell holds two anchors.

mod init;
mod lattice;
mod networks;
pub mod plain;
mod rows;

pub use init::{InitError, all_offsets, initial_rows, random_points};
pub use lattice::{MAX_CELL, VoxelRule, cell_of, choose_lattice, coarse, median_spacing, voxelise};
pub use networks::{LayerSpec, NetworkLayout};
pub use plain::{GaussianRows, initial_gaussians};
pub use rows::{AnchorRows, Shape};
