//! The viewer's WebAssembly module and the script of its worker, which `scripts/web.sh` builds before the service is compiled.

use std::io::{self, Read as _};

use flate2::read::GzDecoder;

include!(concat!(env!("OUT_DIR"), "/viewer_assets.rs"));

/// The module, compressed by gzip, and its script.
#[derive(Debug, Clone, Copy)]
pub struct Assets {
    /// Decodes and draws.
    pub module: &'static [u8],
    /// Starts the module in a worker.
    pub worker: &'static str,
}

impl Assets {
    /// The module without compression.
    ///
    /// # Errors
    /// The embedded bytes are damaged.
    pub fn unpacked(self) -> io::Result<Vec<u8>> {
        let mut plain = Vec::new();
        GzDecoder::new(self.module).read_to_end(&mut plain)?;
        Ok(plain)
    }
}

/// What this program was built with; none if there was no compiler for WebAssembly.
#[must_use]
pub fn assets() -> Option<Assets> {
    ASSETS.map(|(module, worker)| Assets { module, worker })
}
