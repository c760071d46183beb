//! Decodes `.tcgs` files in memory and prints what is in them: `cargo run --example decode -- scene.tcgs`.

use std::{env, error::Error, fs};

use tcgs_codec::{DecodeLimits, decode};

fn main() -> Result<(), Box<dyn Error>> {
    for path in env::args().skip(1) {
        let bytes = fs::read(&path)?;
        let limits = DecodeLimits { max_memory_bytes: 1 << 30, ..DecodeLimits::default() };
        let decoded = decode(&bytes, &limits).map_err(|error| format!("{path}: {error}"))?;
        let scene = &decoded.scene;
        println!("{path}: {} bytes, decode SHA-256 {}", bytes.len(), decoded.decode_sha256);
        println!("  {} anchors, {} Gaussians", scene.len(), decoded.manifest.gaussians);
        println!("  {} features an anchor, voxel {}", scene.feature_dim, scene.lattice.voxel);
        if let Some(&cell) = scene.cells.first() {
            println!("  first anchor at {:?}", scene.lattice.position(cell));
        }
    }
    Ok(())
}
