//! The random sample of anchors whose bits a step estimates.

use rand::{SeedableRng, seq::index};
use rand_pcg::Pcg64;

/// Anchors in a sample: the given share, at least one where there is any.
pub(in crate::train) fn sample_size(anchors: usize, share: f64) -> usize {
    ((anchors as f64 * share).ceil() as usize).clamp(anchors.min(1), anchors)
}

/// A share of the anchors, ascending. The sample depends on seed and step only, so a repeated step uses the same anchors.
#[must_use]
pub fn sample_anchors(seed: u64, step: u32, anchors: usize, share: f64) -> Vec<u32> {
    let count = sample_size(anchors, share);
    let mut rng = Pcg64::seed_from_u64(seed ^ (u64::from(step) << 32));
    let mut sample: Vec<u32> =
        index::sample(&mut rng, anchors, count).into_iter().map(|anchor| anchor as u32).collect();
    sample.sort_unstable();
    sample
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_has_its_share_of_distinct_anchors_and_follows_from_seed_and_step() {
        for (anchors, share, expected) in
            [(0, 0.15, 0), (1, 0.15, 1), (7, 0.15, 2), (7000, 0.15, 1050), (9, 1.0, 9)]
        {
            let sample = sample_anchors(3, 5, anchors, share);
            assert_eq!(sample.len(), expected);
            assert!(sample.windows(2).all(|pair| pair[0] < pair[1]));
            assert!(sample.iter().all(|anchor| (*anchor as usize) < anchors));
            assert_eq!(sample, sample_anchors(3, 5, anchors, share));
        }
        assert_ne!(sample_anchors(3, 5, 7000, 0.15), sample_anchors(3, 6, 7000, 0.15));
        assert_ne!(sample_anchors(3, 5, 7000, 0.15), sample_anchors(4, 5, 7000, 0.15));
    }

    #[test]
    fn every_anchor_has_its_turn() {
        let mut seen = [0_u32; 400];
        for step in 0..200 {
            for anchor in sample_anchors(1, step, seen.len(), 0.15) {
                seen[anchor as usize] += 1;
            }
        }
        // Thirty times each on average, with a standard deviation of five.
        assert!(seen.iter().all(|count| (8..55).contains(count)), "{seen:?}");
    }
}
