//! The files of a dataset by name, from a directory or a zip archive, read within limits.
//!
//! Names are safe relative paths ([`safe_name`]). Nothing is written. The digest of every file that is read to its end is kept, so the
//! dataset's digest covers exactly the files that were used and is the same for a directory and for a zip of it. Tables are parsed as a
//! stream, so their length costs time and not memory.

use std::{
    borrow::Cow,
    collections::{BTreeMap, BTreeSet},
    fs,
    io::{self, BufRead, BufReader, Read},
    path::Path,
    sync::{Mutex, PoisonError},
};

use sha2::{Digest as _, Sha256};

use super::{
    archive,
    deadline::Deadline,
    disk_faults::DiskFaults,
    error::{IngestError, IngestErrorKind, Result},
    folder,
    limits::Limits,
    names::{is_os_metadata, normalized, safe_name},
    points::Points,
    source::{FileSource, Listing, NameEncoding},
    video,
};
use crate::domain::Digest;

/// Buffer for reading a table.
const BUFFER_BYTES: usize = 64 << 10;

/// Ending of tables that are not text.
const BINARY_TABLE: &str = ".bin";

/// What some programs put before UTF-8 text.
const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// The same of UTF-16, in both byte orders.
const UTF_16_MARKS: [&[u8]; 2] = [b"\xff\xfe", b"\xfe\xff"];

/// Why a dataset is read.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    /// To check it; points are counted and not kept.
    Check(Deadline),
    /// To train on it.
    Load,
}

/// The readable files of a dataset.
pub(super) struct Tree {
    files: BTreeMap<String, Entry>,
    /// Names of files outside of the root.
    outside: Vec<String>,
    /// Names by their normal form, of those that are in another.
    by_normal_form: BTreeMap<String, String>,
    special: BTreeMap<String, &'static str>,
    names: NameEncoding,
    skipped: usize,
    source: Box<dyn FileSource>,
    limits: Limits,
    purpose: Purpose,
    faults: DiskFaults,
    used: Mutex<BTreeMap<String, (u64, [u8; 32])>>,
}

struct Entry {
    index: usize,
    size: u64,
}

/// The innermost folder that `folder`, which ends in a slash, and a file share.
fn around<'a>(folder: &'a str, file: &str) -> &'a str {
    let shared = folder.bytes().zip(file.bytes()).take_while(|(a, b)| a == b).count();
    &folder[..folder.as_bytes()[..shared].iter().rposition(|byte| *byte == b'/').map_or(0, |slash| slash + 1)]
}

impl Tree {
    /// Opens a directory, a zip archive or a video, whichever `path` is.
    ///
    /// # Errors
    /// Those of the path, of the archive's structure and of its limits.
    pub(super) fn open(purpose: Purpose, path: &Path, limits: &Limits) -> Result<Self, IngestError> {
        let metadata = fs::metadata(path).map_err(|error| {
            if error.kind() == io::ErrorKind::NotFound { IngestErrorKind::NotFound } else { error.into() }
        })?;
        let faults = DiskFaults::default();
        let listing = if metadata.is_dir() {
            folder::list(path, limits)?
        } else if let Some(name) = video::name_of(path) {
            folder::single(path, name)?
        } else {
            archive::list(path, limits, purpose.deadline(), &faults).map_err(|error| faults.or(error))?
        };
        Self::new(listing, *limits, purpose, faults)
    }

    fn new(
        mut listing: Listing,
        limits: Limits,
        purpose: Purpose,
        faults: DiskFaults,
    ) -> Result<Self, IngestError> {
        let mut files = BTreeMap::new();
        for (index, (name, size)) in std::mem::take(&mut listing.files).into_iter().enumerate() {
            let safe = safe_name(&name).map_err(|error| error.at(name.clone()))?.to_owned();
            if is_os_metadata(&safe) {
                continue;
            }
            if files.insert(safe, Entry { index, size }).is_some() {
                return Err(IngestErrorKind::DuplicateEntry.at(name));
            }
        }
        let Listing { special, names, skipped, source, .. } = listing;
        Ok(Self {
            by_normal_form: by_normal_form(&files),
            files,
            outside: Vec::new(),
            special: special.into_iter().collect(),
            names,
            skipped,
            source,
            limits,
            purpose,
            faults,
            used: Mutex::default(),
        })
    }

