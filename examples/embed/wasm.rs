//! The decoder as a WebAssembly module without a bindings generator: `decode.mjs` shows the calls.

use std::sync::Mutex;

use serde_json::json;
use tcgs_codec::{self as codec, DecodeLimits, Decoded};

static INPUT: Mutex<Vec<u8>> = Mutex::new(Vec::new());
static DECODED: Mutex<Option<Decoded>> = Mutex::new(None);
static REPORT: Mutex<String> = Mutex::new(String::new());

/// Allocates `size` bytes for a file and returns where to copy it.
#[unsafe(no_mangle)]
pub extern "C" fn input(size: usize) -> *mut u8 {
    let mut input = INPUT.lock().expect("one thread");
    *input = vec![0; size];
    input.as_mut_ptr()
}

/// Decodes the input and returns the length of a JSON report: counts, or `error`.
#[unsafe(no_mangle)]
pub extern "C" fn decode() -> usize {
    let limits = DecodeLimits { max_memory_bytes: 1 << 30, ..DecodeLimits::default() };
    let result = codec::decode(&std::mem::take(&mut *INPUT.lock().expect("one thread")), &limits);
    let report = match &result {
        Ok(Decoded { scene, manifest, decode_sha256 }) => json!({
            "anchors": scene.len(),
            "gaussians": manifest.gaussians,
            "feature_dim": scene.feature_dim,
            "decode_sha256": decode_sha256.to_string(),
        }),
        Err(error) => json!({ "error": error.to_string() }),
    };
    *DECODED.lock().expect("one thread") = result.ok();
    let mut text = REPORT.lock().expect("one thread");
    *text = report.to_string();
    text.len()
}

/// Where the report of the last [`decode`] is.
#[unsafe(no_mangle)]
pub extern "C" fn report() -> *const u8 {
    REPORT.lock().expect("one thread").as_ptr()
}

/// Where the anchor features of the last [`decode`] are: `anchors * feature_dim` floats, or null.
#[unsafe(no_mangle)]
pub extern "C" fn features() -> *const f32 {
    DECODED
        .lock()
        .expect("one thread")
        .as_ref()
        .map_or(std::ptr::null(), |decoded| decoded.scene.features.as_ptr())
}
