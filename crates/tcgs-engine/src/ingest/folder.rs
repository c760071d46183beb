//! Reads datasets from directories. Symbolic links and special files are listed but never followed or opened.

use std::{
    fs::{self, File},
    io::{self, Read},
    path::{Path, PathBuf},
};

use super::{
    error::{IngestError, IngestErrorKind, Result},
    limits::Limits,
    names::safe_name,
    source::{FileSource, Listing, NameEncoding},
};

struct Folder {
    paths: Vec<PathBuf>,
}

impl FileSource for Folder {
    fn open(&self, index: usize, visit: &mut dyn FnMut(&mut dyn Read)) -> Result<()> {
        visit(&mut File::open(&self.paths[index])?);
        Ok(())
    }

    fn read_error(&self, error: io::Error) -> IngestErrorKind {
        IngestErrorKind::Io(error)
    }
}

/// Lists the file at `path` alone, by the name `name`.
///
/// # Errors
/// [`IngestErrorKind::Io`].
pub(super) fn single(path: &Path, name: String) -> Result<Listing> {
    let bytes = fs::metadata(path)?.len();
    Ok(Listing {
        files: vec![(name, bytes)],
        special: Vec::new(),
        names: NameEncoding::Utf8,
        skipped: 0,
        source: Box::new(Folder { paths: vec![path.to_owned()] }),
    })
}

/// Lists all regular files under `root`.
///
/// Names that are not UTF-8, or that no dataset could refer to, are skipped and counted: a directory may contain anything.
///
/// # Errors
/// [`IngestErrorKind::TooManyEntries`], or [`IngestErrorKind::Io`] if a folder cannot be listed.
pub(super) fn list(root: &Path, limits: &Limits) -> Result<Listing, IngestError> {
    let mut files = Vec::new();
    let mut paths = Vec::new();
    let mut special = Vec::new();
    let (mut entries, mut skipped) = (0, 0);
    let mut pending = vec![(root.to_owned(), String::new())];
    while let Some((folder, prefix)) = pending.pop() {
        let unreadable = |error| match prefix.trim_end_matches('/') {
            "" => IngestError::from(IngestErrorKind::Io(error)),
            name => IngestErrorKind::Io(error).at(name),
        };
        for entry in fs::read_dir(&folder).map_err(unreadable)? {
            let entry = entry.map_err(unreadable)?;
            entries += 1;
            if entries > limits.entries {
                return Err(IngestErrorKind::TooManyEntries { limit: limits.entries }.into());
            }
            let file_name = entry.file_name();
            let name = file_name.to_str().map(|name| format!("{prefix}{name}"));
            let Some(name) = name.filter(|name| safe_name(name).is_ok()) else {
                skipped += 1;
                continue;
            };
            let kind = entry.file_type().map_err(unreadable)?;
            if kind.is_dir() {
                pending.push((entry.path(), format!("{name}/")));
            } else if kind.is_file() {
                files.push((name, entry.metadata().map_err(unreadable)?.len()));
                paths.push(entry.path());
            } else {
                special.push((name, if kind.is_symlink() { "symbolic link" } else { "special file" }));
            }
        }
    }
    Ok(Listing { files, special, names: NameEncoding::Utf8, skipped, source: Box::new(Folder { paths }) })
}
