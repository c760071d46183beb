//! Range-coded streams over bytes: constriction's range coder (32-bit words, 64-bit state) with a shorter ending
//! and an exact check of the stream's length.
//!
//! Words are stored big-endian. A stream ends with the fewest bytes that still name a point inside the last
//! interval, and a decoder reads zeros after them. It knows the last interval too, so it knows the one ending
//! that belongs to the symbols it read and refuses any other: no stream has two spellings.

use std::{cmp::Ordering, num::NonZeroU32};

use constriction::{
    CoderError, Queue,
    backends::ReadWords,
    stream::{
        Decode, Encode,
        model::{DecoderModel, EncoderModel, EntropyModel},
        queue::{EncoderSituation, RangeDecoder, RangeEncoder},
    },
};

use super::{
    adaptive::{AdaptiveBit, BIT_PRECISION},
    error::{DecodeError, Result},
    gaussian::{GAUSSIAN_PRECISION, Table},
};

const WORD: usize = 4;
const STATE_WORDS: usize = 2;

/// Codes adaptive bits in either direction, so that encoder and decoder share what decides the contexts.
pub(super) trait BitCoder {
    /// The encoder codes `bit` and returns it; the decoder ignores it and returns the bit that it reads. The context adapts to it.
    fn code(&mut self, context: &mut AdaptiveBit, bit: bool) -> Result<bool>;
}

impl BitCoder for StreamEncoder {
    fn code(&mut self, context: &mut AdaptiveBit, bit: bool) -> Result<bool> {
        self.adaptive(context, bit);
        Ok(bit)
    }
}

impl BitCoder for StreamDecoder<'_> {
    fn code(&mut self, context: &mut AdaptiveBit, _: bool) -> Result<bool> {
        self.adaptive(context)
    }
}

/// Writes one stream.
pub(super) struct StreamEncoder {
    coder: RangeEncoder<u32, u64>,
}

impl StreamEncoder {
    pub(super) fn new() -> Self {
        Self { coder: RangeEncoder::new() }
    }

    /// Codes a bit in a context and lets the context learn it.
    pub(super) fn adaptive(&mut self, context: &mut AdaptiveBit, bit: bool) {
        self.bit(context.probability(), bit);
        context.learn(bit);
    }

    /// Codes a bit of probability one half.
    pub(super) fn bypass(&mut self, bit: bool) {
        self.bit(1 << (BIT_PRECISION - 1), bit);
    }

    /// Codes entry `index` of a table.
    pub(super) fn table(&mut self, table: &Table, index: usize) {
        self.coder
            .encode_symbol(index, TableModel(table))
            .expect("every entry of a table has a count above zero");
    }

    fn bit(&mut self, one: u32, bit: bool) {
        self.coder.encode_symbol(bit, BitModel { one }).expect("both bits have a count above zero");
    }

    /// The stream's bytes: all complete words, then the shortest ending.
    pub(super) fn finish(self) -> Vec<u8> {
        let (words, state, situation) = self.coder.into_raw_parts();
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
        let lower = state.lower();
        let (point, length) = ending(lower, state.range().get());
        if let EncoderSituation::Inverted(count, first) = situation {
            let carried = point < lower;
            bytes.extend(first.wrapping_add(u32::from(carried)).to_be_bytes());
            let held = if carried { 0 } else { u8::MAX };
            bytes.resize(bytes.len() + (count.get() - 1) * WORD, held);
        }
        bytes.extend(&point.to_be_bytes()[..length]);
        bytes
    }
}

/// Reads one stream.
pub(super) struct StreamDecoder<'a> {
    part: &'static str,
    coder: RangeDecoder<u32, u64, Words<'a>>,
}

impl<'a> StreamDecoder<'a> {
    pub(super) fn new(part: &'static str, bytes: &'a [u8]) -> Result<Self> {
        let coder = RangeDecoder::with_backend(Words { bytes, read: 0 }).map_err(|_| ended(part))?;
        Ok(Self { part, coder })
    }

