//! What a directory and a zip archive have in common: a list of files and a way to read each.

use std::io::{self, Read};

use super::error::{IngestErrorKind, Result};

/// Where the bytes of a file come from.
pub(super) trait FileSource: Sync {
    /// Shows a file's bytes to `visit`. `index` is as in [`Listing::files`].
    fn open(&self, index: usize, visit: &mut dyn FnMut(&mut dyn Read)) -> Result<()>;

    /// The error for a failure to read them.
    fn read_error(&self, error: io::Error) -> IngestErrorKind;
}

/// The encoding of names beyond ASCII.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NameEncoding {
    /// UTF-8.
    Utf8,
    /// Read as UTF-8, which is not said to be it: names of a local code page may be valid UTF-8 too.
    Unknown,
    /// A local code page, so letters are not those of the tables.
    CodePage,
}

/// The files of a source.
pub(super) struct Listing {
    /// Name as the source has it, size in bytes.
    pub(super) files: Vec<(String, u64)>,
    /// Links and other special files that are not read, with the kind of each.
    pub(super) special: Vec<(String, &'static str)>,
    /// How sure it is that names are those of the tables.
    pub(super) names: NameEncoding,
    /// Entries that no dataset could name, such as those that are not UTF-8 text.
    pub(super) skipped: usize,
    /// Reads the files.
    pub(super) source: Box<dyn FileSource>,
}
