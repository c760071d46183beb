//! Scenes in the file formats of other programs.

mod ply;

pub use ply::{PlyError, from_ply, ply_bytes, to_ply};
