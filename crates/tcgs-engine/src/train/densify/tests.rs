//! Growth and pruning as promises.

use std::collections::HashSet;

use proptest::prelude::*;
use rand::SeedableRng;
use rand_pcg::Pcg64;

use super::*;
use crate::{domain::Lattice, model::ModelShape, train::FIRST_LOGIT};

const SHAPE: ModelShape = ModelShape::new(4, 2);
const WIDTH: usize = 2 * SHAPE.offsets + 2;

const SETTINGS: DensifySettings = DensifySettings {
    threshold: 1.0,
    min_views: 40.0,
    min_visits: 80.0,
    coarsest: 16,
    max_anchors: 1000,
    extent: 1.0,
};

/// Anchors at these cells of a lattice of edge 1; every number in a row and its moments says whose it is.
fn state(cells: &[[i32; 3]]) -> TrainableAnchors {
    let row = SHAPE.row();
    let values: Vec<f32> = (0..cells.len() * row)
        .map(|i| match i % row {
            column if column < SHAPE.features => (i / row) as f32 + 0.1 * column as f32,
            column if column < SHAPE.offset_column() => -2.0,
            _ => 0.0,
        })
        .collect();
    let marks = |add: f32| (0..cells.len() * row).map(|i| (i / row) as f32 + add).collect();
    TrainableAnchors {
        anchors: AnchorRows {
            shape: SHAPE,
            lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
            cells: cells.to_vec(),
            values,
            masks: (0..cells.len() as u32).map(|anchor| 1 + anchor % 3).collect(),
        },
        first: marks(0.25),
        second: marks(0.5),
        masks: None,
    }
}

/// Puts offset `k` of an anchor at this many cells from it.
fn place_offset(state: &mut TrainableAnchors, anchor: usize, k: usize, cells: [f32; 3]) {
    let row = &mut state.anchors.values[anchor * SHAPE.row()..][..SHAPE.row()];
    for axis in 0..3 {
        row[SHAPE.offset_column() + 3 * k + axis] = cells[axis] / row[SHAPE.scaling_column() + axis].exp();
    }
}

fn statistics(anchors: usize) -> Statistics {
    Statistics::zero(SHAPE, anchors)
}

/// An offset that was seen `views` times with this mean gradient.
fn record_views(statistics: &mut Statistics, anchor: usize, k: usize, gradient: f32, views: f32) {
    let row = statistics.row_mut(anchor);
    row[k] = gradient * views;
    row[SHAPE.offsets + k] = views;
}

fn record_visits(statistics: &mut Statistics, anchor: usize, opacity: f32, visits: f32) {
    let row = statistics.row_mut(anchor);
    row[2 * SHAPE.offsets] = opacity;
    row[2 * SHAPE.offsets + 1] = visits;
}

/// A source of random numbers that are all zero: every candidate is taken.
struct AlwaysKeep;

impl rand::TryRng for AlwaysKeep {
    type Error = std::convert::Infallible;

    fn try_next_u32(&mut self) -> Result<u32, Self::Error> {
        Ok(0)
    }

    fn try_next_u64(&mut self) -> Result<u64, Self::Error> {
        Ok(0)
    }

    fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), Self::Error> {
        bytes.fill(0);
        Ok(())
    }
}

/// One anchor at the middle, its first offset 40 cells away along x.
fn one_candidate(gradient: f32, views: f32) -> (TrainableAnchors, Statistics) {
    let mut state = state(&[[0, 0, 0]]);
    place_offset(&mut state, 0, 0, [40.0, 0.0, 0.0]);
    let mut statistics = statistics(1);
    record_views(&mut statistics, 0, 0, gradient, views);
    (state, statistics)
}

/// Logits and moments that say whose they are.
fn mask_rows(anchors: usize) -> MaskRows {
    let marks = |add: f32| (0..anchors * SHAPE.offsets).map(|i| (i / SHAPE.offsets) as f32 + add).collect();
    MaskRows { logits: marks(0.125), first: marks(0.25), second: marks(0.5) }
}

fn assert_aligned(state: &TrainableAnchors, statistics: &Statistics) {
    let count = state.anchors.len();
    for values in state.masks.iter().flat_map(|masks| [&masks.logits, &masks.first, &masks.second]) {
        assert_eq!(values.len(), count * SHAPE.offsets);
    }
    assert_eq!(state.anchors.values.len(), count * SHAPE.row());
    assert_eq!(state.first.len(), count * SHAPE.row());
    assert_eq!(state.second.len(), count * SHAPE.row());
    assert_eq!(state.anchors.masks.len(), count);
    assert_eq!(statistics.values.len(), count * WIDTH);
    let distinct: HashSet<_> = state.anchors.cells.iter().collect();
    assert_eq!(distinct.len(), count, "no cell holds two anchors");
}

