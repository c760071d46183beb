//! The outer layer of a file: signature, version, section table, checksums. Knows no section's content.
//!
//! Sections follow the header in table order without gaps, so header and sections tile the file exactly.

use sha2::{Digest as _, Sha256};

use super::{
    bytes::{Reader, Writer},
    error::{DecodeError, Result},
    sections::{self, SectionId},
};
use crate::domain::Digest;

/// First bytes of every file. The high bit, both line ends and the control character show at once that a
/// transfer altered the bytes as text.
pub(super) const MAGIC: [u8; 8] = *b"\x89TCGS\r\n\x1a";

/// Major version of the format. Another is refused; a minor may only add sections, critical ones for files that could not be read
/// rightly without them.
pub(super) const MAJOR: u16 = 1;

/// The integer arithmetic between bytes and symbols (`FORMAT.md`). A file of another profile would decode to something
/// else, and is refused.
pub(super) const ARITHMETIC_PROFILE: u16 = 1;

/// Bytes before the section table.
pub(super) const FIXED_HEADER: usize = 60;

/// Bytes of one entry of the section table.
pub(super) const TABLE_ENTRY: usize = 28;

/// More sections than any version needs.
const MAX_SECTIONS: u16 = 64;

/// Set on a section that a decoder must understand.
const CRITICAL: u32 = 1;

/// Where the whole-file hash stands; the hash leaves out itself and the header's checksum.
const DIGEST_AT: usize = 24;

const CRC_AT: usize = 56;

const HEADER: &str = "header";

/// A section with its place in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Section<'a> {
    pub(super) id: SectionId,
    pub(super) critical: bool,
    pub(super) offset: u64,
    pub(super) bytes: &'a [u8],
}

/// A file whose header, checksums and layout hold.
#[derive(Debug)]
pub(super) struct Container<'a> {
    pub(super) version: (u16, u16),
    pub(super) digest: Digest,
    pub(super) sections: Vec<Section<'a>>,
}

impl<'a> Container<'a> {
    /// Reads and checks everything that does not depend on a section's content.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Self> {
        let _stage = tracing::debug_span!("container").entered();
        let mut reader = Reader::new(HEADER, bytes);
        if !bytes.starts_with(&MAGIC) {
            return Err(DecodeError::NotTcgs);
        }
        reader.take("signature", MAGIC.len() as u64)?;
        let version = (reader.u16("major version")?, reader.u16("minor version")?);
        if version.0 != MAJOR {
            return Err(DecodeError::UnsupportedVersion { major: version.0, minor: version.1, known: MAJOR });
        }
        let count = reader.u16("section count")?;
        let profile = reader.u16("arithmetic profile")?;
        if profile != ARITHMETIC_PROFILE {
            return Err(DecodeError::UnsupportedProfile { profile, known: ARITHMETIC_PROFILE });
        }
        if count > MAX_SECTIONS {
            return Err(reader.malformed("section count", count));
        }
        let stated_length = reader.u64("file length")?;
        let digest = Digest::from_bytes(reader.digest_bytes("file digest")?);
        let stated_crc = reader.u32("header checksum")?;
        let table = reader.take("section table", u64::from(count) * TABLE_ENTRY as u64)?;
        let crc = crc32c::crc32c_append(crc32c::crc32c(&bytes[..CRC_AT]), table);
        if crc != stated_crc {
            return Err(DecodeError::HeaderChecksum { stated: stated_crc, actual: crc });
        }
        if stated_length != bytes.len() as u64 {
            return Err(DecodeError::FileLength { stated: stated_length, actual: bytes.len() as u64 });
        }
        let actual = file_digest(bytes);
        if actual != digest {
            return Err(DecodeError::FileDigest { stated: digest, actual });
        }
        let sections = parse_sections(table, bytes)?;
        Ok(Self { version, digest, sections })
    }

    /// The content of a section that every file has.
    pub(super) fn section(&self, id: SectionId) -> Result<Section<'a>> {
        self.find(id).ok_or(DecodeError::MissingSection { section: sections::name(id) })
    }

    /// A section that a file may have.
    pub(super) fn find(&self, id: SectionId) -> Option<Section<'a>> {
        self.sections.iter().find(|section| section.id == id).copied()
    }

    /// The content of a section that a file must have if it is `needed`, and must not have otherwise.
    pub(super) fn section_if(&self, needed: bool, id: SectionId) -> Result<Option<Section<'a>>> {
        match self.find(id) {
            None if needed => self.section(id).map(Some),
            Some(_) if !needed => Err(DecodeError::NeedlessSection { section: sections::name(id) }),
            found => Ok(found),
        }
    }

    /// Refuses critical sections that are not in `known`.
    pub(super) fn check_known(&self, known: &[SectionId]) -> Result<()> {
        match self.sections.iter().find(|section| section.critical && !known.contains(&section.id)) {
            None => Ok(()),
            Some(section) => Err(DecodeError::UnknownSection { section: id_text(section.id) }),
        }
    }
}

