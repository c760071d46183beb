//! Finds repeated names in the raw central directory of a zip archive, which readers that index by name merge.

use std::{
    collections::HashSet,
    io::{self, BufRead},
};

const ENTRY: [u8; 4] = *b"PK\x01\x02";
/// Length of an entry's fixed part, and where in it the lengths of its name, its extra field and its comment stand.
const FIXED_BYTES: usize = 46;
const LENGTHS: [usize; 3] = [28, 30, 32];

/// The first name that an entry shares with an earlier one, in a directory of at most `limit` different names that begins where the
/// reader stands. What is not UTF-8 is replaced.
pub(super) fn first_repeated_name(mut directory: impl BufRead, limit: usize) -> io::Result<Option<String>> {
    let mut seen = HashSet::new();
    let mut fixed = [0; FIXED_BYTES];
    while seen.len() <= limit {
        match directory.read_exact(&mut fixed) {
            Ok(()) if fixed.starts_with(&ENTRY) => {}
            Ok(()) => break,
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => break,
            Err(error) => return Err(error),
        }
        let [name, extra, comment] =
            LENGTHS.map(|at| usize::from(u16::from_le_bytes([fixed[at], fixed[at + 1]])));
        let mut bytes = vec![0; name];
        directory.read_exact(&mut bytes)?;
        if seen.contains(&bytes) {
            return Ok(Some(String::from_utf8_lossy(&bytes).into_owned()));
        }
        seen.insert(bytes);
        io::copy(&mut io::Read::take(&mut directory, (extra + comment) as u64), &mut io::sink())?;
    }
    Ok(None)
}
