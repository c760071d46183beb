//! Scenes in open formats: anchors with their networks as safetensors, plain Gaussians as `.ply`, `.spz`, `.glb`, `.usda` and `.sog`,
//! and baking of anchors into plain Gaussians.
//!
//! Floats are read back bit for bit. Input is untrusted: a file that is not a scene gives an error that names the reason.

pub mod anchors;
pub mod bake;
mod glb;
pub mod limit;
pub mod placed;
mod ply;
mod ply_note;
mod sog;
pub mod spz;
mod usda;
pub mod world;

pub use bake::bake;
pub use glb::{GlbError, to_glb};
pub use limit::limited;
pub use ply::{PlyError, from_ply, ply_bytes, to_ply};
pub use ply_note::PlyNote;
pub use sog::{SogError, SogFile, to_sog};
pub use spz::{SpzError, SpzVersion, from_spz, to_spz};
pub use usda::to_usda;

/// Opacity after the logistic.
fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + f64::from(-logit).exp())
}
