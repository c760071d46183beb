//! The files of a dataset by name, from a directory or a zip archive, read within limits.
//!
//! Names are safe relative paths ([`safe_name`]). Nothing is ever written. Every file that is read whole is
//! remembered with the digest of its content, so the dataset's digest covers exactly what was used and is the
//! same for a directory and for a zip of it.

use std::{
    collections::BTreeMap,
    fs,
    path::Path,
    sync::{Mutex, PoisonError},
};

use sha2::{Digest as _, Sha256};

use super::{
    archive,
    error::{Error, Fault},
    folder,
    limits::Limits,
    names::{is_litter, safe_name},
};
use crate::domain::Digest;

/// Where the bytes of a file come from.
pub(super) trait Source: Sync {
    /// The first `limit` bytes of a file (all of it, if it has fewer). `index` is as in [`Listing::files`].
    fn read(&self, index: usize, limit: u64) -> Result<Vec<u8>, Fault>;
}

/// What a source found when it was opened.
pub(super) struct Listing {
    /// Name as the source has it, size in bytes.
    pub(super) files: Vec<(String, u64)>,
    /// Links and other special files that are not read, with the kind of each.
    pub(super) special: Vec<(String, &'static str)>,
    /// Reads the files.
    pub(super) source: Box<dyn Source>,
}

/// The readable files of a dataset.
pub(super) struct Tree {
    files: BTreeMap<String, Entry>,
    special: BTreeMap<String, &'static str>,
    source: Box<dyn Source>,
    limits: Limits,
    used: Mutex<BTreeMap<String, (u64, [u8; 32])>>,
}

struct Entry {
    index: usize,
    size: u64,
}

impl Tree {
    /// Opens a directory or a zip archive, told apart by what `path` is.
    ///
    /// # Errors
    /// Faults of the path, of the archive's structure and of its limits.
    pub(super) fn open(path: &Path, limits: &Limits) -> Result<Self, Error> {
        let metadata = fs::metadata(path).map_err(|error| {
            let fault =
                if error.kind() == std::io::ErrorKind::NotFound { Fault::NotFound } else { error.into() };
            fault.at(path.display().to_string())
        })?;
        let listing =
            if metadata.is_dir() { folder::list(path, limits)? } else { archive::list(path, limits)? };
        Self::new(listing, *limits)
    }

    fn new(listing: Listing, limits: Limits) -> Result<Self, Error> {
        let mut files = BTreeMap::new();
        for (index, (name, size)) in listing.files.into_iter().enumerate() {
            let safe = safe_name(&name).map_err(|fault| fault.at(name.clone()))?.to_owned();
            if is_litter(&safe) {
                continue;
            }
            if files.insert(safe, Entry { index, size }).is_some() {
                return Err(Fault::DuplicateEntry.at(name));
            }
        }
        let special = listing.special.into_iter().collect();
        Ok(Self { files, special, source: listing.source, limits, used: Mutex::default() })
    }

    /// Takes the only top-level folder as the root, if there is exactly one and no file beside it.
    /// Returns whether it did.
    pub(super) fn enter_only_folder(&mut self) -> bool {
        let Some(folder) = self
            .files
            .keys()
            .next()
            .and_then(|name| name.split_once('/'))
            .map(|(folder, _)| format!("{folder}/"))
        else {
            return false;
        };
        if !self.files.keys().all(|name| name.starts_with(&folder)) {
            return false;
        }
        let strip = |name: String| name.strip_prefix(&folder).map(str::to_owned);
        self.files = std::mem::take(&mut self.files)
            .into_iter()
            .filter_map(|(name, entry)| Some((strip(name)?, entry)))
            .collect();
        self.special = std::mem::take(&mut self.special)
            .into_iter()
            .filter_map(|(name, kind)| Some((strip(name)?, kind)))
            .collect();
        true
    }

    /// Whether there is a file of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.files.contains_key(name)
    }

    /// Bytes of a file as the source states them; 0 if there is none.
    pub(super) fn size(&self, name: &str) -> u64 {
        self.files.get(name).map_or(0, |entry| entry.size)
    }

    /// All names, in order.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.files.keys().map(String::as_str)
    }

    /// The kind of special file (such as a symbolic link) that `name` is or lies behind, with its name.
    pub(super) fn special_on_the_way(&self, name: &str) -> Option<Error> {
        self.special
            .iter()
            .find(|(special, _)| {
                name.strip_prefix(special.as_str())
                    .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
            })
            .map(|(special, kind)| Fault::NotARegularFile(kind).at(special))
    }

    /// The whole content of a file. It counts as used.
    ///
    /// # Errors
    /// [`Fault::MissingFile`], [`Fault::NotARegularFile`], [`Fault::FileTooLarge`] or a fault of the source.
    pub(super) fn read(&self, name: &str) -> Result<Vec<u8>, Error> {
        let limit = self.limits.file_bytes;
        let bytes = self.read_up_to(name, limit.saturating_add(1))?;
        if bytes.len() as u64 > limit {
            return Err(Fault::FileTooLarge { bytes: bytes.len() as u64, limit }.at(name));
        }
        let content = Sha256::digest(&bytes).into();
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.insert(name.to_owned(), (bytes.len() as u64, content));
        Ok(bytes)
    }

    /// The first `limit` bytes of a file. It does not count as used.
    ///
    /// # Errors
    /// As [`Tree::read`].
    pub(super) fn read_up_to(&self, name: &str, limit: u64) -> Result<Vec<u8>, Error> {
        let Some(entry) = self.files.get(name) else {
            return Err(self.special_on_the_way(name).unwrap_or_else(|| {
                Fault::MissingFile("it is named by another file of the dataset").at(name)
            }));
        };
        let largest = self.limits.file_bytes;
        if entry.size > largest {
            return Err(Fault::FileTooLarge { bytes: entry.size, limit: largest }.at(name));
        }
        self.source.read(entry.index, limit).map_err(|fault| fault.at(name))
    }

    /// SHA-256 over (length of the name, name, length of the content, SHA-256 of the content) of every used file
    /// in the order of names; lengths are 64-bit little-endian.
    pub(super) fn digest(&self) -> Digest {
        let mut hash = Sha256::new();
        for (name, (length, content)) in &*self.used.lock().unwrap_or_else(PoisonError::into_inner) {
            hash.update((name.len() as u64).to_le_bytes());
            hash.update(name);
            hash.update(length.to_le_bytes());
            hash.update(content);
        }
        Digest::from_bytes(hash.finalize().into())
    }
}