    pub(super) fn part(&self) -> &'static str {
        self.part
    }

    pub(super) fn adaptive(&mut self, context: &mut AdaptiveBit) -> Result<bool> {
        let bit = self.bit(context.probability())?;
        context.learn(bit);
        Ok(bit)
    }

    pub(super) fn bypass(&mut self) -> Result<bool> {
        self.bit(1 << (BIT_PRECISION - 1))
    }

    pub(super) fn table(&mut self, table: &Table) -> Result<usize> {
        self.coder.decode_symbol(TableModel(table)).map_err(|error| self.decode_error(&error))
    }

    fn bit(&mut self, one: u32) -> Result<bool> {
        self.coder.decode_symbol(BitModel { one }).map_err(|error| self.decode_error(&error))
    }

    fn decode_error<F>(&self, error: &CoderError<F, StreamEnd>) -> DecodeError {
        match error {
            CoderError::Frontend(_) => DecodeError::Stream { part: self.part, problem: "is not decodable" },
            CoderError::Backend(StreamEnd) => ended(self.part),
        }
    }

    /// Checks that the stream ends with its last symbol, in the one way that an encoder ends it.
    pub(super) fn finish(self) -> Result<()> {
        let (words, state, point) = self.coder.into_raw_parts();
        let (expected, length) = ending(state.lower(), state.range().get());
        let problem = match words.bytes.len().cmp(&((words.read - STATE_WORDS) * WORD + length)) {
            Ordering::Less => "ends before the last symbol",
            Ordering::Greater => "goes on after the last symbol",
            Ordering::Equal if point != expected => "ends unlike any encoder's",
            Ordering::Equal => return Ok(()),
        };
        Err(DecodeError::Stream { part: self.part, problem })
    }
}

/// The point of the final interval that takes the fewest bytes, and how many it takes; the bytes after them
/// are zero. Nothing was coded where the interval is still the whole.
fn ending(lower: u64, range: u64) -> (u64, usize) {
    if range == u64::MAX {
        return (0, 0);
    }
    (0..=8_u32)
        .map(|length| {
            let below = if length == 8 { 0 } else { u64::MAX >> (8 * length) };
            (lower.wrapping_add(below) & !below, length as usize)
        })
        .find(|(point, _)| point.wrapping_sub(lower) < range)
        .expect("with all eight bytes the point is the lower bound itself")
}

fn ended(part: &'static str) -> DecodeError {
    DecodeError::Stream { part, problem: "ends before the last symbol" }
}

/// The stream has no more words.
#[derive(Debug)]
struct StreamEnd;

/// Big-endian words of a byte slice, with zeros after its end as far as the ending may have been shortened.
struct Words<'a> {
    bytes: &'a [u8],
    read: usize,
}

impl ReadWords<u32, Queue> for Words<'_> {
    type ReadError = StreamEnd;

    fn read(&mut self) -> Result<Option<u32>, StreamEnd> {
        // All words but the last two read were written whole.
        let whole = (self.read + 1).saturating_sub(STATE_WORDS) * WORD;
        if whole > self.bytes.len() {
            return Err(StreamEnd);
        }
        let start = (self.read * WORD).min(self.bytes.len());
        let stored = &self.bytes[start..(start + WORD).min(self.bytes.len())];
        let mut word = [0; WORD];
        word[..stored.len()].copy_from_slice(stored);
        self.read += 1;
        Ok(Some(u32::from_be_bytes(word)))
    }

    fn maybe_exhausted(&self) -> bool {
        self.read * WORD >= self.bytes.len()
    }
}

/// A bit whose `one` is in 2^-16; the zero has the lower interval.
struct BitModel {
    one: u32,
}

impl BitModel {
    fn interval(&self, bit: bool) -> (u32, NonZeroU32) {
        let zero = (1 << BIT_PRECISION) - self.one;
        let (start, count) = if bit { (zero, self.one) } else { (0, zero) };
        (start, NonZeroU32::new(count).expect("probabilities keep a margin from 0 and 1"))
    }
}

impl EntropyModel<BIT_PRECISION> for BitModel {
    type Symbol = bool;
    type Probability = u32;
}

impl EncoderModel<BIT_PRECISION> for BitModel {
    fn left_cumulative_and_probability(
        &self,
        symbol: impl std::borrow::Borrow<bool>,
    ) -> Option<(u32, NonZeroU32)> {
        Some(self.interval(*symbol.borrow()))
    }
}

