//! The optimizer.

mod adam;

pub use adam::{AdamElement, adam};
