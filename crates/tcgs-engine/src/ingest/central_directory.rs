//! Finds repeated names in the raw central directory of a zip archive, which readers that index by name merge, and names in an unknown
//! encoding, which they take for UTF-8 if they can.

use std::{
    collections::HashSet,
    io::{self, BufRead},
};

const ENTRY: [u8; 4] = *b"PK\x01\x02";
/// Length of an entry's fixed part, and where in it the lengths of its name, its extra field and its comment stand.
const FIXED_BYTES: usize = 46;
const LENGTHS: [usize; 3] = [28, 30, 32];

/// Where the flags of an entry stand, and the one that says that its name is UTF-8.
const FLAGS: usize = 8;
const IS_UTF_8: u16 = 0x0800;
/// Extra field with the name in UTF-8, beside one in a local code page.
const UNICODE_PATH: u16 = 0x7075;

/// An entry's name, and whether it is said to be UTF-8.
struct Name {
    bytes: Vec<u8>,
    is_utf8: bool,
}

/// The next entry of a directory; `None` at its end.
fn next_name(directory: &mut impl BufRead) -> io::Result<Option<Name>> {
    let mut fixed = [0; FIXED_BYTES];
    match directory.read_exact(&mut fixed) {
        Ok(()) if fixed.starts_with(&ENTRY) => {}
        Ok(()) => return Ok(None),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
        Err(error) => return Err(error),
    }
    let field = |at: usize| u16::from_le_bytes([fixed[at], fixed[at + 1]]);
    let [name, extra, comment] = LENGTHS.map(|at| usize::from(field(at)));
    let (mut bytes, mut fields) = (vec![0; name], vec![0; extra]);
    directory.read_exact(&mut bytes)?;
    directory.read_exact(&mut fields)?;
    io::copy(&mut io::Read::take(&mut *directory, comment as u64), &mut io::sink())?;
    let is_utf8 = field(FLAGS) & IS_UTF_8 != 0 || has_field(&fields, UNICODE_PATH);
    Ok(Some(Name { bytes, is_utf8 }))
}

/// Whether extra fields, each of a kind, a length and as many bytes, have one of this kind.
fn has_field(mut fields: &[u8], kind: u16) -> bool {
    while let [a, b, c, d, rest @ ..] = fields {
        if u16::from_le_bytes([*a, *b]) == kind {
            return true;
        }
        fields = rest.get(usize::from(u16::from_le_bytes([*c, *d]))..).unwrap_or_default();
    }
    false
}

/// Whether any of the first `limit` names has letters beyond ASCII and is not said to be UTF-8.
pub(super) fn has_names_of_unknown_encoding(mut directory: impl BufRead, limit: usize) -> io::Result<bool> {
    for _ in 0..limit {
        match next_name(&mut directory)? {
            Some(name) if !name.is_utf8 && !name.bytes.is_ascii() => return Ok(true),
            Some(_) => {}
            None => break,
        }
    }
    Ok(false)
}

/// The first name that an entry shares with an earlier one, in a directory of at most `limit` different names that begins where the
/// reader stands. What is not UTF-8 is replaced.
pub(super) fn first_repeated_name(mut directory: impl BufRead, limit: usize) -> io::Result<Option<String>> {
    let mut seen = HashSet::new();
    while seen.len() <= limit {
        let Some(Name { bytes, .. }) = next_name(&mut directory)? else { break };
        if seen.contains(&bytes) {
            return Ok(Some(String::from_utf8_lossy(&bytes).into_owned()));
        }
        seen.insert(bytes);
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(flags: u16, name: &[u8], extra: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0; FIXED_BYTES];
        bytes[..4].copy_from_slice(&ENTRY);
        bytes[FLAGS..FLAGS + 2].copy_from_slice(&flags.to_le_bytes());
        for (at, length) in LENGTHS.into_iter().zip([name.len(), extra.len(), 2]) {
            bytes[at..at + 2].copy_from_slice(&(length as u16).to_le_bytes());
        }
        [&bytes, name, extra, b"c!"].concat()
    }

    #[test]
    fn names_that_are_not_said_to_be_utf_8_are_found() {
        // In GBK this is a usual word, and it is UTF-8 too.
        let name = &[0xcd, 0xbc, 0xc6, 0xac][..];
        let unicode_path = [&[1, 0, 2, 0, 9, 9][..], &UNICODE_PATH.to_le_bytes(), &[0, 0]].concat();
        for (entry, expected) in [
            (entry(0, name, b""), true),
            (entry(0, name, &[1, 0, 200, 0]), true),
            (entry(IS_UTF_8, name, b""), false),
            (entry(0, name, &unicode_path), false),
            (entry(0, b"a.png", b""), false),
        ] {
            let directory = [self::entry(0, b"first", b""), entry].concat();
            assert_eq!(has_names_of_unknown_encoding(&*directory, 9).expect("read"), expected);
            assert!(!has_names_of_unknown_encoding(&*directory, 1).expect("read"));
        }
    }
}
