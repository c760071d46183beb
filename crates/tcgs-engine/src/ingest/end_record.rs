//! Presents a zip file to the `zip` crate with an end record that is rebuilt from checked values.
//!
//! The crate trusts the number of entries in the end record when it builds its index, and searches further back for other records if
//! one leads nowhere. Here that number is checked first, and no other record is left to find.

use std::io::{self, Read, Seek, SeekFrom};

use super::{
    deadline::Deadline,
    error::{IngestErrorKind, Result},
    limits::Limits,
};

const END: [u8; 4] = *b"PK\x05\x06";
const END_BYTES: usize = 22;
const LOCATOR: [u8; 4] = *b"PK\x06\x07";
const LOCATOR_BYTES: usize = 20;
const END_64: [u8; 4] = *b"PK\x06\x06";
const END_64_BYTES: usize = 56;

/// The end record starts within this many bytes of the end: its own and the longest comment.
const TAIL: u64 = END_BYTES as u64 + u16::MAX as u64;

/// Where the central directory is and how many entries it lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Directory {
    /// Bytes before the first entry, such as the program of a self-extracting archive.
    pub(super) shift: u64,
    /// First byte, as the archive states it: without the shift.
    offset: u64,
    bytes: u64,
    entries: u64,
}

impl Directory {
    /// Finds the end record of an archive and checks its values.
    ///
    /// # Errors
    /// [`IngestErrorKind::CorruptArchive`] without a usable record, [`IngestErrorKind::TooManyEntries`], [`IngestErrorKind::DirectoryTooLarge`], or a fault of
    /// reading.
    pub(super) fn find(file: &mut (impl Read + Seek), limits: &Limits) -> Result<Self> {
        let length = file.seek(SeekFrom::End(0))?;
        let tail_at = length.saturating_sub(TAIL);
        let tail = bytes_at(file, tail_at, (length - tail_at) as usize)?;
        let at = end_record(&tail).ok_or_else(|| corrupt("it has no end record"))?;
        let record: &[u8; END_BYTES] =
            tail[at..].first_chunk().ok_or_else(|| corrupt("it has no end record"))?;
        let (record_at, field) = (tail_at + at as u64, Fields(record));
        if field.u16(4) != field.u16(6) || field.u16(8) != field.u16(10) {
            return Err(corrupt("it is one part of several"));
        }
        let (entries, bytes, offset) =
            (u64::from(field.u16(10)), u64::from(field.u32(12)), u64::from(field.u32(16)));
        let needs_64 = entries == 0xffff || bytes == 0xffff_ffff || offset == 0xffff_ffff;
        let found = match needs_64.then(|| Self::end_64(file, record_at)).transpose()?.flatten() {
            Some(found) => found,
            None => Self::before(record_at, offset, bytes, entries)?,
        };
        if found.entries > limits.entries as u64 {
            return Err(IngestErrorKind::TooManyEntries { limit: limits.entries });
        }
        if found.bytes > limits.directory_bytes {
            return Err(IngestErrorKind::DirectoryTooLarge {
                bytes: found.bytes,
                limit: limits.directory_bytes,
            });
        }
        Ok(found)
    }

    /// The directory of the Zip64 end record, if there is one before the end record at `end`.
    fn end_64(file: &mut (impl Read + Seek), end: u64) -> Result<Option<Self>> {
        let Some(locator_at) = end.checked_sub(LOCATOR_BYTES as u64) else { return Ok(None) };
        let locator = bytes_at(file, locator_at, LOCATOR_BYTES)?;
        if !locator.starts_with(&LOCATOR) {
            return Ok(None);
        }
        // Directly before its locator, even if data was prepended to the archive; or, if it has extensible data, at the locator's offset.
        let last = locator_at.checked_sub(END_64_BYTES as u64);
        let last = last.ok_or_else(|| corrupt("its Zip64 end record is missing"))?;
        for record_at in [last, Fields(&locator).u64(8).min(last)] {
            let record = bytes_at(file, record_at, END_64_BYTES)?;
            if record.starts_with(&END_64) {
                let field = Fields(&record);
                return Self::before(record_at, field.u64(48), field.u64(40), field.u64(32)).map(Some);
            }
        }
        Err(corrupt("its Zip64 end record is missing"))
    }

