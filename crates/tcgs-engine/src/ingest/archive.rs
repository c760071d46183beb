//! Reads datasets from zip archives.
//!
//! The end record is checked before the central directory is read, and the whole directory before any entry is opened. Nothing is
//! extracted: entries are read as streams by index, bounded by their stated size.

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek as _},
    path::Path,
    sync::{Mutex, PoisonError},
};

use zip::{
    CompressionMethod, ZipArchive,
    read::{ArchiveOffset, Config},
    result::ZipError,
};

use super::{
    central_directory::{first_repeated_name, has_names_of_unknown_encoding},
    deadline::Deadline,
    disk_faults::{DiskFaults, WatchedFile},
    end_record::{CheckedArchive, Directory},
    error::{IngestError, IngestErrorKind, Result},
    limits::Limits,
    names::{is_os_metadata, portable, safe_name},
    source::{FileSource, Listing, NameEncoding},
};

/// The bits of a Unix mode that tell the kind of file, and its values for plain files and folders.
const KIND_MASK: u32 = 0o170_000;
const KIND_FILE: u32 = 0o100_000;
const KIND_LINK: u32 = 0o120_000;

type Reader = BufReader<CheckedArchive<WatchedFile<File>>>;

struct Archive {
    // One reader for all threads: unpacking is a small part of decoding an image, which happens outside of the lock.
    zip: Mutex<ZipArchive<Reader>>,
    /// Index in the archive of each listed file.
    indices: Vec<usize>,
}

impl FileSource for Archive {
    fn open(&self, index: usize, visit: &mut dyn FnMut(&mut dyn Read)) -> Result<()> {
        let mut zip = self.zip.lock().unwrap_or_else(PoisonError::into_inner);
        let mut entry = zip.by_index(self.indices[index]).map_err(entry_error)?;
        visit(&mut entry);
        Ok(())
    }

    fn read_error(&self, error: io::Error) -> IngestErrorKind {
        IngestErrorKind::CorruptArchive(error.to_string())
    }
}

/// Lists the files of a zip archive.
///
/// # Errors
/// [`IngestErrorKind::NotAZip`], [`IngestErrorKind::CorruptArchive`], and every error that an entry can have: encrypted, unknown
/// compression, special file, duplicate, overlapping, too many, too large, too well compressed.
pub(super) fn list(
    path: &Path,
    limits: &Limits,
    deadline: Deadline,
    faults: &DiskFaults,
) -> Result<Listing, IngestError> {
    // Whatever fails after the deadline fails because of it.
    listed(path, limits, deadline, faults)
        .map_err(|error| deadline.check().err().map_or(error, IngestError::from))
}

