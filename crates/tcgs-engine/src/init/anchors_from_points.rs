//! Anchors and render networks that begin in the colors of a point cloud.
//!
//! Every slot begins visible, with the color of the anchor's points, so no slot is lost to the chance of a random network and none
//! has to learn the colors first.

use std::collections::BTreeMap;

use rand::{Rng, RngExt};

use super::{
    FirstAnchors, InitError, PassingUnits, VoxelRule,
    anchors::thinned_rows,
    cell_within, coarse,
    first_anchors::{SLOT, SlotTargets},
};
use crate::model::{AnchorRows, ModelShape};

/// Opacity of every slot.
const OPACITY: f64 = 0.1;
/// Half the edge of the cube that offsets are drawn from, by the distance to the nearest anchors.
const SPREAD: f32 = 0.5;
/// Color channels that a point's is held to: beyond, the logistic hardly has a gradient.
const COLORS: [f64; 2] = [0.05, 0.95];
/// Of an anchor whose points have none.
const GRAY: f64 = 0.5;
/// Weights of random hidden units to the outputs of the opacity, covariance and color networks, by the usual: slots differ in
/// shape and color from the first step on, but none becomes transparent by chance.
const RANDOM: [f32; 3] = [0.1, 1.0, 1.0];

/// Anchors at `points` as [`initial_rows`](super::initial_rows) has them, with offsets from `rng`, and features and networks that predict the points'
/// `colors` (none, or one a point).
///
/// # Errors
/// [`InitError`] for an empty or non-finite point set.
pub fn anchors_from_points(
    points: &[[f32; 3]],
    colors: &[[u8; 3]],
    rule: VoxelRule,
    shape: ModelShape,
    max_anchors: usize,
    rng: &mut impl Rng,
) -> Result<FirstAnchors, InitError> {
    let (mut anchors, block) = thinned_rows(points, rule, shape, max_anchors)?;
    for row in anchors.values.chunks_exact_mut(shape.row()) {
        for offset in &mut row[shape.offset_column()..] {
            *offset = rng.random_range(-SPREAD..SPREAD);
        }
    }
    let mut slots = SlotTargets::with_capacity(anchors.len() * shape.offsets);
    for color in mean_colors(&anchors, block, points, colors) {
        // Sizes are the logistic of zero, half the distance to the nearest anchors, and no slot is turned.
        let mut slot = [0.0; SLOT];
        slot[0] = OPACITY.atanh();
        slot[4] = 1.0;
        for (to, value) in slot[8..].iter_mut().zip(color) {
            let value = value.clamp(COLORS[0], COLORS[1]);
            *to = (value / (1.0 - value)).ln();
        }
        for _ in 0..shape.offsets {
            slots.push(&slot, |_| true);
        }
    }
    Ok(FirstAnchors::from_slot_targets(anchors, slots, PassingUnits::LINEAR, RANDOM, rng))
}

