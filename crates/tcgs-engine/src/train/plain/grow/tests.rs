use glam::Mat3;
use rand::SeedableRng;
use rand_pcg::Pcg64;

use super::*;
use crate::model::gaussian_rows::{BANDS, BASE, COLOR};

const EXTENT: f32 = 2.0;

const USUAL: GrowthSettings =
    GrowthSettings { threshold: 2e-4, extent: EXTENT, max_gaussians: 1000, prune_large: false };

/// Gaussians of the given sizes, all at opacity 0.5, distinguished by their positions; moments that are not zero.
fn state(sizes: &[f32]) -> TrainableGaussians {
    let mut values = GaussianRows::zero(sizes.len());
    for (index, size) in sizes.iter().enumerate() {
        let row = values.base_mut(index);
        row[0] = index as f32;
        row[LOG_SCALE..QUAT].copy_from_slice(&[size.ln(), (0.1 * size).ln(), (0.01 * size).ln()]);
        row[QUAT..QUAT + 4].copy_from_slice(&[0.6, 0.0, 1.6, 0.0]);
        row[COLOR] = 1.0 + index as f32;
        for (band, width) in values.bands.iter_mut().zip(BANDS) {
            band[index * width..(index + 1) * width].fill(10.0 + index as f32);
        }
    }
    let mut moments = GaussianRows::zero(sizes.len());
    moments.base.fill(0.5);
    moments.bands.iter_mut().for_each(|band| band.fill(0.5));
    TrainableGaussians { values, first: moments.clone(), second: moments }
}

/// A row of statistics for each gradient: two views, no radius.
fn view_statistics(gradients: &[f32]) -> Vec<f32> {
    gradients.iter().flat_map(|g| [2.0 * g, 2.0, 0.0]).collect()
}

fn round(state: &mut TrainableGaussians, statistics: &[f32], settings: &GrowthSettings) -> Outcome {
    let outcome = grow_and_prune(state, statistics, settings, &mut Pcg64::seed_from_u64(5));
    for rows in [&state.values, &state.first, &state.second] {
        assert_eq!(rows.len(), state.values.len());
        let lengths = rows.bands.each_ref().map(Vec::len);
        assert_eq!(lengths, BANDS.map(|width| width * state.values.len()));
    }
    outcome
}

#[test]
fn what_moves_little_or_was_never_seen_stays_as_it_is() {
    let mut state = state(&[0.001, 0.5, 0.001]);
    let before = state.clone();
    let mut statistics = view_statistics(&[1.9e-4, 1.9e-4, 0.0]);
    statistics[6..].copy_from_slice(&[0.0, 0.0, 0.0]);
    assert_eq!(round(&mut state, &statistics, &USUAL), Outcome::default());
    assert_eq!(state, before);
}

#[test]
fn a_small_gaussian_is_doubled_and_its_copy_has_no_history() {
    let mut state = state(&[0.019, 0.001]);
    let before = state.clone();
    let outcome = round(&mut state, &view_statistics(&[3e-4, 0.0]), &USUAL);
    assert_eq!(outcome, Outcome { cloned: 1, ..Outcome::default() });
    assert_eq!(state.values.len(), 3);
    assert_eq!(state.values.base(2), before.values.base(0));
    assert_eq!(state.values.coefficients(2), before.values.coefficients(0));
    for moments in [&state.first, &state.second] {
        assert!(moments.base(0).iter().chain(&moments.coefficients(0)).all(|v| *v == 0.5));
        assert!(moments.base(2).iter().chain(&moments.coefficients(2)).all(|v| *v == 0.0));
    }
}

#[test]
fn a_large_gaussian_is_replaced_by_two_smaller_ones_drawn_from_it() {
    let mut grown = state(&[0.001, 0.5]);
    let outcome = round(&mut grown, &view_statistics(&[0.0, 3e-4]), &USUAL);
    assert_eq!(outcome, Outcome { split: 1, ..Outcome::default() });
    assert_eq!(grown.values.len(), 3, "the original is gone");
    let original = state(&[0.001, 0.5]);
    let parent = original.values.base(1);
    for half in [1, 2] {
        let row = grown.values.base(half);
        for axis in LOG_SCALE..QUAT {
            assert!((row[axis] - (parent[axis] - 1.6_f32.ln())).abs() < 1e-6);
        }
        assert_eq!(row[QUAT..], parent[QUAT..]);
        assert_eq!(grown.values.coefficients(half), original.values.coefficients(1));
        assert!(grown.first.base(half).iter().all(|v| *v == 0.0));
    }
    assert_ne!(grown.values.base(1)[..3], grown.values.base(2)[..3]);
}

