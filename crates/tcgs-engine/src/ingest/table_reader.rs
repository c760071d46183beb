//! A forward-only reader of little-endian binary tables that stops at the stated length.

use std::io::{BufRead, Read as _};

use super::error::{IngestErrorKind, Result};

/// Longest text that is held; file names are shorter.
const MAX_TEXT_BYTES: usize = 4096;

/// A position in a table.
pub(super) struct TableReader<'a> {
    reader: &'a mut dyn BufRead,
    at: usize,
    length: usize,
}

macro_rules! number {
    ($($name:ident: $type:ty),*) => {$(
        #[doc = concat!("The next `", stringify!($type), "`.")]
        pub(super) fn $name(&mut self, what: &'static str) -> Result<$type> {
            Ok(<$type>::from_le_bytes(self.array(what)?))
        }
    )*};
}

impl<'a> TableReader<'a> {
    /// Starts at the first of `length` bytes.
    pub(super) fn new(reader: &'a mut dyn BufRead, length: u64) -> Self {
        Self { reader, at: 0, length: usize::try_from(length).unwrap_or(usize::MAX) }
    }

    number! { u8: u8, u32: u32, i32: i32, u64: u64, f64: f64 }

    /// A 64-bit count of records of at least `record` bytes each, which must fit into the rest.
    pub(super) fn count(&mut self, what: &'static str, record: usize) -> Result<usize> {
        let count = self.u64(what)?;
        let left = self.left();
        let needed = u128::from(count) * record as u128;
        if needed > left as u128 {
            return Err(IngestErrorKind::Count { what, count, needed, left });
        }
        Ok(count as usize)
    }

    /// Text up to a zero byte, which is consumed.
    pub(super) fn zero_terminated(&mut self, what: &'static str) -> Result<Vec<u8>> {
        let max = self.left().min(MAX_TEXT_BYTES + 1);
        let mut text = Vec::new();
        let read = (&mut *self.reader).take(max as u64).read_until(0, &mut text);
        if read.is_err() || text.pop_if(|last| *last == 0).is_none() {
            return Err(if max > MAX_TEXT_BYTES {
                let message = format!("{what} is longer than {MAX_TEXT_BYTES} bytes");
                IngestErrorKind::Record { place: format!("byte {}", self.at), message }
            } else {
                self.truncated(what, max + 1)
            });
        }
        self.at += text.len() + 1;
        Ok(text)
    }

    /// Passes over `length` bytes.
    pub(super) fn skip(&mut self, what: &'static str, length: usize) -> Result<()> {
        if length > self.left() {
            return Err(self.truncated(what, length));
        }
        let mut left = length;
        while left > 0 {
            let there = self.reader.fill_buf().map_or(0, <[u8]>::len).min(left);
            if there == 0 {
                return Err(self.truncated(what, length));
            }
            self.reader.consume(there);
            left -= there;
        }
        self.at += length;
        Ok(())
    }

    /// Checks that no bytes are left.
    pub(super) fn finish(self) -> Result<()> {
        match self.left() {
            0 => Ok(()),
            left => Err(IngestErrorKind::TrailingBytes(left)),
        }
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N]> {
        if self.left() < N {
            return Err(self.truncated(what, N));
        }
        let mut bytes = [0; N];
        // If the source itself failed, its owner reports that error instead.
        self.reader.read_exact(&mut bytes).map_err(|_| self.truncated(what, N))?;
        self.at += N;
        Ok(bytes)
    }

    fn left(&self) -> usize {
        self.length - self.at
    }

    fn truncated(&self, what: &'static str, needed: usize) -> IngestErrorKind {
        IngestErrorKind::Truncated { what, offset: self.at, needed, left: self.left() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_end_where_the_bytes_end() {
        let mut table = &[1, 2, 0, 0, 0, b'a', b'b', 0, 9][..];
        let mut bytes = TableReader::new(&mut table, 9);
        assert_eq!(bytes.u8("a byte").expect("there"), 1);
        assert_eq!(bytes.u32("a number").expect("there"), 2);
        assert_eq!(bytes.zero_terminated("a name").expect("there"), b"ab");
        let error = bytes.f64("a value").expect_err("one byte is left");
        assert_eq!(error.to_string(), "ends early: a value at byte 8 needs 8 bytes and 1 are left");
        assert!(bytes.zero_terminated("a name").is_err());
        assert!(bytes.skip("a list", usize::MAX).is_err());
        assert!(matches!(bytes.finish(), Err(IngestErrorKind::TrailingBytes(1))));
    }

    #[test]
    fn a_count_is_held_against_the_bytes_that_are_left() {
        for (count, fits) in [(0_u64, true), (2, true), (3, false), (u64::MAX, false)] {
            let mut table = count.to_le_bytes().to_vec();
            table.extend([0; 16]);
            let fitted = TableReader::new(&mut &table[..], 24).count("records", 8).is_ok();
            assert_eq!(fitted, fits, "{count}");
        }
    }

    #[test]
    fn a_table_that_is_shorter_than_was_stated_ends_early() {
        let ended = |read: fn(&mut TableReader) -> Result<()>| {
            let mut table = &[1_u8, 2, 3][..];
            let error = read(&mut TableReader::new(&mut table, 100)).expect_err("three bytes");
            assert!(matches!(error, IngestErrorKind::Truncated { .. }), "{error}");
        };
        ended(|bytes| bytes.f64("a value").map(drop));
        ended(|bytes| bytes.skip("a list", 50));
        ended(|bytes| bytes.zero_terminated("a name").map(drop));
    }

    #[test]
    fn text_without_an_end_is_not_gathered() {
        let table = vec![b'a'; MAX_TEXT_BYTES + 2];
        let error = TableReader::new(&mut &table[..], table.len() as u64).zero_terminated("a name");
        assert_eq!(error.expect_err("too long").to_string(), "byte 0: a name is longer than 4096 bytes");
    }
}
