//! What decides how a dataset is read, besides the dataset.

use super::choice::named_choice;

named_choice! {
    /// Whether photographs are turned as the EXIF orientation in them says.
    pub enum ExifOrientation {
        /// Where the cameras are those of the turned pixels.
        Auto = "auto",
        /// Always.
        Apply = "apply",
        /// Never.
        Ignore = "ignore",
    }
}

/// How a dataset is read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadOptions {
    /// Whether photographs are turned as their EXIF orientation says.
    pub exif_orientation: ExifOrientation,
    /// Whether listed photographs that are missing are left out, rather than the dataset refused.
    pub skip_missing: bool,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { exif_orientation: ExifOrientation::Auto, skip_missing: false }
    }
}