#[test]
fn the_halves_are_spread_as_the_gaussian_is() {
    let count = 4000;
    let mut state = state(&vec![0.5; count]);
    for index in 0..count {
        state.values.base_mut(index)[0] = 0.0;
    }
    let settings = GrowthSettings { max_gaussians: 100_000, ..USUAL };
    round(&mut state, &view_statistics(&vec![1.0; count]), &settings);
    let places: Vec<Vec3> =
        (0..2 * count).map(|index| Vec3::from_slice(&state.values.base(index)[..3])).collect();
    let mean = places.iter().copied().sum::<Vec3>() / places.len() as f32;
    assert!(mean.length() < 0.02, "{mean}");
    // A turn by (0.6, 0, 1.6, 0) and standard deviations 0.5, 0.05 and 0.005 along its axes.
    let turn = Mat3::from_quat(Quat::from_xyzw(0.0, 1.6, 0.0, 0.6).normalize());
    for (axis, deviation) in [0.5_f32, 0.05, 0.005].into_iter().enumerate() {
        let squares: f32 = places.iter().map(|place| turn.col(axis).dot(*place).powi(2)).sum();
        let found = (squares / places.len() as f32).sqrt();
        assert!((found / deviation - 1.0).abs() < 0.05, "axis {axis}: {found}");
    }
}

#[test]
fn the_largest_gradients_grow_first_where_not_all_may() {
    let mut state = state(&[0.001; 5]);
    let gradients = [3e-4, 9e-4, 5e-4, 9e-4, 4e-4];
    let outcome =
        round(&mut state, &view_statistics(&gradients), &GrowthSettings { max_gaussians: 7, ..USUAL });
    assert_eq!((outcome.cloned, state.values.len()), (2, 7));
    let copied: Vec<f32> = (5..7).map(|index| state.values.base(index)[0]).collect();
    assert_eq!(copied, [1.0, 3.0]);
    // Of equal ones the first.
    let mut equal = self::state(&[0.001; 4]);
    round(&mut equal, &view_statistics(&[5e-4; 4]), &GrowthSettings { max_gaussians: 6, ..USUAL });
    assert_eq!([4, 5].map(|index| equal.values.base(index)[0]), [0.0, 1.0]);
    let mut full = self::state(&[0.001, 0.5]);
    assert_eq!(
        round(&mut full, &view_statistics(&[1.0; 2]), &GrowthSettings { max_gaussians: 1, ..USUAL }),
        Outcome::default()
    );
}

#[test]
fn transparent_gaussians_go_at_once_and_large_ones_after_the_first_reset() {
    let make = || {
        let mut state = state(&[0.01, 0.01, 0.21, 0.01, 0.19]);
        state.values.base_mut(0)[OPACITY] = logit(0.004);
        state.values.base_mut(1)[OPACITY] = logit(0.006);
        state
    };
    let mut statistics = view_statistics(&[0.0; 5]);
    statistics[3 * STATISTICS + 2] = 21.0;
    statistics[4 * STATISTICS + 2] = 19.0;
    let mut early = make();
    assert_eq!(round(&mut early, &statistics, &USUAL), Outcome { pruned: 1, ..Outcome::default() });
    let mut late = make();
    let settings = GrowthSettings { prune_large: true, ..USUAL };
    assert_eq!(round(&mut late, &statistics, &settings), Outcome { pruned: 3, ..Outcome::default() });
    let left: Vec<f32> = (0..late.values.len()).map(|index| late.values.base(index)[0]).collect();
    assert_eq!(left, [1.0, 4.0]);
}

#[test]
fn a_gaussian_without_a_rotation_is_split_into_finite_ones() {
    let mut state = state(&[0.5]);
    state.values.base_mut(0)[QUAT..OPACITY].fill(0.0);
    round(&mut state, &view_statistics(&[1.0]), &USUAL);
    assert_eq!(state.values.len(), 2);
    assert!(state.values.base.iter().all(|v| v.is_finite()));
}

#[test]
fn the_same_seed_grows_the_same_and_another_seed_does_not() {
    let grown = |seed| {
        let mut state = state(&[0.5; 20]);
        grow_and_prune(&mut state, &view_statistics(&[1.0; 20]), &USUAL, &mut Pcg64::seed_from_u64(seed));
        state
    };
    assert_eq!(grown(1), grown(1));
    assert_ne!(grown(1), grown(2));
}

#[test]
fn a_reset_lowers_opacities_and_forgets_only_how_they_moved() {
    let mut state = state(&[0.1; 2]);
    state.values.base_mut(1)[OPACITY] = logit(0.005);
    let before = state.clone();
    reset_opacities(&mut state);
    assert_eq!(state.values.base(0)[OPACITY], logit(0.01));
    assert_eq!(state.values.base(1)[OPACITY], logit(0.005));
    for index in 0..2 {
        for column in (0..BASE).filter(|column| *column != OPACITY) {
            assert_eq!(state.values.base(index)[column], before.values.base(index)[column]);
            assert_eq!(state.first.base(index)[column], 0.5);
        }
        assert_eq!((state.first.base(index)[OPACITY], state.second.base(index)[OPACITY]), (0.0, 0.0));
    }
}