fn listed(
    path: &Path,
    limits: &Limits,
    deadline: Deadline,
    faults: &DiskFaults,
) -> Result<Listing, IngestError> {
    let mut file = faults.watch(File::open(path).map_err(IngestErrorKind::Io)?);
    let mut magic = Vec::new();
    file.by_ref().take(2).read_to_end(&mut magic).map_err(IngestErrorKind::Io)?;
    file.rewind().map_err(IngestErrorKind::Io)?;
    let mut zip = index(file, limits, deadline).map_err(|error| match error {
        IngestErrorKind::CorruptArchive(message) if magic == b"PK" => {
            IngestErrorKind::CorruptArchive(format!("{message}; it may have been cut short"))
        }
        IngestErrorKind::CorruptArchive(message) => IngestErrorKind::NotAZip(message),
        other => other,
    })?;
    if zip.has_duplicate_names() {
        return Err(duplicate(path, zip.central_directory_start(), limits));
    }
    if zip.has_overlapping_entries().map_err(entry_error)? {
        return Err(IngestErrorKind::OverlappingEntries.into());
    }

    let mut files = Vec::new();
    let mut indices = Vec::new();
    let mut total: u64 = 0;
    let (mut has_legacy_names, mut is_ascii) = (false, true);
    for index in 0..zip.len() {
        let entry = zip.by_index_raw(index).map_err(entry_error)?;
        // Windows PowerShell 5.1 writes backslashes between folders.
        let name = portable(&entry.name().map_err(entry_error)?).into_owned();
        if is_os_metadata(&name) {
            continue;
        }
        has_legacy_names |= std::str::from_utf8(entry.name_raw()).is_err();
        is_ascii &= entry.name_raw().is_ascii();
        let refuse = |error: IngestErrorKind| Err(error.at(name.clone()));
        if entry.is_dir() || (name.ends_with('/') && entry.size() == 0) {
            // Same rule as for files: no tool writes an unsafe name by accident.
            let folder = name.trim_end_matches('/');
            if folder != "." {
                safe_name(folder).map_err(|error| error.at(name.clone()))?;
            }
            continue;
        }
        match entry.unix_mode().map(|mode| mode & KIND_MASK) {
            None | Some(0 | KIND_FILE) => {}
            Some(KIND_LINK) => return refuse(IngestErrorKind::NotARegularFile("symbolic link")),
            Some(_) => return refuse(IngestErrorKind::NotARegularFile("special file")),
        }
        if entry.encrypted() {
            return refuse(IngestErrorKind::Encrypted);
        }
        let method = entry.compression();
        if !matches!(method, CompressionMethod::Stored | CompressionMethod::Deflated) {
            return refuse(IngestErrorKind::Compression(method.to_string()));
        }
        let size = entry.size();
        total = total.saturating_add(size);
        if total > limits.total_bytes {
            return Err(IngestErrorKind::TooManyBytes { bytes: total, limit: limits.total_bytes }.into());
        }
        let ratio = size / entry.compressed_size().max(1);
        if size > Limits::RATIO_FREE_BYTES && ratio > limits.ratio {
            return refuse(IngestErrorKind::CompressionRatio { ratio, limit: limits.ratio });
        }
        files.push((name, size));
        indices.push(index);
    }
    let names = if has_legacy_names {
        NameEncoding::CodePage
    } else if !is_ascii && are_in_doubt(path, zip.central_directory_start(), limits) {
        NameEncoding::Unknown
    } else {
        NameEncoding::Utf8
    };
    let source = Box::new(Archive { zip: Mutex::new(zip), indices });
    Ok(Listing { files, special: Vec::new(), names, skipped: 0, source })
}

fn index(mut file: WatchedFile<File>, limits: &Limits, deadline: Deadline) -> Result<ZipArchive<Reader>> {
    let directory = Directory::find(&mut file, limits)?;
    let config = Config { archive_offset: ArchiveOffset::Known(directory.shift) };
    ZipArchive::with_config(config, BufReader::new(CheckedArchive::new(file, &directory, deadline)))
        .map_err(|error| IngestErrorKind::CorruptArchive(error.to_string()))
}

fn entry_error(error: ZipError) -> IngestErrorKind {
    match error {
        ZipError::CompressionMethodNotSupported(method) => IngestErrorKind::Compression(method.to_string()),
        ZipError::UnsupportedArchive(ZipError::PASSWORD_REQUIRED) => IngestErrorKind::Encrypted,
        other => IngestErrorKind::CorruptArchive(other.to_string()),
    }
}

/// Whether names are read as UTF-8 and not said to be. A failure to read means no more than a worse message.
fn are_in_doubt(path: &Path, directory: u64, limits: &Limits) -> bool {
    let found = File::open(path).and_then(|mut file| {
        file.seek(io::SeekFrom::Start(directory))?;
        has_names_of_unknown_encoding(BufReader::new(file), limits.entries)
    });
    found.unwrap_or_default()
}

/// Names the entry that is there twice: the file's own name is the sender's or, in a service, a temporary one.
fn duplicate(path: &Path, directory: u64, limits: &Limits) -> IngestError {
    let name = File::open(path).and_then(|mut file| {
        file.seek(io::SeekFrom::Start(directory))?;
        first_repeated_name(BufReader::new(file), limits.entries)
    });
    match name {
        Ok(Some(name)) => IngestErrorKind::DuplicateEntry.at(name),
        Ok(None) => IngestErrorKind::DuplicateEntry.into(),
        Err(error) => IngestErrorKind::Io(error).into(),
    }
}