    fn before(end: u64, offset: u64, bytes: u64, entries: u64) -> Result<Self> {
        let shift = offset.checked_add(bytes).and_then(|stated| end.checked_sub(stated));
        let shift = shift.ok_or_else(|| corrupt("its central directory is not where its end record says"))?;
        Ok(Self { shift, offset, bytes, entries })
    }

    /// The first byte after the central directory.
    fn end(&self) -> u64 {
        self.shift + self.offset + self.bytes
    }

    /// End records with exactly these values.
    fn records(&self) -> Vec<u8> {
        let mut records = Vec::with_capacity(END_64_BYTES + LOCATOR_BYTES + END_BYTES);
        let small = |value: u64, largest: u64| (value < largest).then_some(value);
        let entries = small(self.entries, 0xffff);
        let (bytes, offset) = (small(self.bytes, 0xffff_ffff), small(self.offset, 0xffff_ffff));
        if entries.is_none() || bytes.is_none() || offset.is_none() {
            records.extend(END_64);
            records.extend((END_64_BYTES as u64 - 12).to_le_bytes());
            records.extend([45, 0, 45, 0]);
            records.extend([0; 8]);
            for value in [self.entries, self.entries, self.bytes, self.offset] {
                records.extend(value.to_le_bytes());
            }
            records.extend(LOCATOR);
            records.extend([0; 4]);
            records.extend((self.offset + self.bytes).to_le_bytes());
            records.extend(1_u32.to_le_bytes());
        }
        records.extend(END);
        records.extend([0; 4]);
        let entries = entries.unwrap_or(0xffff) as u16;
        records.extend(entries.to_le_bytes());
        records.extend(entries.to_le_bytes());
        records.extend((bytes.unwrap_or(0xffff_ffff) as u32).to_le_bytes());
        records.extend((offset.unwrap_or(0xffff_ffff) as u32).to_le_bytes());
        records.extend([0; 2]);
        records
    }
}

/// Where in the last bytes of a file the end record starts: the last one whose comment ends with the file, else the last whose
/// comment does not go beyond it.
fn end_record(tail: &[u8]) -> Option<usize> {
    let ends_at = |at: usize| {
        let length = tail.get(at + END_BYTES - 2..at + END_BYTES)?;
        Some(at + END_BYTES + usize::from(u16::from_le_bytes([length[0], length[1]])))
    };
    let candidates = || (0..tail.len()).rev().filter(|at| tail[*at..].starts_with(&END));
    candidates()
        .find(|at| ends_at(*at) == Some(tail.len()))
        .or_else(|| candidates().find(|at| ends_at(*at).is_some_and(|end| end < tail.len())))
}

fn bytes_at(file: &mut (impl Read + Seek), at: u64, length: usize) -> Result<Vec<u8>> {
    let mut bytes = vec![0; length];
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

fn corrupt(message: &str) -> IngestErrorKind {
    IngestErrorKind::CorruptArchive(message.to_owned())
}

/// Little-endian numbers of a record that is long enough for them.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn array<const N: usize>(&self, at: usize) -> [u8; N] {
        let mut bytes = [0; N];
        bytes.copy_from_slice(&self.0[at..at + N]);
        bytes
    }

    fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes(self.array(at))
    }

    fn u32(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.array(at))
    }

    fn u64(&self, at: usize) -> u64 {
        u64::from_le_bytes(self.array(at))
    }
}

/// The file up to the end of its central directory and the records after it; reading ends at the deadline.
pub(super) struct CheckedArchive<F> {
    file: F,
    /// Bytes that are the file's.
    own: u64,
    records: Vec<u8>,
    at: u64,
    deadline: Deadline,
}

