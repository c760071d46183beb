//! Scenes in open formats of floats: anchors with their networks as safetensors. Depends on `domain` alone.
//!
//! What is written is read back bit for bit; bytes are never trusted, and whatever does not belong to a scene is refused
//! by name.

pub mod anchors;
