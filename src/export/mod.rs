//! Scenes in open formats: anchors with their networks as safetensors, plain Gaussians as the field's `.ply` and `.spz`, and
//! anchors as plain Gaussians.
//!
//! What is written in floats is read back bit for bit; bytes are never trusted, and what is no scene is refused with its
//! fault.

pub mod anchors;
pub mod bake;
mod ply;
mod ply_note;
pub mod spz;

pub use bake::bake;
pub use ply::{PlyError, from_ply, ply_bytes, to_ply};
pub use ply_note::PlyNote;
pub use spz::{SpzError, SpzVersion, from_spz, to_spz};
