//! One integer in one stream: its Gaussian's table entry, or the escape followed by an Exp-Golomb code.

use super::{
    error::{DecodeError, Result},
    gaussian::{GAUSSIAN_PRECISION, Gaussian},
    range::{StreamDecoder, StreamEncoder},
};

/// Largest magnitude of a symbol: integers up to it are exact in an f32.
pub(super) const MAX_SYMBOL: i32 = 1 << 24;

/// Longest Exp-Golomb prefix: distances between two symbols have at most 26 bits.
const MAX_PREFIX: u32 = 26;

/// The distribution that a symbol is coded with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Distribution {
    /// Coded with a Gaussian.
    Gaussian(Gaussian),
    /// Always this value; takes no bits.
    Constant(i32),
}

impl Distribution {
    /// Codes `symbol`, whose magnitude is at most [`MAX_SYMBOL`].
    pub(super) fn encode(self, stream: &mut StreamEncoder, symbol: i32) {
        let gaussian = match self {
            Distribution::Constant(value) => {
                debug_assert_eq!(value, symbol, "a constant was fitted to varying symbols");
                return;
            }
            Distribution::Gaussian(gaussian) => gaussian,
        };
        let table = gaussian.table();
        let difference = symbol - gaussian.center();
        let outside = difference.abs() - table.radius();
        if outside <= 0 {
            stream.table(table, (difference + table.radius()) as usize);
            return;
        }
        stream.table(table, table.escape());
        stream.bypass(difference < 0);
        // `outside` is at least one, as Exp-Golomb wants it.
        let prefix = outside.ilog2();
        (0..prefix).for_each(|_| stream.bypass(true));
        stream.bypass(false);
        (0..prefix).rev().for_each(|bit| stream.bypass(outside >> bit & 1 == 1));
    }

    /// Reads a symbol.
    pub(super) fn decode(self, stream: &mut StreamDecoder<'_>) -> Result<i32> {
        let gaussian = match self {
            Distribution::Constant(value) => return Ok(value),
            Distribution::Gaussian(gaussian) => gaussian,
        };
        let table = gaussian.table();
        let index = stream.table(table)?;
        if index != table.escape() {
            return checked(stream.part(), gaussian.center() + index as i32 - table.radius());
        }
        let negative = stream.bypass()?;
        let mut prefix = 0;
        while stream.bypass()? {
            prefix += 1;
            if prefix > MAX_PREFIX {
                return Err(DecodeError::Stream { part: stream.part(), problem: "has an endless escape" });
            }
        }
        let mut outside = 1;
        for _ in 0..prefix {
            outside = outside << 1 | i32::from(stream.bypass()?);
        }
        let difference = table.radius() + outside;
        checked(stream.part(), gaussian.center() + if negative { -difference } else { difference })
    }

    /// Cost of a symbol in bits, by the table's counts; infinite if it cannot be coded.
    pub(super) fn cost(self, symbol: i32) -> f64 {
        let gaussian = match self {
            Distribution::Constant(value) => return if value == symbol { 0.0 } else { f64::INFINITY },
            Distribution::Gaussian(gaussian) => gaussian,
        };
        let table = gaussian.table();
        let difference = symbol - gaussian.center();
        let outside = difference.abs() - table.radius();
        let (index, escaped) = match outside {
            ..=0 => ((difference + table.radius()) as usize, 0.0),
            _ => (table.escape(), 2.0 + 2.0 * f64::from(outside.ilog2())),
        };
        let (_, count) = table.interval(index).expect("entries up to the escape exist");
        // `libm` and not the platform's logarithm, so that the encoder's choices are the same everywhere too.
        GAUSSIAN_PRECISION as f64 - libm::log2(f64::from(count)) + escaped
    }
}

fn checked(part: &'static str, symbol: i32) -> Result<i32> {
    if symbol.abs() <= MAX_SYMBOL {
        Ok(symbol)
    } else {
        Err(DecodeError::malformed(part, "a symbol", symbol))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn escapes_cost_what_they_take() {
        let distribution = Distribution::Gaussian(Gaussian { mean16: 5, scale: 3 });
        let symbols = [1000, -1000, 1 << 20, MAX_SYMBOL, -MAX_SYMBOL, 3, -3, 0];
        let mut stream = StreamEncoder::new();
        symbols.iter().for_each(|symbol| distribution.encode(&mut stream, *symbol));
        let bits: f64 = symbols.iter().map(|symbol| distribution.cost(*symbol)).sum();
        let bytes = stream.finish().len() as f64;
        assert!((bits / 8.0 - 0.01..=bits / 8.0 + 2.0).contains(&bytes), "{bytes} bytes for {bits} bits");
    }

    proptest! {
        #[test]
        fn symbols_come_back(
            symbols in prop::collection::vec((-MAX_SYMBOL..=MAX_SYMBOL, -16 * MAX_SYMBOL..=16 * MAX_SYMBOL, 0_u8..64), 0..50),
            near in prop::collection::vec((-9_i32..9, 0_u8..64), 0..200),
        ) {
            let all: Vec<(i32, Distribution)> = symbols
                .into_iter()
                .chain(near.into_iter().map(|(symbol, scale)| (symbol, symbol * 16 + 3, scale)))
                .map(|(symbol, mean16, scale)| (symbol, Distribution::Gaussian(Gaussian { mean16, scale })))
                .collect();
            let mut stream = StreamEncoder::new();
            all.iter().for_each(|(symbol, distribution)| distribution.encode(&mut stream, *symbol));
            let bytes = stream.finish();
            let mut stream = StreamDecoder::new("test", &bytes)?;
            for (symbol, distribution) in all {
                prop_assert_eq!(distribution.decode(&mut stream)?, symbol);
            }
            stream.finish()?;
        }
    }
}