impl DecoderModel<BIT_PRECISION> for BitModel {
    fn quantile_function(&self, quantile: u32) -> (bool, u32, NonZeroU32) {
        let bit = quantile >= (1 << BIT_PRECISION) - self.one;
        let (start, count) = self.interval(bit);
        (bit, start, count)
    }
}

struct TableModel<'a>(&'a Table);

impl EntropyModel<GAUSSIAN_PRECISION> for TableModel<'_> {
    type Symbol = usize;
    type Probability = u32;
}

impl EncoderModel<GAUSSIAN_PRECISION> for TableModel<'_> {
    fn left_cumulative_and_probability(
        &self,
        symbol: impl std::borrow::Borrow<usize>,
    ) -> Option<(u32, NonZeroU32)> {
        let (start, count) = self.0.interval(*symbol.borrow())?;
        Some((start, NonZeroU32::new(count)?))
    }
}

impl DecoderModel<GAUSSIAN_PRECISION> for TableModel<'_> {
    fn quantile_function(&self, quantile: u32) -> (usize, u32, NonZeroU32) {
        let (index, start, count) = self.0.find(quantile);
        (index, start, NonZeroU32::new(count).expect("every entry of a table has a count above zero"))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn encode(bits: &[(u32, bool)]) -> Vec<u8> {
        let mut encoder = StreamEncoder::new();
        bits.iter().for_each(|(one, bit)| encoder.bit(*one, *bit));
        encoder.finish()
    }

    fn decode(bytes: &[u8], bits: &[(u32, bool)]) -> Result<Vec<bool>> {
        let mut decoder = StreamDecoder::new("test", bytes)?;
        let read = bits.iter().map(|(one, _)| decoder.bit(*one)).collect::<Result<Vec<_>, _>>()?;
        decoder.finish()?;
        Ok(read)
    }

    #[test]
    fn nothing_takes_no_bytes() {
        assert!(encode(&[]).is_empty());
        assert_eq!(decode(&[], &[]), Ok(Vec::new()));
    }

    #[test]
    fn endings_are_short() {
        assert_eq!(encode(&[(1 << 15, false)]).len(), 0);
        assert_eq!(encode(&[(1 << 15, true)]).len(), 1);
        let sixty_four: Vec<_> = (0..64).map(|index| (1 << 15, index % 3 == 0)).collect();
        assert!(encode(&sixty_four).len() <= 9);
    }

    #[test]
    fn a_stream_has_one_ending() {
        let bits = [(1 << 15, true), (1 << 15, false)];
        assert_eq!(encode(&bits), [0x80]);
        let refused = |bytes: &[u8]| decode(bytes, &bits).expect_err("must be refused").to_string();
        // Other points of the last interval, which is from 0x80 to 0xc0.
        for last in 0x81..0xc0 {
            assert!(refused(&[last]).contains("ends unlike any encoder's"), "{last:x}");
        }
        assert!(refused(&[0x80, 0]).contains("goes on after the last symbol"));
    }

    proptest! {
        #[test]
        fn bits_come_back_and_lengths_are_exact(
            bits in prop::collection::vec((32_u32..65536 - 32, any::<bool>()), 0..600),
        ) {
            let bytes = encode(&bits);
            let expected: Vec<bool> = bits.iter().map(|(_, bit)| *bit).collect();
            prop_assert_eq!(decode(&bytes, &bits), Ok(expected.clone()));
            let mut longer = bytes.clone();
            longer.push(0);
            prop_assert!(decode(&longer, &bits).is_err());
            // A cut stream decodes to other symbols, which may be likelier and end there.
            if bytes.len() > 8 {
                prop_assert_ne!(decode(&bytes[..bytes.len() - 9], &bits), Ok(expected));
            }
        }

        #[test]
        fn likely_runs_survive_carries(ones in prop::collection::vec(any::<bool>(), 0..40), run in 0_usize..3000) {
            // Long runs of the likeliest symbol at the upper end keep the coder's interval astride a carry.
            let mut bits = vec![(65536 - 32, true); run];
            bits.extend(ones.iter().map(|bit| (65536 - 32, *bit)));
            bits.extend(vec![(32, false); run / 2]);
            let expected: Vec<bool> = bits.iter().map(|(_, bit)| *bit).collect();
            prop_assert_eq!(decode(&encode(&bits), &bits), Ok(expected));
        }
    }
}
