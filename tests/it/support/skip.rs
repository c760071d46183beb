//! Tests that lack what they need: said aloud, counted by `scripts/test.sh`, and a failure in CI.

use std::{env, fs::OpenOptions, io::Write as _, thread};

/// Tells that the running test does not run for want of something that `scripts/setup.sh` or a data set brings; where `CI=true`
/// it fails instead.
#[track_caller]
pub fn skip(reason: &str) {
    assert!(env::var("CI").as_deref() != Ok("true"), "{reason}");
    tell(reason);
}

/// The same for what cannot be had on every machine, CI's included.
pub fn skip_in_ci_too(reason: &str) {
    tell(reason);
}

fn tell(reason: &str) {
    let test = thread::current().name().unwrap_or("a test").to_owned();
    let line = format!("SKIPPED {test}: {reason}\n");
    // `eprintln!` would be captured, since the test passes.
    let _ = std::io::stderr().write_all(line.as_bytes());
    if let Some(path) = env::var_os("TCGS_TEST_SKIPS") {
        let file = OpenOptions::new().create(true).append(true).open(path);
        file.and_then(|mut file| file.write_all(line.as_bytes())).expect("the list of skipped tests");
    }
}