#[test]
fn an_offset_grows_an_anchor_only_if_seen_often_and_moved_enough() {
    for (gradient, views, grows) in [
        (1.0, 41.0, true),
        (0.999, 41.0, false),
        (1.0, 40.0, false),
        (0.0, 1000.0, false),
        (f32::NAN, 41.0, false),
        (1000.0, 0.0, false),
    ] {
        let (mut state, mut statistics) = one_candidate(gradient, views);
        let outcome = densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
        assert_eq!(outcome, Outcome { grown: usize::from(grows), pruned: 0 }, "{gradient} {views}");
        assert_aligned(&state, &statistics);
    }
}

#[test]
fn a_new_anchor_stands_on_its_coarse_cells_point_with_the_cells_size() {
    let (mut state, mut statistics) = one_candidate(1.0, 41.0);
    densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    // 40 / 16 = 2.5 rounds to the even 2.
    assert_eq!(state.anchors.cells, [[0, 0, 0], [32, 0, 0]]);
    let row = state.anchors.row(1);
    assert!(row[SHAPE.scaling_column()..][..3].iter().all(|log| *log == 16.0_f32.ln()));
    assert!(row[SHAPE.offset_column()..].iter().all(|v| *v == 0.0), "its offsets begin at zero");
    assert_eq!(state.anchors.masks[1], 0b11, "all its offsets may make Gaussians");
    assert!(state.first[SHAPE.row()..].iter().chain(&state.second[SHAPE.row()..]).all(|v| *v == 0.0));
    assert_eq!(statistics.row(1), [0.0; WIDTH]);
}

#[test]
fn what_was_there_stays_as_it_was() {
    let (mut state, mut statistics) = one_candidate(1.0, 41.0);
    let before = state.clone();
    densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert_eq!(state.anchors.row(0), before.anchors.row(0));
    assert_eq!(state.first[..SHAPE.row()], before.first);
    assert_eq!(state.second[..SHAPE.row()], before.second);
    assert_eq!(state.anchors.masks[0], before.anchors.masks[0]);
}

#[test]
fn a_new_anchors_feature_is_the_elementwise_maximum_of_its_parents() {
    let mut state = state(&[[0, 0, 0], [64, 0, 0], [128, 0, 0]]);
    let features = [[1.0, -5.0, 0.5, -1.0], [0.0, -4.0, 0.75, -2.0], [9.0, 9.0, 9.0, 9.0]];
    for (anchor, feature) in features.iter().enumerate() {
        state.anchors.values[anchor * SHAPE.row()..][..4].copy_from_slice(feature);
    }
    place_offset(&mut state, 0, 0, [31.0, 0.0, 0.0]);
    place_offset(&mut state, 1, 1, [-31.0, 0.0, 0.0]);
    // The third anchor's offset meets them in the same cell, but did not move enough.
    place_offset(&mut state, 2, 0, [-96.0, 0.0, 0.0]);
    let mut statistics = statistics(3);
    record_views(&mut statistics, 0, 0, 1.5, 50.0);
    record_views(&mut statistics, 1, 1, 1.5, 50.0);
    record_views(&mut statistics, 2, 0, 0.5, 50.0);
    let outcome = densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert_eq!(outcome.grown, 1, "one cell, one anchor");
    assert_eq!(state.anchors.cells[3], [32, 0, 0]);
    assert_eq!(state.anchors.row(3)[..4], [1.0, -4.0, 0.75, -1.0]);
}

#[test]
fn a_cell_that_is_taken_grows_nothing() {
    let (mut state, mut statistics) = one_candidate(1.0, 41.0);
    // 35 / 16 rounds to the same 2 as the candidate's cell.
    state.anchors.cells[0] = [35, 0, 0];
    place_offset(&mut state, 0, 0, [0.0, 0.0, 0.0]);
    assert_eq!(densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep).grown, 0);
}

