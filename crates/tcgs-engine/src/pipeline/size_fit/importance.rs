//! The order of Gaussians by importance: by the squared error that removal costs for each byte that it saves.
//!
//! An anchor costs bytes of its own (its cell, feature and scalings) and some for each offset. So the first offsets of an anchor share
//! its own bytes, and the others count only theirs: the least important offsets are dropped one by one, and the anchor with the last
//! offset that shares its bytes.

use crate::{
    domain::{AnchorScene, ByteCounts, anchors::SCALINGS_PER_ANCHOR},
    eval::RemovalCosts,
};

/// Smallest standard deviation of a channel, in quantization steps, that its table can follow.
const MIN_DEVIATION: f64 = 0.25;

/// A Gaussian that may be dropped.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Importance {
    /// Its index among the scene's offsets, `anchor * K + offset`.
    pub(super) offset: usize,
    /// Squared error that dropping it costs for each byte that it saves.
    pub(super) price: f64,
}

/// The Gaussians of `scene`, the most important first. `counts` are the bytes of a file of the scene with `steps` for features,
/// scalings (in world units) and offsets.
pub(super) fn by_importance(
    scene: &AnchorScene,
    costs: &RemovalCosts,
    counts: &ByteCounts,
    steps: [f32; 3],
) -> Vec<Importance> {
    let k = scene.offsets_per_anchor;
    let bytes = Bytes::of(scene, counts, steps);
    let mut order = Vec::with_capacity(scene.gaussians());
    for anchor in 0..scene.len() {
        let first = order.len();
        let kept = (anchor * k..(anchor + 1) * k).filter(|offset| scene.masks[*offset]);
        let alone: f64 = kept.clone().map(|offset| costs.offsets[offset]).sum();
        // Offsets that cover the same pixels cost more, or less, together than alone.
        let together = costs.anchors[anchor] / alone;
        let scale = if alone > 0.0 && together > 0.0 { together } else { 1.0 };
        order.extend(kept.map(|offset| {
            let price = scale * costs.offsets[offset] / bytes.offsets[offset];
            Importance { offset, price }
        }));
        let own = &mut order[first..];
        own.sort_by(|a, b| b.price.total_cmp(&a.price));
        share_anchor(own, bytes.anchors[anchor], |gaussian| bytes.offsets[gaussian.offset]);
    }
    // Stable: equal prices keep the scene's order.
    order.sort_by(|a, b| b.price.total_cmp(&a.price));
    order
}

/// Divides the anchor's own bytes among its first offsets, as many as make the best price together.
fn share_anchor(own: &mut [Importance], anchor_bytes: f64, bytes: impl Fn(&Importance) -> f64) {
    let (mut error, mut saved) = (0.0, anchor_bytes);
    let mut best = f64::NEG_INFINITY;
    for gaussian in own.iter() {
        error += gaussian.price * bytes(gaussian);
        saved += bytes(gaussian);
        best = best.max(error / saved);
    }
    for gaussian in own {
        gaussian.price = gaussian.price.min(best);
    }
}

/// Bytes that dropping saves: shares of the file's sections by the bits that a table of each channel would need.
struct Bytes {
    anchors: Vec<f64>,
    offsets: Vec<f64>,
}

impl Bytes {
    fn of(scene: &AnchorScene, counts: &ByteCounts, steps: [f32; 3]) -> Self {
        let k = scene.offsets_per_anchor;
        let anchors: Vec<bool> = scene.masks.chunks_exact(k).map(|masks| masks.contains(&true)).collect();
        let features = shares(&scene.features, scene.feature_dim, &anchors, steps[0], counts.features);
        let scalings = shares(&scene.scalings, SCALINGS_PER_ANCHOR, &anchors, steps[1], counts.scalings);
        // The same three channels for every offset: which of an anchor's offsets is which has no meaning.
        let offsets = shares(&scene.offsets, 3, &scene.masks, steps[2], counts.offsets);
        let fixed = (counts.positions + counts.masks) as f64
            / anchors.iter().filter(|kept| **kept).count().max(1) as f64;
        Self { anchors: features.iter().zip(&scalings).map(|(f, s)| f + s + fixed).collect(), offsets }
    }
}

