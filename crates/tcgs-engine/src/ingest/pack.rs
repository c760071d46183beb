//! Packs a directory into a zip archive for upload.
//!
//! The bytes depend on names and contents only: the same directory gives the same archive, which the service then stores once.

use std::{
    fs::File,
    io::{self, BufWriter, Seek, Write},
    path::Path,
};

use thiserror::Error;
use zip::{CompressionMethod, ZipWriter, result::ZipError, write::SimpleFileOptions};

use super::{IngestError, Limits, folder, names::is_os_metadata};
use crate::domain::{Problem, ProblemType};

/// Files whose own format has no room left.
const PACKED: [&str; 5] = ["jpg", "jpeg", "png", "webp", "zip"];

/// Why a folder is not packed.
#[derive(Debug, Error)]
pub enum PackError {
    /// The folder cannot be read, or has more files than a dataset may have.
    #[error(transparent)]
    Folder(#[from] IngestError),
    /// Nothing that a dataset could have.
    #[error("there are no files in it that a dataset could have")]
    Empty,
    /// A file cannot be read.
    #[error("{error}")]
    Unreadable {
        /// Its name below the folder.
        file: String,
        /// The cause.
        #[source]
        error: io::Error,
    },
    /// The archive cannot be written.
    #[error("the archive of the dataset cannot be written: {0}")]
    Unwritable(#[source] ZipError),
}

impl From<PackError> for Problem {
    fn from(error: PackError) -> Self {
        let detail = error.to_string();
        match error {
            PackError::Folder(error) => error.into(),
            PackError::Empty => Problem::new(ProblemType::InvalidDataset, detail),
            PackError::Unreadable { file, .. } => {
                Problem::new(ProblemType::UnreadableInput, detail).in_file(&file)
            }
            PackError::Unwritable(_) => Problem::new(ProblemType::UnwritableOutput, detail),
        }
    }
}

/// Writes the regular files under `folder` into `archive`; hidden ones, links and litter stay behind.
///
/// # Errors
/// A folder of more files than a dataset may have, or of none; what cannot be read; an archive that cannot be written.
pub fn pack(folder: &Path, archive: &mut (impl Write + Seek)) -> Result<(), PackError> {
    let listing = folder::list(folder, &Limits::default())?;
    let mut names: Vec<&str> = listing.files.iter().map(|(name, _)| &**name).collect();
    names.retain(|name| !is_os_metadata(name) && !name.split('/').any(|part| part.starts_with('.')));
    names.sort_unstable();
    if names.is_empty() {
        return Err(PackError::Empty);
    }
    let mut zip = ZipWriter::new(BufWriter::new(archive));
    for name in names {
        let unreadable = |error| PackError::Unreadable { file: name.to_owned(), error };
        let mut file = File::open(folder.join(name)).map_err(unreadable)?;
        let length = file.metadata().map_err(unreadable)?.len();
        zip.start_file(name, options(name, length)).map_err(PackError::Unwritable)?;
        io::copy(&mut file, &mut zip).map_err(unwritable)?;
    }
    zip.finish().map_err(PackError::Unwritable)?.flush().map_err(unwritable)
}

pub(super) fn options(name: &str, length: u64) -> SimpleFileOptions {
    let packed = name
        .rsplit_once('.')
        .is_some_and(|(_, extension)| PACKED.iter().any(|packed| packed.eq_ignore_ascii_case(extension)));
    let method = if packed { CompressionMethod::Stored } else { CompressionMethod::Deflated };
    SimpleFileOptions::default()
        .compression_method(method)
        .last_modified_time(zip::DateTime::default())
        .large_file(length > u64::from(u32::MAX))
}

fn unwritable(error: io::Error) -> PackError {
    PackError::Unwritable(ZipError::Io(error))
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Cursor};

    use super::*;

    #[test]
    fn a_folder_packs_twice_to_the_same_bytes_without_what_is_hidden() {
        let root = tempfile::tempdir().expect("a folder");
        let contents = [
            ("b/two.JPG", "picture"),
            ("one.json", "table"),
            (".git/config", "mine"),
            ("Thumbs.db", "litter"),
        ];
        for (name, content) in contents {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
            fs::write(path, content).expect("writes");
        }
        let packed = || {
            let mut archive = Cursor::new(Vec::new());
            pack(root.path(), &mut archive).expect("packs");
            archive.into_inner()
        };
        let bytes = packed();
        assert!(bytes == packed(), "two runs differ");
        let mut zip = zip::ZipArchive::new(Cursor::new(bytes)).expect("a zip");
        let mut found = Vec::new();
        for index in 0..zip.len() {
            let mut entry = zip.by_index(index).expect("an entry");
            let content = io::read_to_string(&mut entry).expect("text");
            found.push((entry.name().expect("a name").into_owned(), entry.compression(), content));
        }
        let entry = |name: &str, method, content: &str| (name.to_owned(), method, content.to_owned());
        let expected = [
            entry("b/two.JPG", CompressionMethod::Stored, "picture"),
            entry("one.json", CompressionMethod::Deflated, "table"),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_full_disk_is_known_as_the_cause() {
        struct Full;
        impl Write for Full {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::ErrorKind::StorageFull.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        impl Seek for Full {
            fn seek(&mut self, _: io::SeekFrom) -> io::Result<u64> {
                Ok(0)
            }
        }
        let root = tempfile::tempdir().expect("a folder");
        fs::write(root.path().join("a.png"), [7; 1 << 17]).expect("writes");
        let error = pack(root.path(), &mut Full).expect_err("no room");
        assert!(crate::domain::is_no_space(&error), "{error:?}");
        assert_eq!(Problem::from(error).status, 507);
    }

    #[test]
    fn a_folder_of_nothing_is_refused() {
        let root = tempfile::tempdir().expect("a folder");
        let error = pack(root.path(), &mut Cursor::new(Vec::new())).expect_err("nothing to send");
        let error = Problem::from(error);
        assert_eq!(error.status, 422);
        let missing = root.path().join("missing");
        let error = Problem::from(pack(&missing, &mut Cursor::new(Vec::new())).expect_err("no folder"));
        assert_eq!((error.status, error.file), (500, None), "the folder's own name is the caller's to add");
    }
}
