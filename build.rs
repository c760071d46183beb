//! Embeds the viewer for browsers, if `scripts/web.sh` has built it into `target/web`.

use std::{env, error::Error, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?);
    println!("cargo::rerun-if-env-changed=CARGO_TARGET_DIR");
    let target =
        env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), |folder| root.join(folder));
    let [module, worker] = ["viewer.wasm.gz", "worker.js"].map(|name| target.join("web").join(name));
    // Also where there is none yet.
    for file in [&module, &worker] {
        println!("cargo::rerun-if-changed={}", file.display());
    }
    let found = match module.is_file() && worker.is_file() {
        true => format!("Some((include_bytes!({module:?}), include_str!({worker:?})))"),
        false => "None".to_owned(),
    };
    let text = format!("/// The module and the script.\nconst ASSETS: Option<(&[u8], &str)> = {found};\n");
    fs::write(out.join("viewer_assets.rs"), text)?;
    Ok(())
}
