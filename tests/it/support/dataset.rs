//! The bundled scene, as small as it can be.

use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use tcgs::{
    ingest,
    sample::{self, Settings},
};

const SMALLEST: Settings = Settings { points: 100, ..Settings::square(16) };

/// Its zip, which every check of a dataset lets pass.
pub fn zip() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.zip");
    sample::write(&path, &SMALLEST).expect("writes");
    std::fs::read(path).expect("readable")
}

/// The same with a file of so many bytes that no layout asks for.
pub fn padded_zip(bytes: usize) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = folder.path().join("scene");
    sample::write(&scene, &SMALLEST).expect("writes");
    let mut padding = vec![0_u8; bytes];
    Pcg64Mcg::seed_from_u64(7).fill(&mut padding[..]);
    std::fs::write(scene.join("padding.bin"), padding).expect("written");
    let path = folder.path().join("padded.zip");
    let mut archive = std::fs::File::create(&path).expect("a file");
    ingest::pack(&scene, &mut archive).expect("packed");
    std::fs::read(path).expect("readable")
}