#[test]
fn a_finer_level_has_twice_the_threshold_a_quarter_of_the_cell_and_needs_a_coarser_one_that_grew() {
    let two = |first: f32, second: f32| {
        let mut state = state(&[[0, 0, 0]]);
        // The second offset is in the anchor's own coarse cell; only finer cells are free for it.
        place_offset(&mut state, 0, 0, [40.0, 0.0, 0.0]);
        place_offset(&mut state, 0, 1, [0.0, 5.0, 0.0]);
        let mut statistics = statistics(1);
        record_views(&mut statistics, 0, 0, first, 41.0);
        record_views(&mut statistics, 0, 1, second, 41.0);
        densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
        assert_aligned(&state, &statistics);
        state.anchors.cells[1..].to_vec()
    };
    assert!(two(0.5, 3.0).is_empty(), "nothing grew at the coarsest level");
    assert_eq!(two(1.0, 1.9), [[32, 0, 0]], "below twice the threshold");
    assert_eq!(two(1.0, 2.0), [[32, 0, 0], [0, 4, 0]], "the finer cell");
    assert_eq!(two(1.0, 4.0), [[32, 0, 0], [0, 4, 0], [0, 5, 0]], "and the finest");
    assert_eq!(
        two(4.0, 0.0),
        [[32, 0, 0], [40, 0, 0]],
        "once at 16, at the free cell of 4; that is also its cell of 1"
    );
}

#[test]
fn a_lattice_whose_coarsest_cell_is_its_own_has_one_level() {
    let (mut state, mut statistics) = one_candidate(100.0, 41.0);
    let settings = DensifySettings { coarsest: 1, ..SETTINGS };
    assert_eq!(densify(&mut state, &mut statistics, &settings, &mut AlwaysKeep).grown, 1);
    assert_eq!(state.anchors.cells[1], [40, 0, 0]);
}

#[test]
fn growth_stops_at_the_largest_number_of_anchors() {
    for max_anchors in [0, 5, 6, 8, 100] {
        let mut state = state(&[[0, 0, 0], [1000, 0, 0], [2000, 0, 0], [3000, 0, 0], [4000, 0, 0]]);
        let mut statistics = statistics(5);
        for anchor in 0..5 {
            place_offset(&mut state, anchor, 0, [100.0, 0.0, 0.0]);
            record_views(&mut statistics, anchor, 0, 1.0, 41.0);
        }
        let settings = DensifySettings { max_anchors, ..SETTINGS };
        let outcome = densify(&mut state, &mut statistics, &settings, &mut AlwaysKeep);
        assert_eq!(state.anchors.len(), max_anchors.clamp(5, 10));
        assert_eq!(outcome.grown, state.anchors.len() - 5);
        assert_aligned(&state, &statistics);
    }
}

#[test]
fn the_last_free_places_go_to_the_largest_gradients() {
    let far: Vec<[i32; 3]> = (0..5).map(|i| [1000 * i, 0, 0]).collect();
    let mut state = state(&far);
    let mut statistics = statistics(5);
    for (anchor, gradient) in [2.0, 5.0, 3.0, 9.0, 4.0].into_iter().enumerate() {
        place_offset(&mut state, anchor, 0, [40.0, 0.0, 0.0]);
        record_views(&mut statistics, anchor, 0, gradient, 41.0);
    }
    let settings = DensifySettings { max_anchors: 7, coarsest: 1, ..SETTINGS };
    let outcome = densify(&mut state, &mut statistics, &settings, &mut AlwaysKeep);
    assert_eq!(outcome.grown, 2);
    assert_eq!(state.anchors.cells[5..], [[1040, 0, 0], [3040, 0, 0]]);
}

#[test]
fn candidates_at_the_end_of_the_lattice_stay_within_what_the_file_format_codes() {
    let mut state = state(&[[0, 0, 0]]);
    place_offset(&mut state, 0, 0, [1e9, -1e9, 0.0]);
    place_offset(&mut state, 0, 1, [-1e9, 1e9, 0.0]);
    let mut statistics = statistics(1);
    record_views(&mut statistics, 0, 0, 100.0, 41.0);
    record_views(&mut statistics, 0, 1, 100.0, 41.0);
    densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert!(state.anchors.len() > 1);
    assert_aligned(&state, &statistics);
    for axis in 0..3 {
        let along = || state.anchors.cells.iter().map(|cell| cell[axis]);
        let span = along().max().expect("one") - along().min().expect("one");
        assert!(span < 1 << 21, "{span}");
    }
}

