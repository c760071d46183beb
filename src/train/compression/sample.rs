//! Which anchors a step measures the rate of.
//!
//! What always holds: the sample of a step is a function of the seed, the step and the number of anchors; it is ascending,
//! names no anchor twice, and has every anchor with the same chance.

use rand::RngExt;
use rand_pcg::Pcg64;

/// Anchors in the sample of a step: `share` of them, at least one if there is one.
#[must_use]
pub(in crate::train) fn sample_size(anchors: usize, share: f64) -> usize {
    ((anchors as f64 * share).ceil() as usize).min(anchors)
}

/// The sample of `step`: one anchor from each of as many runs of neighbouring anchors, so that it covers the scene.
#[must_use]
pub(in crate::train) fn sample(seed: u64, step: u32, anchors: usize, share: f64) -> Vec<u32> {
    let mut rng = Pcg64::new(u128::from(step), u128::from(seed));
    let wanted = sample_size(anchors, share);
    if wanted == 0 {
        return Vec::new();
    }
    // Runs differ in length by one; where the first begins is random, so that no anchor is always in a shorter one.
    let turn = rng.random_range(0..anchors);
    let begin = |run: usize| run * anchors / wanted;
    let mut sample: Vec<u32> = (0..wanted)
        .map(|run| ((turn + rng.random_range(begin(run)..begin(run + 1))) % anchors) as u32)
        .collect();
    sample.sort_unstable();
    sample
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_ascending_without_repeats_and_of_its_size() {
        for anchors in [1, 2, 3, 7, 100, 6_874] {
            for step in 1..50 {
                let sample = sample(3, step, anchors, 0.15);
                assert_eq!(sample.len(), sample_size(anchors, 0.15));
                assert!(sample.windows(2).all(|pair| pair[0] < pair[1]), "{sample:?}");
                assert!(sample.iter().all(|anchor| (*anchor as usize) < anchors));
            }
        }
        assert!(sample(3, 1, 0, 0.15).is_empty());
        assert_eq!(sample(3, 1, 9, 1.0), (0..9).collect::<Vec<u32>>());
        assert_eq!([sample_size(1, 0.15), sample_size(100, 0.15), sample_size(101, 0.15)], [1, 15, 16]);
    }

    #[test]
    fn steps_and_seeds_have_samples_of_their_own_and_every_anchor_is_drawn_as_often() {
        assert_eq!(sample(1, 2, 500, 0.15), sample(1, 2, 500, 0.15));
        assert_ne!(sample(1, 2, 500, 0.15), sample(1, 3, 500, 0.15));
        assert_ne!(sample(1, 2, 500, 0.15), sample(2, 2, 500, 0.15));
        let (anchors, steps) = (101, 20_000);
        let mut drawn = vec![0_u32; anchors];
        for step in 0..steps {
            sample(5, step, anchors, 0.15).iter().for_each(|anchor| drawn[*anchor as usize] += 1);
        }
        let expected = f64::from(steps) * sample_size(anchors, 0.15) as f64 / anchors as f64;
        for (anchor, drawn) in drawn.into_iter().enumerate() {
            // Five standard deviations of a binomial.
            let bound = 5.0 * expected.sqrt();
            assert!((f64::from(drawn) - expected).abs() < bound, "anchor {anchor}: {drawn} for {expected}");
        }
    }
}
