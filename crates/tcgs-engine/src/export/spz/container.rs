//! The two containers of a `.spz` file. Up to version 3 one stream of gzip holds header and arrays; version 4 has a plain
//! header, a table of lengths, and one zstd frame for each array.
//!
//! Lengths that a file states are checked against the bytes that are there before anything is allocated for them, and arrays
//! grow only as they are unpacked.

use std::io::{self, Read as _, Write as _};

use flate2::{Compression, read::GzDecoder, write::GzEncoder};

use super::{ARRAYS, MAGIC, POSITION_BITS, SpzError, SpzVersion, strides};

/// Bytes of the fields that all versions have in common.
const FIELDS: usize = 16;

/// Bytes of version 4's header: the common fields, where the table begins, and twelve zeros.
const HEADER_4: usize = 32;

/// Bytes of an entry in version 4's table: packed and unpacked length.
const ENTRY: usize = 16;

/// Vendors' extensions are present.
const HAS_EXTENSIONS: u8 = 2;

/// Adobe's extension that states the axes, in which some programs declare the usual ones.
const COORDINATE_SYSTEM: u32 = 0xadbe_0003;

/// Its values for right, up, back: unspecified, which means these, and by name.
const RIGHT_UP_BACK: [u32; 2] = [0, 4];

/// Largest ratio of deflate.
const MAX_GZIP_RATIO: u64 = 1032;

/// A zstd block takes at least four bytes and holds at most 128 KiB.
const MAX_ZSTD_RATIO: u64 = 1 << 15;

/// The level of the format's own writer: higher ones take several times as long for 3 % of the bytes.
const ZSTD_LEVEL: i32 = 12;

/// Windows that any frame may have, as a power of two; larger ones only where the array itself is larger.
const ZSTD_WINDOW_LOG: u32 = 27;
const MAX_ZSTD_WINDOW_LOG: u32 = if usize::BITS == 32 { 30 } else { 31 };

/// The fields of the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) version: u32,
    pub(super) count: u32,
    pub(super) degree: u8,
    pub(super) fractional_bits: u8,
    pub(super) flags: u8,
}

impl Header {
    fn parse(fields: &[u8; FIELDS]) -> Result<Self, SpzError> {
        if fields[..4] != MAGIC {
            return Err(SpzError::NotSpz);
        }
        let header = Self {
            version: word(fields, 4),
            count: word(fields, 8),
            degree: fields[12],
            fractional_bits: fields[13],
            flags: fields[14],
        };
        if !matches!(header.version, 2..=4) {
            return Err(SpzError::Version(header.version));
        }
        if header.degree > 3 {
            return Err(SpzError::Degree(header.degree));
        }
        if u32::from(header.fractional_bits) >= POSITION_BITS {
            return Err(SpzError::FractionalBits(header.fractional_bits));
        }
        if header.version < 4 && header.has_extensions() {
            return Err(SpzError::Extensions(header.flags));
        }
        Ok(header)
    }

    fn has_extensions(&self) -> bool {
        self.flags & HAS_EXTENSIONS != 0
    }

    /// The common fields; the last byte is the number of arrays in version 4 and zero before it.
    fn fields(&self, last: u8) -> Vec<u8> {
        let mut fields = Vec::with_capacity(HEADER_4);
        fields.extend(MAGIC);
        fields.extend(self.version.to_le_bytes());
        fields.extend(self.count.to_le_bytes());
        fields.extend([self.degree, self.fractional_bits, self.flags, last]);
        fields
    }

    /// Bytes of each array.
    fn lengths(&self) -> [u64; ARRAYS] {
        strides(self.version, self.degree).map(|stride| u64::from(self.count) * stride as u64)
    }
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// Writes the arrays in the container of `version`.
pub(super) fn write(
    version: SpzVersion,
    header: Header,
    arrays: &[Vec<u8>; ARRAYS],
) -> Result<Vec<u8>, SpzError> {
    match version {
        SpzVersion::V3 => write_gzip(header, arrays).map_err(|error| SpzError::Gzip(error.to_string())),
        SpzVersion::V4 => write_zstd(header, arrays).map_err(|error| SpzError::Zstd(error.to_string())),
    }
}

fn write_gzip(header: Header, arrays: &[Vec<u8>; ARRAYS]) -> io::Result<Vec<u8>> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(&header.fields(0))?;
    for array in arrays {
        gzip.write_all(array)?;
    }
    gzip.finish()
}

fn write_zstd(header: Header, arrays: &[Vec<u8>; ARRAYS]) -> io::Result<Vec<u8>> {
    let mut zstd = zstd::bulk::Compressor::new(ZSTD_LEVEL)?;
    // The format has no checksum of its own.
    zstd.set_parameter(zstd::zstd_safe::CParameter::ChecksumFlag(true))?;
    // Readers expect all arrays but the harmonics, which degree 0 has none of.
    let present = if header.degree == 0 { &arrays[..ARRAYS - 1] } else { &arrays[..] };
    let frames: Vec<Vec<u8>> = present.iter().map(|array| zstd.compress(array)).collect::<Result<_, _>>()?;
    let mut bytes = header.fields(present.len() as u8);
    bytes.extend((HEADER_4 as u32).to_le_bytes());
    bytes.resize(HEADER_4, 0);
    for (frame, array) in frames.iter().zip(present) {
        bytes.extend((frame.len() as u64).to_le_bytes());
        bytes.extend((array.len() as u64).to_le_bytes());
    }
    bytes.extend(frames.concat());
    Ok(bytes)
}