#[test]
fn offsets_that_were_eligible_begin_anew_and_the_others_go_on_gathering() {
    let mut state = state(&[[0, 0, 0]]);
    let mut statistics = statistics(1);
    // Eligible, though it moved too little to grow anything.
    record_views(&mut statistics, 0, 0, 0.25, 41.0);
    record_views(&mut statistics, 0, 1, 0.5, 40.0);
    densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert_eq!(statistics.row(0), [0.0, 20.0, 0.0, 40.0, 0.0, 0.0]);
}

#[test]
fn an_anchor_is_pruned_only_if_visited_often_and_transparent() {
    for (opacity, visits, stays) in [
        (0.39, 80.0, true),
        (0.0, 80.0, true),
        (0.0, 81.0, false),
        (0.40, 81.0, false),
        (0.406, 81.0, true),
        (f32::NAN, 81.0, false),
        (50.0, 1000.0, true),
    ] {
        let mut state = state(&[[0, 0, 0], [1, 0, 0]]);
        let mut statistics = statistics(2);
        record_visits(&mut statistics, 0, opacity, visits);
        let outcome = densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
        assert_eq!(outcome, Outcome { grown: 0, pruned: usize::from(!stays) }, "{opacity} in {visits}");
        assert_aligned(&state, &statistics);
        if stays {
            let expected = if visits > 80.0 { [0.0; 2] } else { [opacity, visits] };
            assert_eq!(statistics.row(0)[4..], expected, "judged anchors begin anew, the others go on");
        }
    }
}

#[test]
fn everything_that_belongs_to_an_anchor_moves_with_it() {
    let cells: Vec<[i32; 3]> = (0..10).map(|i| [7 * i, 0, -i]).collect();
    let mut state = state(&cells);
    let before = state.clone();
    let mut statistics = statistics(10);
    let gone = [0, 3, 4, 9];
    for anchor in 0..10 {
        record_views(&mut statistics, anchor, 1, 0.25, anchor as f32);
        let opacity = if gone.contains(&anchor) { 0.0 } else { 100.0 };
        record_visits(&mut statistics, anchor, opacity, 81.0);
    }
    assert_eq!(densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep).pruned, 4);
    assert_aligned(&state, &statistics);
    let stayed: Vec<usize> = (0..10).filter(|anchor| !gone.contains(anchor)).collect();
    for (now, was) in stayed.into_iter().enumerate() {
        let rows = |values: &[f32], anchor: usize| values[anchor * SHAPE.row()..][..SHAPE.row()].to_vec();
        assert_eq!(state.anchors.cells[now], before.anchors.cells[was]);
        assert_eq!(state.anchors.masks[now], before.anchors.masks[was]);
        assert_eq!(state.anchors.row(now), before.anchors.row(was));
        assert_eq!(rows(&state.first, now), rows(&before.first, was));
        assert_eq!(rows(&state.second, now), rows(&before.second, was));
        assert_eq!(statistics.views(now, 1), was as f32);
    }
}

#[test]
fn an_anchor_that_just_grew_is_not_pruned_when_its_parent_is() {
    let (mut state, mut statistics) = one_candidate(1.0, 41.0);
    record_visits(&mut statistics, 0, 0.0, 81.0);
    let outcome = densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert_eq!(outcome, Outcome { grown: 1, pruned: 1 });
    assert_eq!(state.anchors.cells, [[32, 0, 0]]);
    assert_aligned(&state, &statistics);
}

#[test]
fn anchors_without_an_offset_go_however_opaque_they_were() {
    let mut state = state(&[[0, 0, 0], [1, 0, 0], [2, 0, 0]]);
    state.anchors.masks = vec![0b01, 0, 0b10];
    let mut statistics = statistics(3);
    record_visits(&mut statistics, 1, 100.0, 81.0);
    assert_eq!(densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep).pruned, 1);
    assert_eq!(state.anchors.cells, [[0, 0, 0], [2, 0, 0]]);
    assert_aligned(&state, &statistics);
}

#[test]
fn logits_and_their_moments_move_with_their_anchors() {
    let mut state = state(&[[0, 0, 0], [5, 0, 0], [9, 0, 0], [13, 0, 0]]);
    state.masks = Some(mask_rows(4));
    state.anchors.masks = vec![0, 0b11, 0b01, 0];
    let mut statistics = statistics(4);
    record_views(&mut statistics, 2, 1, 0.25, 7.0);
    assert_eq!(drop_masked(&mut state, &mut statistics), 2);
    assert_aligned(&state, &statistics);
    assert_eq!(state.anchors.cells, [[5, 0, 0], [9, 0, 0]]);
    assert_eq!(statistics.views(1, 1), 7.0);
    let masks = state.masks.expect("they learn");
    assert_eq!(masks.logits, [1.125, 1.125, 2.125, 2.125]);
    assert_eq!(masks.first, [1.25, 1.25, 2.25, 2.25]);
    assert_eq!(masks.second, [1.5, 1.5, 2.5, 2.5]);
    assert_eq!(state.first[SHAPE.row()], 2.25, "the rows' moments too");
}

