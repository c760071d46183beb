//! Binary probabilities that learn from what was coded, in integers only.

/// Bits of the coder's binary probabilities.
pub(super) const BIT_PRECISION: usize = 16;

/// Bits of the learnt probability, finer than the coder's so that slow learning does not stall.
const FINE_BITS: u32 = 22;

/// Probabilities stay this many 2^-16 away from 0 and 1. It bounds the symbols that one byte can carry.
const MARGIN: u32 = 32;

/// Learning rate 1 / (seen + 2) until this many were seen, constant from then on.
const SEEN_LIMIT: u16 = 510;

/// Probability of a one in some context.
#[derive(Debug, Clone, Copy)]
pub(super) struct AdaptiveBit {
    one: u32,
    seen: u16,
}

impl AdaptiveBit {
    /// One half.
    pub(super) const NEW: Self = Self { one: 1 << (FINE_BITS - 1), seen: 0 };

    /// Probability of a one in 2^-16.
    pub(super) fn probability(self) -> u32 {
        (self.one >> (FINE_BITS - BIT_PRECISION as u32)).clamp(MARGIN, (1 << BIT_PRECISION) - MARGIN)
    }

    /// Learns one bit; the quotient is rounded towards zero.
    pub(super) fn learn(&mut self, bit: bool) {
        let target = if bit { 1_i32 << FINE_BITS } else { 0 };
        let away = target - self.one as i32;
        // The same quotient, and most often the divisor is this power of two.
        let step = if self.seen == SEEN_LIMIT {
            away / (i32::from(SEEN_LIMIT) + 2)
        } else {
            away / (i32::from(self.seen) + 2)
        };
        self.one = (self.one as i32 + step) as u32;
        self.seen = (self.seen + 1).min(SEEN_LIMIT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn learns_and_never_reaches_certainty() {
        let mut bit = AdaptiveBit::NEW;
        assert_eq!(bit.probability(), 1 << 15);
        bit.learn(true);
        assert_eq!(bit.probability(), 3 << 14);
        for _ in 0..100_000 {
            bit.learn(true);
        }
        assert_eq!(bit.probability(), 65536 - MARGIN);
        for _ in 0..100_000 {
            bit.learn(false);
        }
        assert_eq!(bit.probability(), MARGIN);
    }
}
