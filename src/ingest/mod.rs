//! Zip archive or directory in, checked [`Dataset`] out.

use std::path::Path;

use crate::domain::{Dataset, Problem};

/// Reads a dataset from a directory or a zip file, told apart by what `path` is.
///
/// # Errors
/// A [`Problem`] with status 422 (or 400/413) naming the file and the fault.
pub fn load(path: &Path) -> Result<Dataset, Problem> {
    Err(Problem::new(501, "not-built", "Not built", format!("reading {} is not built", path.display())))
}

/// Checks the structure of a zip without decoding pixels: layout, poses, cameras, presence and sizes of images.
///
/// # Errors
/// As [`load`].
pub fn check(path: &Path) -> Result<(), Problem> {
    load(path).map(|_| ())
}
