//! The bundled scene, as small as it can be.

use tcgs::sample::{self, Settings};

/// Its zip, which every check of a dataset lets pass.
pub fn zip() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.zip");
    sample::write(&path, &Settings { side: 16, points: 100, seed: 1 }).expect("writes");
    std::fs::read(path).expect("readable")
}