impl<F: Read + Seek> CheckedArchive<F> {
    /// Of an archive with this directory.
    pub(super) fn new(file: F, directory: &Directory, deadline: Deadline) -> Self {
        Self { file, own: directory.end(), records: directory.records(), at: 0, deadline }
    }
}

impl<F: Read + Seek> Read for CheckedArchive<F> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.deadline.check().map_err(io::Error::other)?;
        let count = if self.at < self.own {
            let max = usize::try_from(self.own - self.at).unwrap_or(usize::MAX).min(into.len());
            self.file.seek(SeekFrom::Start(self.at))?;
            self.file.read(&mut into[..max])?
        } else {
            let from = usize::try_from(self.at - self.own).unwrap_or(usize::MAX).min(self.records.len());
            (&self.records[from..]).read(into)?
        };
        self.at += count as u64;
        Ok(count)
    }
}

impl<F: Read + Seek> Seek for CheckedArchive<F> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let end = self.own + self.records.len() as u64;
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::End(by) => end.checked_add_signed(by),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
        };
        self.at = at.ok_or_else(|| io::Error::from(io::ErrorKind::InvalidInput))?;
        Ok(self.at)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Write as _};

    use proptest::prelude::*;
    use zip::{
        ZipArchive, ZipWriter,
        read::{ArchiveOffset, Config},
        write::SimpleFileOptions,
    };

    use super::*;

    fn archive(names: &[&str]) -> Vec<u8> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        for name in names {
            zip.start_file(*name, SimpleFileOptions::default()).expect("an entry");
            zip.write_all(name.as_bytes()).expect("written");
        }
        zip.finish().expect("an archive").into_inner()
    }

    fn found(bytes: &[u8]) -> Result<Directory> {
        Directory::find(&mut Cursor::new(bytes), &Limits::default())
    }

    fn opened(bytes: &[u8]) -> ZipArchive<CheckedArchive<Cursor<Vec<u8>>>> {
        index(bytes.to_vec(), &found(bytes).expect("a directory")).expect("an archive")
    }

    fn index(
        bytes: Vec<u8>,
        directory: &Directory,
    ) -> zip::result::ZipResult<ZipArchive<CheckedArchive<Cursor<Vec<u8>>>>> {
        let config = Config { archive_offset: ArchiveOffset::Known(directory.shift) };
        ZipArchive::with_config(config, CheckedArchive::new(Cursor::new(bytes), directory, Deadline::NONE))
    }

    /// The archive with the records of a large one, as writers make them beyond 65 534 entries or 4 GiB.
    fn as_zip64(bytes: &[u8]) -> Vec<u8> {
        let directory = found(bytes).expect("a directory");
        let mut large = bytes[..directory.end() as usize].to_vec();
        let records_at = large.len() as u64;
        large.extend(END_64);
        large.extend(44_u64.to_le_bytes());
        large.extend([45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        for value in [directory.entries, directory.entries, directory.bytes, directory.offset] {
            large.extend(value.to_le_bytes());
        }
        large.extend(LOCATOR);
        large.extend([0; 4]);
        large.extend(records_at.to_le_bytes());
        large.extend([1, 0, 0, 0]);
        large.extend(END);
        large.extend([0, 0, 0, 0]);
        large.extend([0xff; 12]);
        large.extend([0, 0]);
        large
    }

    #[test]
    fn archives_of_all_kinds_are_read_as_before() {
        let plain = archive(&["a", "b/c"]);
        let commented = {
            let mut bytes = plain.clone();
            let at = bytes.len() - 2;
            // A comment that looks like an end record of very many entries.
            let comment = [&END[..], &[0; 4], &[0xff; 12], &[0, 0]].concat();
            bytes[at..].copy_from_slice(&(comment.len() as u16 + 3).to_le_bytes());
            bytes.extend(comment);
            bytes.extend(b"end");
            bytes
        };
        let shifted = [b"#!/bin/sh\n".as_slice(), &plain].concat();
        let large = as_zip64(&plain);
        // With eight bytes of extensible data in the record.
        let extended = {
            let at = large.len() - END_BYTES - LOCATOR_BYTES;
            let mut bytes = [&large[..at], &[0; 8], &large[at..]].concat();
            bytes[at - END_64_BYTES + 4] += 8;
            bytes
        };
        let littered = [&plain[..], b"litter"].concat();
        for bytes in [plain.clone(), commented, shifted, large, extended, littered] {
            let mut zip = opened(&bytes);
            assert_eq!(zip.len(), 2);
            let mut text = String::new();
            zip.by_index(1).expect("an entry").read_to_string(&mut text).expect("text");
            assert_eq!(text, "b/c");
        }
        assert_eq!(opened(&archive(&[])).len(), 0);
    }

    #[test]
    fn large_archives_are_seen_with_the_records_of_large_ones() {
        for (entries, offset) in [(70_000, 1 << 20), (3, 5 << 30)] {
            let directory = Directory { shift: 0, offset, bytes: 200, entries };
            let records = directory.records();
            assert_eq!(records.len(), END_64_BYTES + LOCATOR_BYTES + END_BYTES);
            let field = Fields(&records);
            assert_eq!((field.u64(32), field.u64(40), field.u64(48)), (entries, 200, offset));
            assert_eq!(field.u64(END_64_BYTES + 8), offset + 200);
        }
    }

    #[test]
    fn what_the_end_record_claims_is_judged_before_anything_is_read() {
        let plain = archive(&["a", "b/c"]);
        let end = plain.len() - END_BYTES;
        let claiming = |at: usize, value: &[u8]| {
            let mut bytes = plain.clone();
            bytes[end + at..end + at + value.len()].copy_from_slice(value);
            found(&bytes)
        };
        let few = Limits { entries: 1, ..Limits::default() };
        let error = Directory::find(&mut Cursor::new(&plain), &few);
        assert!(matches!(error, Err(IngestErrorKind::TooManyEntries { limit: 1 })), "{error:?}");
        let small = Limits { directory_bytes: 10, ..Limits::default() };
        let error = Directory::find(&mut Cursor::new(&plain), &small);
        assert!(matches!(error, Err(IngestErrorKind::DirectoryTooLarge { limit: 10, .. })), "{error:?}");
        assert!(matches!(claiming(12, &[0xfe; 4]), Err(IngestErrorKind::CorruptArchive(_))));
        assert!(matches!(claiming(10, &[1, 0]), Err(IngestErrorKind::CorruptArchive(_))));
        let mut large = as_zip64(&plain);
        let at = large.len() - END_BYTES - LOCATOR_BYTES - END_64_BYTES;
        large[at + 32..at + 40].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(matches!(found(&large), Err(IngestErrorKind::TooManyEntries { .. })));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_with_an_end_record_never_panic(
            head in proptest::collection::vec(any::<u8>(), 0..200),
            record in proptest::collection::vec(any::<u8>(), 18),
            large in any::<bool>(),
        ) {
            let mut bytes = head;
            if large {
                bytes.extend(END_64);
                bytes.extend(&record);
                bytes.extend([0; END_64_BYTES - 22]);
                bytes.extend(LOCATOR);
                bytes.extend([0; LOCATOR_BYTES - 4]);
            }
            bytes.extend(END);
            bytes.extend(&record[..16]);
            bytes.extend([0, 0]);
            if let Ok(directory) = found(&bytes) {
                prop_assert!(directory.entries <= Limits::default().entries as u64);
                prop_assert!(directory.end() <= bytes.len() as u64);
                let _outcome = index(bytes, &directory).map(|zip| zip.len());
            }
        }
    }
}
