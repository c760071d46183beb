//! The shared data next to the repository, for the tests that need it.

use std::path::PathBuf;

use super::{skip::skip, tree::root};

/// The path of `relative` in the shared data, or `None` where there is none: then the test counts as skipped.
#[track_caller]
pub fn shared(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("TCGS_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    skip(&format!("{} is missing; set TCGS_SHARED", path.display()));
    None
}
