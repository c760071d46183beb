//! The parameters of scenes on the host: anchors, plain Gaussians and the render networks, as kernels read them.

mod anchor_rows;
pub mod gaussian_rows;
mod networks;

pub use anchor_rows::{AnchorRows, ModelShape, all_offsets, retain_rows};
pub use gaussian_rows::GaussianRows;
pub use networks::{LayerSpec, NetworkLayout};
