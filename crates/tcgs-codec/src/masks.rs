//! Which offsets make a Gaussian: one adaptive bit an offset, with at least one set in every anchor.

use super::{
    adaptive::AdaptiveBit,
    alloc::reserve,
    error::Result,
    range::{StreamDecoder, StreamEncoder},
};

const PART: &str = "masks";

/// The masks section for `[N][K]` masks.
pub(super) fn encode(masks: &[bool], per_anchor: usize) -> Vec<u8> {
    let _stage = tracing::debug_span!("masks").entered();
    let mut stream = StreamEncoder::new();
    let mut contexts = MaskContexts::new(per_anchor);
    for anchor in masks.chunks_exact(per_anchor) {
        contexts.begin();
        for (slot, kept) in anchor.iter().enumerate() {
            if contexts.is_certain(slot) {
                break;
            }
            stream.adaptive(contexts.of(slot), *kept);
            contexts.note(*kept);
        }
        contexts.end(anchor);
    }
    stream.finish()
}

/// Reads the masks of `anchors` anchors.
pub(super) fn decode(section: &[u8], anchors: usize, per_anchor: usize) -> Result<Vec<bool>> {
    let _stage = tracing::debug_span!("masks").entered();
    let mut stream = StreamDecoder::new(PART, section)?;
    let mut contexts = MaskContexts::new(per_anchor);
    let mut masks = reserve(PART, anchors * per_anchor)?;
    for _ in 0..anchors {
        contexts.begin();
        let start = masks.len();
        for slot in 0..per_anchor {
            let kept = contexts.is_certain(slot) || stream.adaptive(contexts.of(slot))?;
            contexts.note(kept);
            masks.push(kept);
        }
        contexts.end(&masks[start..]);
    }
    stream.finish()?;
    Ok(masks)
}

/// Probabilities by slot, by the same slot of the anchor before, and by how many of this anchor's slots so far
/// and of the last anchor's slots are set, as shares.
struct MaskContexts {
    per_anchor: usize,
    bits: Vec<AdaptiveBit>,
    /// Share of the slots so far, by slot and count.
    shares: Vec<u8>,
    before: Vec<bool>,
    before_share: usize,
    kept: usize,
}

impl MaskContexts {
    fn new(per_anchor: usize) -> Self {
        let shares = (0..per_anchor)
            .flat_map(|slot| (0..per_anchor).map(move |kept| share(kept.min(slot), slot) as u8));
        Self {
            per_anchor,
            shares: shares.collect(),
            bits: vec![AdaptiveBit::NEW; per_anchor * 2 * SHARES * SHARES],
            before: vec![true; per_anchor],
            before_share: SHARES - 1,
            kept: 0,
        }
    }

    fn begin(&mut self) {
        self.kept = 0;
    }

    /// An anchor keeps at least one offset, so the last slot is certain if no other is set.
    fn is_certain(&self, slot: usize) -> bool {
        slot + 1 == self.per_anchor && self.kept == 0
    }

    fn of(&mut self, slot: usize) -> &mut AdaptiveBit {
        let so_far = usize::from(self.shares[slot * self.per_anchor + self.kept]);
        let place = (slot * 2 + usize::from(self.before[slot])) * SHARES + so_far;
        &mut self.bits[place * SHARES + self.before_share]
    }

    fn note(&mut self, kept: bool) {
        self.kept += usize::from(kept);
    }

    fn end(&mut self, anchor: &[bool]) {
        self.before.copy_from_slice(anchor);
        self.before_share = share(anchor.iter().filter(|kept| **kept).count(), self.per_anchor);
    }
}

/// Classes of shares: below a third, below two thirds, below all, all.
const SHARES: usize = 4;

fn share(part: usize, whole: usize) -> usize {
    if part == whole { SHARES - 1 } else { (SHARES - 1) * part / whole }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn masks_all_set_are_nearly_free() {
        let masks = vec![true; 10 * 20_000];
        let section = encode(&masks, 10);
        assert!(section.len() < 400, "{} bytes", section.len());
        assert_eq!(decode(&section, 20_000, 10), Ok(masks));
    }

    #[test]
    fn one_slot_an_anchor_takes_nothing() {
        assert!(encode(&[true; 50], 1).is_empty());
        assert_eq!(decode(&[], 50, 1), Ok(vec![true; 50]));
        assert!(decode(&[0; 9], 50, 1).is_err(), "bytes that code nothing are refused");
    }

    proptest! {
        #[test]
        fn masks_come_back(per_anchor in 1_usize..12, bits in prop::collection::vec(any::<bool>(), 12..600)) {
            let anchors = bits.len() / per_anchor;
            let mut masks = bits[..anchors * per_anchor].to_vec();
            for anchor in masks.chunks_exact_mut(per_anchor) {
                anchor[0] |= !anchor.iter().any(|kept| *kept);
            }
            prop_assert_eq!(decode(&encode(&masks, per_anchor), anchors, per_anchor), Ok(masks));
        }
    }
}