#[test]
fn a_new_anchors_masks_begin_as_those_of_the_first_ones_did() {
    let (mut state, mut statistics) = one_candidate(1.0, 41.0);
    state.masks = Some(mask_rows(1));
    densify(&mut state, &mut statistics, &SETTINGS, &mut AlwaysKeep);
    assert_aligned(&state, &statistics);
    let masks = state.masks.expect("they learn");
    assert_eq!(masks.logits, [0.125, 0.125, FIRST_LOGIT, FIRST_LOGIT]);
    assert_eq!((masks.first[2..].to_vec(), masks.second[2..].to_vec()), (vec![0.0; 2], vec![0.0; 2]));
}

#[test]
fn base_sizes_are_held_relative_to_the_scene_and_nothing_else_is() {
    for extent in [0.001_f32, 1.0, 4000.0] {
        let mut state = state(&[[0, 0, 0], [1, 0, 0]]);
        let (s, o) = (SHAPE.scaling_column(), SHAPE.offset_column());
        state.anchors.values[s..o].fill(20.0);
        state.anchors.values[SHAPE.row() + s..SHAPE.row() + o].fill(-20.0);
        let mut expected = state.anchors.values.clone();
        expected[s + 3..o].fill(extent.ln() + 0.05);
        densify(&mut state, &mut statistics(2), &DensifySettings { extent, ..SETTINGS }, &mut AlwaysKeep);
        assert_eq!(state.anchors.values, expected);
    }
}

#[test]
fn about_half_of_the_candidates_of_the_coarsest_level_are_taken() {
    let cells: Vec<[i32; 3]> = (0..2000).map(|i| [500 * i, 0, 0]).collect();
    let mut state = state(&cells);
    let mut statistics = statistics(2000);
    for anchor in 0..2000 {
        place_offset(&mut state, anchor, 0, [100.0, 0.0, 0.0]);
        record_views(&mut statistics, anchor, 0, 1.0, 41.0);
    }
    let settings = DensifySettings { max_anchors: usize::MAX, ..SETTINGS };
    let outcome = densify(&mut state, &mut statistics, &settings, &mut Pcg64::seed_from_u64(1));
    // Five standard deviations of a fair coin.
    assert!(outcome.grown.abs_diff(1000) < 112, "{}", outcome.grown);
}

proptest! {
    #[test]
    fn whatever_was_gathered_rounds_keep_the_promises(
        seed: u64,
        cells in prop::collection::hash_set(prop::array::uniform3(-40..40_i32), 1..40),
        numbers in prop::collection::vec((0.0..8.0_f32, 0.0..100.0_f32, -60.0..60.0_f32), 40),
    ) {
        let mut cells: Vec<[i32; 3]> = cells.into_iter().collect();
        cells.sort_unstable();
        let count = cells.len();
        let mut begin = state(&cells);
        let mut gathered = statistics(count);
        for (anchor, (gradient, views, away)) in numbers.into_iter().take(count).enumerate() {
            record_views(&mut gathered, anchor, anchor % 2, gradient, views);
            record_visits(&mut gathered, anchor, gradient, 2.0 * views);
            place_offset(&mut begin, anchor, anchor % 2, [away, -0.5 * away, 3.0]);
        }
        let settings = DensifySettings { max_anchors: 45, ..SETTINGS };
        let round = || {
            let (mut state, mut statistics) = (begin.clone(), gathered.clone());
            let mut rng = Pcg64::seed_from_u64(seed);
            let first = densify(&mut state, &mut statistics, &settings, &mut rng);
            assert_aligned(&state, &statistics);
            prop_assert_eq!(state.anchors.len(), count + first.grown - first.pruned);
            prop_assert!(count + first.grown <= 45.max(count));
            // A second round finds nothing eligible: everything that was is reset.
            let second = densify(&mut state, &mut statistics, &settings, &mut rng);
            prop_assert_eq!(second, Outcome::default());
            Ok((state, statistics))
        };
        prop_assert_eq!(round()?, round()?);
    }
}
