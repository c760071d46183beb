//! Bounded reading and writing of the container's plain fields: little-endian integers, f32 and varints.
//!
//! The reader never looks past its slice, and every error says which part and field ended early.

use super::error::{DecodeError, Result};

macro_rules! read_numbers {
    ($($number:ident),*) => {$(
        pub(super) fn $number(&mut self, what: &'static str) -> Result<$number> {
            Ok($number::from_le_bytes(self.array(what)?))
        }
    )*};
}

macro_rules! write_numbers {
    ($($number:ident),*) => {$(
        pub(super) fn $number(&mut self, value: $number) {
            self.raw(&value.to_le_bytes());
        }
    )*};
}

/// Reads fields from the front of a slice.
pub(super) struct Reader<'a> {
    part: &'static str,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(part: &'static str, bytes: &'a [u8]) -> Self {
        Self { part, bytes, at: 0 }
    }

    pub(super) fn position(&self) -> usize {
        self.at
    }

    pub(super) fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    pub(super) fn take(&mut self, what: &'static str, count: u64) -> Result<&'a [u8]> {
        match usize::try_from(count) {
            Ok(count) if count <= self.left() => {
                let taken = &self.bytes[self.at..self.at + count];
                self.at += count;
                Ok(taken)
            }
            _ => Err(self.truncated(what, count)),
        }
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(what, N as u64)?);
        Ok(array)
    }

    pub(super) fn u8(&mut self, what: &'static str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    read_numbers! { u16, u32, u64, f32, f64 }

    pub(super) fn digest_bytes(&mut self, what: &'static str) -> Result<[u8; 32]> {
        self.array(what)
    }

    /// LEB128: seven bits a byte, lowest first, at most 64 bits, no needless last byte.
    pub(super) fn varint(&mut self, what: &'static str) -> Result<u64> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8(what)?;
            let bits = u64::from(byte & 0x7f);
            if shift == 63 && bits > 1 {
                return Err(self.malformed(what, "a varint above 64 bits"));
            }
            value |= bits << shift;
            if byte & 0x80 == 0 {
                if byte == 0 && shift > 0 {
                    return Err(self.malformed(what, "a varint with a needless byte"));
                }
                return Ok(value);
            }
        }
        Err(self.malformed(what, "a varint above 64 bits"))
    }

    /// A varint in `range`.
    pub(super) fn count(
        &mut self,
        what: &'static str,
        range: std::ops::RangeInclusive<usize>,
    ) -> Result<usize> {
        let value = self.varint(what)?;
        usize::try_from(value)
            .ok()
            .filter(|count| range.contains(count))
            .ok_or_else(|| self.malformed(what, value))
    }

    /// A zigzag varint: 0, -1, 1, -2, ... are stored as 0, 1, 2, 3, ...
    pub(super) fn signed(&mut self, what: &'static str) -> Result<i64> {
        let value = self.varint(what)?;
        Ok((value >> 1) as i64 ^ -((value & 1) as i64))
    }

    /// A varint length, then that many bytes of UTF-8.
    pub(super) fn text(&mut self, what: &'static str) -> Result<&'a str> {
        let length = self.varint(what)?;
        let bytes = self.take(what, length)?;
        std::str::from_utf8(bytes).map_err(|_| self.malformed(what, "not UTF-8"))
    }

    /// The rest of the slice.
    pub(super) fn rest(&mut self) -> &'a [u8] {
        let rest = &self.bytes[self.at..];
        self.at = self.bytes.len();
        rest
    }

    pub(super) fn end(&self) -> Result<()> {
        match self.left() {
            0 => Ok(()),
            count => Err(DecodeError::TrailingBytes { part: self.part, count }),
        }
    }

    /// The error of a field that needs more bytes than are left.
    pub(super) fn truncated(&self, what: &'static str, needed: u64) -> DecodeError {
        DecodeError::Truncated { part: self.part, what, offset: self.at, needed, left: self.left() as u64 }
    }

    pub(super) fn malformed(&self, what: &'static str, value: impl ToString) -> DecodeError {
        DecodeError::malformed(self.part, what, value)
    }
}

/// Appends fields, the mirror of [`Reader`].
#[derive(Default)]
pub(super) struct Writer {
    bytes: Vec<u8>,
}

impl Writer {
    pub(super) fn new() -> Self {
        Self::default()
    }

    pub(super) fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    pub(super) fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    write_numbers! { u16, u32, u64, f32 }

    pub(super) fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.u8(value as u8 | 0x80);
            value >>= 7;
        }
        self.u8(value as u8);
    }

    pub(super) fn signed(&mut self, value: i64) {
        self.varint(((value << 1) ^ (value >> 63)) as u64);
    }

    pub(super) fn text(&mut self, text: &str) {
        self.varint(text.len() as u64);
        self.raw(text.as_bytes());
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_come_back() {
        let mut writer = Writer::new();
        let numbers = [0, 1, 127, 128, 300, u64::from(u32::MAX), u64::MAX];
        let signed = [0, -1, 1, -64, 64, i64::MIN, i64::MAX];
        numbers.iter().for_each(|value| writer.varint(*value));
        signed.iter().for_each(|value| writer.signed(*value));
        writer.text("Wände");
        writer.f32(0.1);
        let bytes = writer.into_bytes();
        let mut reader = Reader::new("test", &bytes);
        for value in numbers {
            assert_eq!(reader.varint("n"), Ok(value));
        }
        for value in signed {
            assert_eq!(reader.signed("s"), Ok(value));
        }
        assert_eq!(reader.text("t"), Ok("Wände"));
        assert_eq!(reader.f32("f"), Ok(0.1));
        assert_eq!(reader.end(), Ok(()));
        assert!(matches!(reader.u8("past"), Err(DecodeError::Truncated { needed: 1, left: 0, .. })));
    }

    #[test]
    fn varints_have_one_spelling_and_lengths_are_checked_before_use() {
        for bytes in
            [&[0x80, 0x00][..], &[0xff; 10], &[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 2]]
        {
            assert!(matches!(Reader::new("t", bytes).varint("n"), Err(DecodeError::Malformed { .. })));
        }
        let mut writer = Writer::new();
        writer.varint(u64::MAX);
        let bytes = writer.into_bytes();
        assert!(matches!(Reader::new("t", &bytes).text("n"), Err(DecodeError::Truncated { .. })));
        let mut reader = Reader::new("t", &[9]);
        assert!(matches!(reader.count("n", 1..=8), Err(DecodeError::Malformed { .. })));
    }
}
