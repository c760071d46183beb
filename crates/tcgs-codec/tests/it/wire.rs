//! The container's layout once more, from `FORMAT.md` and not from the codec, to make files that it would not.

use sha2::{Digest, Sha256};

pub(super) const HEADER: usize = 60;
pub(super) const ENTRY: usize = 28;

/// Sets length, section places and checksums, whole-file hash and header checksum to what `bytes` has.
pub(super) fn reseal(bytes: &mut [u8]) {
    let header = HEADER + ENTRY * u16_at(bytes, 12) as usize;
    for entry in (HEADER..header).step_by(ENTRY) {
        let offset = u64_at(bytes, entry + 8) as usize;
        let length = u64_at(bytes, entry + 16) as usize;
        if let Some(content) = offset.checked_add(length).and_then(|end| bytes.get(offset..end)) {
            let crc = crc32c::crc32c(content);
            bytes[entry + 24..entry + 28].copy_from_slice(&crc.to_le_bytes());
        }
    }
    reseal_header(bytes, header);
}

/// Sets the whole-file hash and the header checksum only.
pub(super) fn reseal_header(bytes: &mut [u8], header: usize) {
    let mut hasher = Sha256::new();
    hasher.update(&bytes[..24]);
    hasher.update(&bytes[HEADER..]);
    bytes[24..56].copy_from_slice(&hasher.finalize());
    let crc = crc32c::crc32c_append(crc32c::crc32c(&bytes[..56]), &bytes[HEADER..header]);
    bytes[56..60].copy_from_slice(&crc.to_le_bytes());
}

/// Where the section table ends; none where the file has no room for it.
pub(super) fn table_end(bytes: &[u8]) -> Option<usize> {
    let end = HEADER + ENTRY * bytes.get(12..14).map(|_| u16_at(bytes, 12) as usize)?;
    (end <= bytes.len()).then_some(end)
}

/// A section: id, flags, content.
pub(super) type Part = ([u8; 4], u32, Vec<u8>);

/// The sections of a file.
pub(super) fn parts(bytes: &[u8]) -> Vec<Part> {
    let header = HEADER + ENTRY * u16_at(bytes, 12) as usize;
    (HEADER..header)
        .step_by(ENTRY)
        .map(|entry| {
            let offset = u64_at(bytes, entry + 8) as usize;
            let length = u64_at(bytes, entry + 16) as usize;
            let id = bytes[entry..entry + 4].try_into().expect("four bytes");
            (id, u32_at(bytes, entry + 4), bytes[offset..offset + length].to_vec())
        })
        .collect()
}

/// A file of `parts`, of format version `version`.
pub(super) fn file(version: (u16, u16), parts: &[Part]) -> Vec<u8> {
    let header = HEADER + ENTRY * parts.len();
    let length = header + parts.iter().map(|(_, _, content)| content.len()).sum::<usize>();
    let mut bytes = b"\x89TCGS\r\n\x1a".to_vec();
    bytes.extend(version.0.to_le_bytes());
    bytes.extend(version.1.to_le_bytes());
    bytes.extend((parts.len() as u16).to_le_bytes());
    bytes.extend(1_u16.to_le_bytes());
    bytes.extend((length as u64).to_le_bytes());
    bytes.extend([0; 36]);
    let mut offset = header;
    for (id, flags, content) in parts {
        bytes.extend(id);
        bytes.extend(flags.to_le_bytes());
        bytes.extend((offset as u64).to_le_bytes());
        bytes.extend((content.len() as u64).to_le_bytes());
        bytes.extend([0; 4]);
        offset += content.len();
    }
    parts.iter().for_each(|(_, _, content)| bytes.extend(content));
    reseal(&mut bytes);
    bytes
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(bytes[at..at + 2].try_into().expect("two bytes"))
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}