    /// What the disk of an archive does.
    pub(super) fn disk_faults(&self) -> DiskFaults {
        self.faults.clone()
    }

    /// An empty cloud of points, which keeps them if the dataset is loaded.
    pub(super) fn points(&self) -> Points {
        Points::new(matches!(self.purpose, Purpose::Load), self.limits.points)
    }

    /// Limits of the dataset.
    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Whether there is time left.
    ///
    /// # Errors
    /// [`IngestErrorKind::CheckTimeout`].
    pub(super) fn check_time(&self) -> Result<()> {
        self.purpose.deadline().check()
    }

    /// Takes a folder, which ends in a slash, as the root. If it has no images, those of the nearest folder around it that has any are
    /// taken as if they were in it, by their paths from there. Returns that folder, with a slash at its end; empty for the top.
    pub(super) fn enter(&mut self, folder: &str, is_image: fn(&str) -> bool) -> Option<String> {
        let (mut inside, mut outside) = (BTreeMap::new(), BTreeMap::new());
        for (name, entry) in std::mem::take(&mut self.files) {
            match name.strip_prefix(folder) {
                Some(rest) => _ = inside.insert(rest.to_owned(), entry),
                None => _ = outside.insert(name, entry),
            }
        }
        let mut images_of = None;
        if !inside.keys().any(|name| is_image(name)) {
            let around = |name: &str| around(folder, name).len();
            let images = outside.keys().filter(|name| is_image(name));
            let nearest = images.map(|name| around(name)).max();
            if let Some(nearest) = nearest {
                let is_taken = |name: &String, _: &mut Entry| is_image(name) && around(name) == nearest;
                let taken = outside.extract_if(.., is_taken);
                inside.extend(taken.map(|(name, entry)| (name[nearest..].to_owned(), entry)));
                images_of = Some(folder[..nearest].to_owned());
            }
        }
        self.files = inside;
        self.special = std::mem::take(&mut self.special)
            .into_iter()
            .filter_map(|(name, kind)| Some((name.strip_prefix(folder)?.to_owned(), kind)))
            .collect();
        self.by_normal_form = by_normal_form(&self.files);
        self.outside = outside.into_keys().collect();
        images_of
    }

    /// Names of files that are not in the folder that became the root.
    pub(super) fn outside(&self) -> &[String] {
        &self.outside
    }

