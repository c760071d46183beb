//! Writes the JavaScript between a page and a WebAssembly module: bindgen MODULE.wasm FOLDER.
//!
//! wasm-bindgen's own program has the same core and more dependencies, which not every registry has.

use std::{env, error::Error, path::PathBuf};

use wasm_bindgen_cli_support::Bindgen;

fn main() -> Result<(), Box<dyn Error>> {
    let mut paths = env::args_os().skip(1).map(PathBuf::from);
    let (Some(module), Some(folder)) = (paths.next(), paths.next()) else {
        return Err("usage: bindgen MODULE.wasm FOLDER".into());
    };
    // Not modules: a page that opens from a disk can start a worker of a script only.
    Bindgen::new().input_path(module).no_modules(true)?.typescript(false).generate(folder)?;
    Ok(())
}
