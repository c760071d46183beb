//! Scenes in open formats: anchors with their networks as safetensors, plain Gaussians as `.ply` and `.spz`, and baking of anchors
//! into plain Gaussians.
//!
//! Floats are read back bit for bit. Input is untrusted: a file that is not a scene gives an error that names the reason.

pub mod anchors;
pub mod bake;
pub mod placed;
mod ply;
mod ply_note;
pub mod spz;
pub mod world;

pub use bake::bake;
pub use ply::{PlyError, from_ply, ply_bytes, to_ply};
pub use ply_note::PlyNote;
pub use spz::{SpzError, SpzVersion, from_spz, to_spz};
