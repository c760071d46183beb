//! Figures of fixed runs as they were recorded, so that a loss of quality or a larger file is seen as soon as it is there.
//!
//! They are of lavapipe (Mesa 25.0, LLVM 15, x86-64); `cargo test -- --nocapture` prints what a run finds. Other versions and
//! machines round otherwise, for which the bounds have room; other adapters have more.

use tcgs::gpu::AdapterChoice;

use super::gpu;

/// Bounds on a PSNR in dB and on bytes as a share of the recorded ones.
fn bounds() -> (f64, f64) {
    if gpu::choice() == AdapterChoice::Lavapipe { (0.3, 0.05) } else { (1.0, 0.15) }
}

/// Asserts a PSNR in dB.
#[track_caller]
pub fn assert_psnr(what: &str, found: f64, recorded: f64) {
    assert_psnr_within(what, found, recorded, bounds().0);
}

/// The same for runs that rounding alone moves by more: in the small scene of blobs, that another unit of length only rounds
/// otherwise, single runs of 120 steps differ by up to 1 dB.
#[track_caller]
pub fn assert_psnr_within(what: &str, found: f64, recorded: f64, bound: f64) {
    println!("{what}: {found:.2} dB, recorded {recorded:.2}");
    assert!((found - recorded).abs() <= bound, "{what}: {found:.2} dB, and not {recorded:.2}");
}

/// Asserts an SSIM.
#[track_caller]
pub fn assert_ssim(what: &str, found: f64, recorded: f64) {
    println!("{what}: SSIM {found:.3}, recorded {recorded:.3}");
    assert!((found - recorded).abs() <= bounds().0 / 15.0, "{what}: SSIM {found:.3}, and not {recorded:.3}");
}

/// Asserts a number of bytes.
#[track_caller]
pub fn assert_bytes(what: &str, found: u64, recorded: u64) {
    println!("{what}: {found} bytes, recorded {recorded}");
    let off = found.abs_diff(recorded) as f64 / recorded as f64;
    assert!(off <= bounds().1, "{what}: {found} bytes, and not {recorded}");
}
