//! A reader of little-endian binary tables that can only move inside the bytes it was given.

use super::error::Fault;

/// A position in a byte slice.
pub(super) struct Bytes<'a> {
    bytes: &'a [u8],
    at: usize,
}

macro_rules! number {
    ($($name:ident: $type:ty),*) => {$(
        #[doc = concat!("The next `", stringify!($type), "`.")]
        pub(super) fn $name(&mut self, what: &'static str) -> Result<$type, Fault> {
            Ok(<$type>::from_le_bytes(self.array(what)?))
        }
    )*};
}

impl<'a> Bytes<'a> {
    /// Starts at the first byte.
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    number! { u8: u8, u32: u32, i32: i32, u64: u64, f64: f64 }

    /// A 64-bit count of records of at least `record` bytes each, which must fit into what is left.
    pub(super) fn count(&mut self, what: &'static str, record: usize) -> Result<usize, Fault> {
        let count = self.u64(what)?;
        let left = self.left();
        let needed = u128::from(count) * record as u128;
        if needed > left as u128 {
            return Err(Fault::Count { what, count, needed, left });
        }
        Ok(count as usize)
    }

    /// Text up to a zero byte, which is passed over.
    pub(super) fn zero_terminated(&mut self, what: &'static str) -> Result<&'a [u8], Fault> {
        let rest = &self.bytes[self.at..];
        let Some(length) = rest.iter().position(|byte| *byte == 0) else {
            return Err(self.truncated(what, rest.len() + 1));
        };
        self.at += length + 1;
        Ok(&rest[..length])
    }

    /// Passes over `length` bytes.
    pub(super) fn skip(&mut self, what: &'static str, length: usize) -> Result<(), Fault> {
        if length > self.left() {
            return Err(self.truncated(what, length));
        }
        self.at += length;
        Ok(())
    }

    /// Demands that nothing is left.
    pub(super) fn finish(self) -> Result<(), Fault> {
        match self.left() {
            0 => Ok(()),
            left => Err(Fault::TrailingBytes(left)),
        }
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], Fault> {
        match self.bytes[self.at..].first_chunk() {
            Some(chunk) => {
                self.at += N;
                Ok(*chunk)
            }
            None => Err(self.truncated(what, N)),
        }
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn truncated(&self, what: &'static str, needed: usize) -> Fault {
        Fault::Truncated { what, offset: self.at, needed, left: self.left() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_end_where_the_bytes_end() {
        let mut bytes = Bytes::new(&[1, 2, 0, 0, 0, b'a', b'b', 0, 9]);
        assert_eq!(bytes.u8("a byte").expect("there"), 1);
        assert_eq!(bytes.u32("a number").expect("there"), 2);
        assert_eq!(bytes.zero_terminated("a name").expect("there"), b"ab");
        let fault = bytes.f64("a value").expect_err("one byte is left");
        assert_eq!(fault.to_string(), "ends early: a value at byte 8 needs 8 bytes and 1 are left");
        assert!(bytes.zero_terminated("a name").is_err());
        assert!(bytes.skip("a list", usize::MAX).is_err());
        assert!(matches!(bytes.finish(), Err(Fault::TrailingBytes(1))));
    }

    #[test]
    fn a_count_is_held_against_the_bytes_that_are_left() {
        for (count, fits) in [(0_u64, true), (2, true), (3, false), (u64::MAX, false)] {
            let mut table = count.to_le_bytes().to_vec();
            table.extend([0; 16]);
            assert_eq!(Bytes::new(&table).count("records", 8).is_ok(), fits, "{count}");
        }
    }
}