fn parse_sections<'a>(table: &[u8], bytes: &'a [u8]) -> Result<Vec<Section<'a>>> {
    let mut reader = Reader::new(HEADER, table);
    let mut sections: Vec<Section<'a>> = Vec::new();
    let mut expected = (FIXED_HEADER + table.len()) as u64;
    while reader.left() > 0 {
        let mut id = SectionId::default();
        id.copy_from_slice(reader.take("section id", 4)?);
        let flags = reader.u32("section flags")?;
        let offset = reader.u64("section offset")?;
        let length = reader.u64("section length")?;
        let stated = reader.u32("section checksum")?;
        if flags & !CRITICAL != 0 {
            return Err(reader.malformed("section flags", flags));
        }
        if sections.iter().any(|section| section.id == id) {
            return Err(DecodeError::DuplicateSection { section: id_text(id) });
        }
        if offset != expected {
            return Err(DecodeError::SectionPlace { section: id_text(id), offset, expected });
        }
        let left = bytes.len() as u64 - offset;
        if length > left {
            return Err(DecodeError::Truncated {
                part: "file",
                what: "section",
                offset: offset as usize,
                needed: length,
                left,
            });
        }
        expected = offset + length;
        let content = &bytes[offset as usize..expected as usize];
        let actual = crc32c::crc32c(content);
        if actual != stated {
            return Err(DecodeError::SectionChecksum { section: id_text(id), stated, actual });
        }
        sections.push(Section { id, critical: flags & CRITICAL != 0, offset, bytes: content });
    }
    match bytes.len() as u64 - expected {
        0 => Ok(sections),
        count => Err(DecodeError::TrailingBytes { part: "file", count: count as usize }),
    }
}

/// The minor version that first had all of `ids`: a file states the oldest version whose decoders can read it.
fn minor(ids: impl Iterator<Item = SectionId>) -> u16 {
    let first_with = |id| match id {
        sections::DIRECTIONS => 3,
        sections::FRAME => 2,
        sections::REGRESSION => 1,
        _ => 0,
    };
    ids.map(first_with).max().unwrap_or(0)
}

/// Writes a file of `(id, content)`; those whose id is in `optional` need not be understood, all others are critical.
pub(super) fn write(sections: &[(SectionId, Vec<u8>)], optional: &[SectionId]) -> Vec<u8> {
    let _stage = tracing::debug_span!("container").entered();
    let header = FIXED_HEADER + sections.len() * TABLE_ENTRY;
    let length = header + sections.iter().map(|(_, content)| content.len()).sum::<usize>();
    let mut writer = Writer::new();
    writer.raw(&MAGIC);
    writer.u16(MAJOR);
    writer.u16(minor(sections.iter().map(|(id, _)| *id)));
    writer.u16(sections.len() as u16);
    writer.u16(ARITHMETIC_PROFILE);
    writer.u64(length as u64);
    writer.raw(&[0; FIXED_HEADER - DIGEST_AT]);
    let mut offset = header;
    for (id, content) in sections {
        writer.raw(id);
        writer.u32(if optional.contains(id) { 0 } else { CRITICAL });
        writer.u64(offset as u64);
        writer.u64(content.len() as u64);
        writer.u32(crc32c::crc32c(content));
        offset += content.len();
    }
    for (_, content) in sections {
        writer.raw(content);
    }
    let mut bytes = writer.into_bytes();
    let digest = file_digest(&bytes);
    bytes[DIGEST_AT..CRC_AT].copy_from_slice(digest.as_bytes());
    let crc = crc32c::crc32c_append(crc32c::crc32c(&bytes[..CRC_AT]), &bytes[FIXED_HEADER..header]);
    bytes[CRC_AT..FIXED_HEADER].copy_from_slice(&crc.to_le_bytes());
    bytes
}

/// SHA-256 of everything but the hash itself and the header checksum, which covers the hash.
fn file_digest(bytes: &[u8]) -> Digest {
    let mut hasher = Sha256::new();
    hasher.update(&bytes[..DIGEST_AT]);
    hasher.update(&bytes[FIXED_HEADER..]);
    Digest::from_bytes(hasher.finalize().into())
}

/// A section's id as people write it.
pub(super) fn id_text(id: SectionId) -> String {
    id.escape_ascii().to_string()
}