/// The mean color, from 0 to 1, of the points in each anchor's block of `block` cells an edge. Points that all have the same color, as in
/// a cloud saved without any, have none.
fn mean_colors(anchors: &AnchorRows, block: i32, points: &[[f32; 3]], colors: &[[u8; 3]]) -> Vec<[f64; 3]> {
    let colors = if colors.windows(2).all(|pair| pair[0] == pair[1]) { &[] } else { colors };
    let mut sums: BTreeMap<[i32; 3], ([f64; 3], f64)> = BTreeMap::new();
    for (point, color) in points.iter().zip(colors) {
        let Some(cell) = cell_within(&anchors.lattice, *point) else { continue };
        let (sum, count) = sums.entry(coarse(cell, block)).or_default();
        for (sum, value) in sum.iter_mut().zip(color) {
            *sum += f64::from(*value) / 255.0;
        }
        *count += 1.0;
    }
    let mean = |cell: &[i32; 3]| {
        sums.get(&coarse(*cell, block)).map_or([GRAY; 3], |(sum, count)| sum.map(|sum| sum / count))
    };
    anchors.cells.iter().map(mean).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;
    use crate::init::{first_anchors::tests::outputs, initial_rows};

    const SHAPE: ModelShape = ModelShape::new(32, 4);

    /// A grid of points, two of a cell, one twice as bright as the other.
    fn points() -> (Vec<[f32; 3]>, Vec<[u8; 3]>) {
        let cell = |i: usize| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32];
        let color = |i: usize| [(i * 7 % 256) as u8, (i * 31 % 256) as u8, (i * 3 % 256) as u8];
        (0..1000).flat_map(|i| [(cell(i), color(i)), (cell(i), color(i).map(|c| c / 2))]).unzip()
    }

    fn begin(points: &[[f32; 3]], colors: &[[u8; 3]], seed: u64) -> FirstAnchors {
        let rng = &mut Pcg64::seed_from_u64(seed);
        anchors_from_points(points, colors, VoxelRule::Fixed(0.25), SHAPE, 1000, rng).expect("anchors")
    }

    #[test]
    fn every_slot_begins_visible_in_the_mean_color_of_its_points() {
        let (points, colors) = points();
        for seed in 0..10 {
            let first = begin(&points, &colors, seed);
            assert_eq!(first.anchors.len(), 1000);
            let mut squares = 0.0;
            for (anchor, expected) in mean_colors(&first.anchors, 1, &points, &colors).iter().enumerate() {
                let said = outputs(&first, anchor);
                let (opacities, rest) = said.split_at(SHAPE.offsets);
                assert!(opacities.iter().all(|opacity| *opacity > 0.02), "{opacities:?}");
                for color in rest[7 * SHAPE.offsets..].chunks_exact(3) {
                    for (found, expected) in color.iter().zip(expected) {
                        squares += (1.0 / (1.0 + f64::from(-found).exp()) - expected).powi(2);
                    }
                }
            }
            let mean = (squares / (1000 * 3 * SHAPE.offsets) as f64).sqrt();
            assert!(mean < 0.1, "colors differ by {mean} in the mean");
        }
    }

    #[test]
    fn a_thinned_anchor_has_the_mean_color_of_all_points_of_its_block() {
        let points: Vec<[f32; 3]> = (0..900).map(|i| [(i % 30) as f32, (i / 30) as f32, 0.0]).collect();
        let colors: Vec<[u8; 3]> = (0..900).map(|i| if i % 2 == 0 { [255; 3] } else { [0; 3] }).collect();
        let (anchors, block) = thinned_rows(&points, VoxelRule::Fixed(0.25), SHAPE, 100).expect("anchors");
        assert!((50..=100).contains(&anchors.len()), "{}", anchors.len());
        for color in mean_colors(&anchors, block, &points, &colors) {
            assert!(color.iter().all(|value| (0.2..=0.8).contains(value)), "{color:?}");
        }
    }

    #[test]
    fn offsets_lie_in_the_cell_and_the_rest_is_as_published() {
        let (points, colors) = points();
        let anchors = begin(&points, &colors, 1).anchors;
        let published = initial_rows(&points, VoxelRule::Fixed(0.25), SHAPE, 1000).expect("anchors");
        assert_eq!(anchors.cells, published.cells);
        for anchor in 0..anchors.len() {
            let (_, row) = anchors.row(anchor).split_at(SHAPE.scaling_column());
            let (scalings, offsets) = row.split_at(6);
            assert_eq!(scalings, &published.row(anchor)[SHAPE.scaling_column()..][..6]);
            assert!(offsets.iter().all(|offset| offset.abs() <= SPREAD));
            assert!(offsets.iter().any(|offset| *offset != offsets[0]));
        }
    }

    #[test]
    fn points_without_colors_or_of_one_color_begin_gray() {
        let (points, _) = points();
        let gray = begin(&points, &[], 1);
        assert!(gray.anchors.values.iter().chain(&gray.networks).all(|value| value.is_finite()));
        for colors in [[255; 3], [0; 3]] {
            assert_eq!(begin(&points, &vec![colors; points.len()], 1), gray);
        }
        let said = outputs(&gray, 0);
        assert!(said[..SHAPE.offsets].iter().all(|opacity| *opacity > 0.02), "{said:?}");
        assert!(said[8 * SHAPE.offsets..].iter().all(|color| color.abs() < 1.5), "{said:?}");
        let first = begin(&points[..1], &[[9, 200, 30]], 1);
        assert_eq!(first.anchors.len(), 1);
        assert!(first.anchors.values.iter().chain(&first.networks).all(|value| value.is_finite()));
    }
}