/// Divides `total` bytes among rows of `channels` values each, as far as they are `kept`, by their bits under one normal
/// distribution a channel.
fn shares(values: &[f32], channels: usize, kept: &[bool], step: f32, total: u64) -> Vec<f64> {
    let rows = || values.chunks_exact(channels).zip(kept).filter(|(_, kept)| **kept).map(|(row, _)| row);
    let count = rows().count().max(1) as f64;
    let tables: Vec<(f64, f64)> = (0..channels)
        .map(|channel| {
            let column = || rows().map(|row| f64::from(row[channel] / step));
            let mean = column().sum::<f64>() / count;
            let variance = column().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
            (mean, variance.sqrt().max(MIN_DEVIATION))
        })
        .collect();
    let bits = |row: &[f32]| -> f64 {
        let each = row.iter().zip(&tables).map(|(value, (mean, deviation))| {
            let distance = (f64::from(value / step) - mean) / deviation;
            let density = 0.5 * distance * distance * std::f64::consts::LOG2_E;
            ((std::f64::consts::TAU.sqrt() * deviation).log2() + density).max(0.05)
        });
        each.sum()
    };
    let all: Vec<f64> = values
        .chunks_exact(channels)
        .zip(kept)
        .map(|(row, kept)| if *kept { bits(row) } else { 0.0 })
        .collect();
    let sum: f64 = all.iter().sum();
    all.into_iter().map(|bits| (total as f64 * bits / sum.max(1e-9)).max(1e-9)).collect()
}

#[cfg(test)]
mod tests {
    use super::{super::test_scene, *};

    /// Anchors of two offsets, all alike.
    fn scene(anchors: i32) -> AnchorScene {
        test_scene((0..anchors).map(|x| [x, 0, 0]).collect(), [5, 2], |_| 1.0)
    }

    fn counts() -> ByteCounts {
        ByteCounts {
            positions: 20,
            masks: 2,
            features: 200,
            scalings: 60,
            offsets: 80,
            ..ByteCounts::default()
        }
    }

    fn order(scene: &AnchorScene, offsets: Vec<f64>) -> Vec<usize> {
        let anchors = offsets.chunks_exact(2).map(|pair| pair.iter().sum()).collect();
        let order = by_importance(scene, &RemovalCosts { offsets, anchors }, &counts(), [1.0; 3]);
        assert!(order.windows(2).all(|pair| pair[0].price >= pair[1].price));
        order.iter().map(|gaussian| gaussian.offset).collect()
    }

    #[test]
    fn an_anchors_important_offset_shares_its_bytes_and_its_unimportant_one_is_dropped_early() {
        // The first anchor has one important offset and one that is not; the second two of medium importance; the third none.
        assert_eq!(order(&scene(3), vec![90.0, 0.1, 20.0, 20.0, 0.2, 0.2]), [0, 2, 3, 1, 4, 5]);
    }

    #[test]
    fn masked_offsets_are_not_in_the_order() {
        let mut scene = scene(2);
        scene.masks[1] = false;
        assert_eq!(order(&scene, vec![1.0, 0.0, 2.0, 2.0]), [2, 3, 0]);
    }

    #[test]
    fn offsets_that_cancel_each_other_are_less_important() {
        let scene = scene(2);
        let offsets = vec![10.0, 10.0, 9.0, 9.0];
        let together = |first: f64| RemovalCosts { offsets: offsets.clone(), anchors: vec![first, 18.0] };
        let first = |costs: &RemovalCosts| by_importance(&scene, costs, &counts(), [1.0; 3])[0].offset;
        assert_eq!(first(&together(20.0)), 0);
        assert_eq!(first(&together(2.0)), 2, "removing both changes nothing");
    }

    #[test]
    fn shares_add_up_and_rare_values_cost_more() {
        let values = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.0];
        let mut kept = [true; 8];
        kept[0] = false;
        let shares = shares(&values, 1, &kept, 1.0, 700);
        assert!((shares.iter().sum::<f64>() - 700.0).abs() < 1e-3, "{shares:?}");
        assert!(shares[7] > 1.5 * shares[1] && shares[0] < 1e-6, "{shares:?}");
    }
}