/// The header, and the arrays one after another.
pub(super) fn read(bytes: &[u8]) -> Result<(Header, Vec<u8>), SpzError> {
    if bytes.starts_with(&MAGIC) { read_zstd(bytes) } else { read_gzip(bytes) }
}

fn read_gzip(bytes: &[u8]) -> Result<(Header, Vec<u8>), SpzError> {
    let mut gzip = GzDecoder::new(bytes);
    let error = |error: io::Error| SpzError::Gzip(error.to_string());
    let mut fields = [0; FIELDS];
    gzip.read_exact(&mut fields).map_err(error)?;
    let header = Header::parse(&fields)?;
    if header.version > 3 {
        return Err(SpzError::Container(header.version));
    }
    let needed: u64 = header.lengths().iter().sum();
    let length = |found: u64| SpzError::Length { count: header.count, needed, found };
    let max = MAX_GZIP_RATIO * bytes.len() as u64;
    if needed > max {
        return Err(length(max));
    }
    let mut arrays = Vec::new();
    gzip.take(needed + 1).read_to_end(&mut arrays).map_err(error)?;
    if arrays.len() as u64 != needed {
        return Err(length(arrays.len() as u64));
    }
    Ok((header, arrays))
}

fn read_zstd(bytes: &[u8]) -> Result<(Header, Vec<u8>), SpzError> {
    let (header, frames) = frames(bytes)?;
    let mut arrays = Vec::new();
    for (frame, needed) in frames.into_iter().zip(header.lengths()) {
        let length = |found: u64| SpzError::Length { count: header.count, needed, found };
        let max = MAX_ZSTD_RATIO * frame.len() as u64;
        if needed > max {
            return Err(length(max));
        }
        if frame.is_empty() {
            continue;
        }
        let found = unpack(frame, needed, &mut arrays).map_err(|error| SpzError::Zstd(error.to_string()))?;
        if found != needed {
            return Err(length(found));
        }
    }
    Ok((header, arrays))
}

/// Appends the content of a frame, at most one byte more than `needed`; returns the number of bytes appended.
fn unpack(frame: &[u8], needed: u64, into: &mut Vec<u8>) -> io::Result<u64> {
    let mut zstd = zstd::stream::read::Decoder::with_buffer(frame)?;
    let window = needed.max(1).next_power_of_two().ilog2();
    zstd.window_log_max(window.clamp(ZSTD_WINDOW_LOG, MAX_ZSTD_WINDOW_LOG))?;
    Ok(zstd.take(needed + 1).read_to_end(into)? as u64)
}

/// The frame of each array in a file of version 4; empty for an array without bytes.
pub(super) fn frames(bytes: &[u8]) -> Result<(Header, [&[u8]; ARRAYS]), SpzError> {
    let Some((start, _)) = bytes.split_first_chunk::<HEADER_4>() else {
        return Err(match bytes.get(4..8) {
            Some(version) if word(version, 0) != 4 => SpzError::Version(word(version, 0)),
            _ => SpzError::Cut,
        });
    };
    let (fields, _) = start.split_first_chunk::<FIELDS>().ok_or(SpzError::Cut)?;
    let header = Header::parse(fields)?;
    if header.version != 4 {
        return Err(SpzError::Container(header.version));
    }
    let (stated, begin) = (usize::from(start[FIELDS - 1]), word(start, FIELDS) as usize);
    if begin < HEADER_4 {
        return Err(SpzError::Table);
    }
    let after_begin = bytes.get(begin..).ok_or(SpzError::Cut)?;
    if header.has_extensions() {
        check_extensions(&bytes[HEADER_4..begin])?;
    }
    let (table, mut left) = after_begin.split_at_checked(ENTRY * stated).ok_or(SpzError::Cut)?;
    let mut entries = table.as_chunks::<ENTRY>().0.iter().map(|entry| {
        let (packed, unpacked) = entry.split_at(ENTRY / 2);
        [packed, unpacked].map(|half| u64::from(word(half, 4)) << 32 | u64::from(word(half, 0)))
    });
    let mut frames = [&[][..]; ARRAYS];
    for (frame, needed) in frames.iter_mut().zip(header.lengths()) {
        // Writers differ in whether an array without bytes has an entry.
        let entry = if needed == 0 && entries.len() == 0 { Some([0, 0]) } else { entries.next() };
        let [packed, unpacked] = entry.ok_or(SpzError::Table)?;
        if unpacked != needed {
            return Err(SpzError::Length { count: header.count, needed, found: unpacked });
        }
        let packed = usize::try_from(packed).map_err(|_| SpzError::Cut)?;
        (*frame, left) = left.split_at_checked(packed).ok_or(SpzError::Cut)?;
    }
    if entries.len() != 0 || !left.is_empty() {
        return Err(SpzError::Table);
    }
    Ok((header, frames))
}

/// Refuses records that change the meaning of the numbers. Others are skipped, as the format demands.
fn check_extensions(mut records: &[u8]) -> Result<(), SpzError> {
    while let Some((record, rest)) = records.split_first_chunk::<8>() {
        let (kind, length) = (word(record, 0), word(record, 4) as usize);
        let (content, rest) = rest.split_at_checked(length).ok_or(SpzError::Cut)?;
        if kind == COORDINATE_SYSTEM {
            let value = content.get(..4).map(|value| word(value, 0)).ok_or(SpzError::Cut)?;
            if !RIGHT_UP_BACK.contains(&value) {
                return Err(SpzError::CoordinateSystem(value));
            }
        }
        records = rest;
    }
    if records.is_empty() { Ok(()) } else { Err(SpzError::Cut) }
}