    /// Whether there is a file of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.files.contains_key(name)
    }

    /// The file that a table means by `name`: that very name, or one that differs in nothing but the form of its Unicode.
    pub(super) fn find(&self, name: &str) -> Option<&str> {
        let exact = |name: &str| self.files.get_key_value(name).map(|(name, _)| name.as_str());
        exact(name).or_else(|| {
            let normal = normalized(name);
            exact(&normal).or_else(|| self.by_normal_form.get(&*normal).map(String::as_str))
        })
    }

    /// The only file whose name differs from `name` in the case of letters alone, or that very one.
    pub(super) fn find_in_any_case(&self, name: &str) -> Option<&str> {
        self.find(name).or_else(|| self.names().find(|found| found.eq_ignore_ascii_case(name)))
    }

    /// The encoding of names beyond ASCII.
    pub(super) fn name_encoding(&self) -> NameEncoding {
        self.names
    }

    /// How many entries of a directory have names that no dataset could state.
    pub(super) fn skipped(&self) -> usize {
        self.skipped
    }

    /// Links and other special files.
    pub(super) fn special(&self) -> impl Iterator<Item = &str> {
        self.special.keys().map(String::as_str)
    }

    /// The files whose content was used so far.
    pub(super) fn used(&self) -> BTreeSet<String> {
        self.used.lock().unwrap_or_else(PoisonError::into_inner).keys().cloned().collect()
    }

    /// Bytes of a file as the source states them; 0 if there is none.
    pub(super) fn size(&self, name: &str) -> u64 {
        self.files.get(name).map_or(0, |entry| entry.size)
    }

    /// All names, in order.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.files.keys().map(String::as_str)
    }

    /// The error for a special file (such as a symbolic link) that `name` is or is behind, if there is one.
    pub(super) fn special_on_path(&self, name: &str) -> Option<IngestError> {
        self.special
            .iter()
            .find(|(special, _)| {
                name.strip_prefix(special.as_str())
                    .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
            })
            .map(|(special, kind)| IngestErrorKind::NotARegularFile(kind).at(special))
    }

    /// The whole content of a file. It counts as used.
    ///
    /// # Errors
    /// [`IngestErrorKind::MissingFile`], [`IngestErrorKind::NotARegularFile`], [`IngestErrorKind::FileTooLarge`] or a fault of the source.
    pub(super) fn read(&self, name: &str) -> Result<Vec<u8>, IngestError> {
        let limit = self.limits.file_bytes;
        let bytes = self.read_up_to(name, limit.saturating_add(1))?;
        let length = bytes.len() as u64;
        if length > limit {
            return Err(IngestErrorKind::FileTooLarge { bytes: length, limit }.at(name));
        }
        // Hashed after reading, since the source may be locked during it.
        self.use_content(name, length, Sha256::digest(&bytes).into());
        Ok(bytes)
    }

    fn use_content(&self, name: &str, length: u64, hash: [u8; 32]) {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.insert(name.to_owned(), (length, hash));
    }

    /// The error of reading a file: `error`, or the timeout if the deadline has passed.
    fn read_failure(&self, name: &str, error: IngestErrorKind) -> IngestError {
        self.check_time().err().unwrap_or(error).at(name)
    }

    /// What `parse` makes of the content of a file of at most `largest` bytes, given with its stated length. All of it is read,
    /// whatever `parse` leaves, and it counts as used.
    ///
    /// # Errors
    /// As [`Tree::read`]; else those of `parse`.
    pub(super) fn parse<T>(
        &self,
        name: &str,
        largest: u64,
        parse: impl FnOnce(&mut dyn BufRead, u64) -> Result<T>,
    ) -> Result<T, IngestError> {
        let (parsed, length, hash) = self.parse_unused(name, largest, parse)?;
        self.use_content(name, length, hash);
        Ok(parsed)
    }

    /// As [`Tree::parse`], but the file does not count as used. Also returns its length and SHA-256.
    ///
    /// # Errors
    /// As [`Tree::parse`].
    pub(super) fn parse_unused<T>(
        &self,
        name: &str,
        largest: u64,
        parse: impl FnOnce(&mut dyn BufRead, u64) -> Result<T>,
    ) -> Result<(T, u64, [u8; 32]), IngestError> {
        let largest = largest.min(self.limits.file_bytes);
        let entry = self.entry(name, largest)?;
        let (mut parse, mut outcome) = (Some(parse), None);
        let visited = self.source.open(entry.index, &mut |file| {
            let Some(parse) = parse.take() else { return };
            let mut content = HashedContent::new(file, largest, self.purpose.deadline());
            let mut reader = BufReader::with_capacity(BUFFER_BYTES, &mut content);
            let parsed = if name.ends_with(BINARY_TABLE) {
                parse(&mut reader, entry.size)
            } else {
                parse_text(&mut reader, entry.size, parse)
            };
            // What ends this early is kept in `content`.
            let _rest = io::copy(&mut content, &mut io::sink());
            let HashedContent { hash, length, end, .. } = content;
            outcome = Some((parsed, end, length, hash.finalize().into()));
        });
        visited.map_err(|error| self.read_failure(name, error))?;
        let Some((parsed, end, length, hash)) = outcome else {
            return Err(IngestErrorKind::MissingFile("it cannot be opened").at(name));
        };
        // What broke off reading also breaks whatever was made of it, so it goes first.
        match end {
            Some(End::Refused(error)) => return Err(error.at(name)),
            Some(End::Source(error)) => return Err(self.read_failure(name, self.source.read_error(error))),
            None => {}
        }
        Ok((parsed.map_err(|error| error.at(name))?, length, hash))
    }

    /// The first `limit` bytes of a file. It does not count as used.
    ///
    /// # Errors
    /// As [`Tree::read`].
    pub(super) fn read_up_to(&self, name: &str, limit: u64) -> Result<Vec<u8>, IngestError> {
        let entry = self.entry(name, self.limits.file_bytes)?;
        let mut outcome = Ok(Vec::new());
        let visited = self.source.open(entry.index, &mut |file| {
            let mut bytes = Vec::new();
            outcome = file.take(limit).read_to_end(&mut bytes).map(|_| bytes);
        });
        visited.map_err(|error| self.read_failure(name, error))?;
        outcome.map_err(|error| self.read_failure(name, self.source.read_error(error)))
    }

    fn entry(&self, name: &str, largest: u64) -> Result<&Entry, IngestError> {
        let Some(entry) = self.files.get(name) else {
            return Err(self.special_on_path(name).unwrap_or_else(|| {
                IngestErrorKind::MissingFile("it is named by another file of the dataset").at(name)
            }));
        };
        if entry.size > largest {
            return Err(IngestErrorKind::FileTooLarge { bytes: entry.size, limit: largest }.at(name));
        }
        Ok(entry)
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

fn by_normal_form(files: &BTreeMap<String, Entry>) -> BTreeMap<String, String> {
    let form = |name: &String| match normalized(name) {
        Cow::Owned(normal) => Some((normal, name.clone())),
        Cow::Borrowed(_) => None,
    };
    files.keys().filter_map(form).collect()
}

/// What `parse` makes of a text behind its byte order mark, if it has one.
fn parse_text<T>(
    reader: &mut impl BufRead,
    length: u64,
    parse: impl FnOnce(&mut dyn BufRead, u64) -> Result<T>,
) -> Result<T> {
    let mut head = Vec::with_capacity(BYTE_ORDER_MARK.len());
    reader.by_ref().take(BYTE_ORDER_MARK.len() as u64).read_to_end(&mut head)?;
    if UTF_16_MARKS.iter().any(|mark| head.starts_with(mark)) {
        return Err(IngestErrorKind::Utf16);
    }
    let mark = if head == BYTE_ORDER_MARK { head.len() } else { 0 };
    parse(&mut (&head[mark..]).chain(reader), length.saturating_sub(mark as u64))
}

impl Purpose {
    fn deadline(self) -> Deadline {
        match self {
            Self::Check(deadline) => deadline,
            Self::Load => Deadline::NONE,
        }
    }
}

/// A file's content on its way to a parser: hashed, counted, and ended by the first error.
struct HashedContent<'a> {
    file: &'a mut dyn Read,
    hash: Sha256,
    length: u64,
    largest: u64,
    deadline: Deadline,
    end: Option<End>,
}

/// Why a content was not read to its end.
enum End {
    Source(io::Error),
    Refused(IngestErrorKind),
}

impl<'a> HashedContent<'a> {
    fn new(file: &'a mut dyn Read, largest: u64, deadline: Deadline) -> Self {
        Self { file, hash: Sha256::new(), length: 0, largest, deadline, end: None }
    }

    fn next(&mut self, into: &mut [u8]) -> Result<usize, End> {
        self.deadline.check().map_err(End::Refused)?;
        let count = loop {
            match self.file.read(into) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                read => break read.map_err(End::Source)?,
            }
        };
        self.length += count as u64;
        if self.length > self.largest {
            return Err(End::Refused(IngestErrorKind::FileTooLarge {
                bytes: self.length,
                limit: self.largest,
            }));
        }
        self.hash.update(&into[..count]);
        Ok(count)
    }
}

impl Read for HashedContent<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let ended = || io::Error::other("reading was ended");
        if self.end.is_some() {
            return Err(ended());
        }
        self.next(into).map_err(|end| {
            self.end = Some(end);
            ended()
        })
    }
}
