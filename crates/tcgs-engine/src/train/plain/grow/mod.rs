//! Growth and pruning of plain Gaussians, and the reset of their opacities, as published with 3D Gaussian splatting.
//!
//! Pure functions of rows, statistics and a random generator, in the order of the rows. A Gaussian whose mean screen
//! gradient is large grows: a small one is cloned, a large one is split into two smaller ones drawn from it. Nearly transparent
//! ones are pruned, and after the first reset of opacities those that are too large in the world or on screen.

use glam::{Quat, Vec3};
use rand::{Rng, RngExt};

use crate::{
    init::logit,
    model::{
        GaussianRows,
        gaussian_rows::{LOG_SCALE, OPACITY, QUAT},
    },
    render::STATISTICS,
};

/// Largest size of a Gaussian that is doubled and not split, in extents of the scene.
const DENSE: f32 = 0.01;
/// Factor by which the halves of a split Gaussian are smaller.
const SHRINK: f32 = 1.6;
/// Opacity below which a Gaussian is pruned.
const MIN_OPACITY: f32 = 0.005;
/// Size above which it is pruned after the first reset of opacities, in extents of the scene.
const MAX_SIZE: f32 = 0.1;
/// Radius on screen, in pixels, above which it is pruned after the first reset of opacities.
const MAX_RADIUS: f32 = 20.0;
/// Largest opacity after a reset.
const RESET_OPACITY: f32 = 0.01;

/// The settings of one round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct GrowthSettings {
    /// Mean screen gradient, in half-image units, from which a Gaussian grows.
    pub threshold: f32,
    /// Radius of the cameras, in world units.
    pub extent: f32,
    /// Largest number of Gaussians; those with the largest gradients grow first.
    pub max_gaussians: usize,
    /// Whether Gaussians that are too large are pruned.
    pub prune_large: bool,
}

/// Gaussians with all per-Gaussian state of their training.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TrainableGaussians {
    /// Parameters.
    pub values: GaussianRows,
    /// First moments.
    pub first: GaussianRows,
    /// Second moments.
    pub second: GaussianRows,
}

/// The result of one round.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Outcome {
    /// Gaussians that were doubled.
    pub cloned: usize,
    /// Gaussians that were replaced by two.
    pub split: usize,
    /// Gaussians that were removed, split ones not counted.
    pub pruned: usize,
}

impl TrainableGaussians {
    /// Appends a copy of Gaussian `index` with zero moments; returns its index.
    fn push_copy(&mut self, index: usize) -> usize {
        self.values.push_copy(index);
        self.first.push_zero();
        self.second.push_zero();
        self.values.len() - 1
    }

    /// Removes the Gaussians that are not kept.
    pub(super) fn retain(&mut self, keep: &[bool]) {
        self.values.retain(keep);
        self.first.retain(keep);
        self.second.retain(keep);
    }
}

/// One round of growth, then pruning. `statistics` has a row a Gaussian: sum of gradient norms, views, largest radius.
pub(super) fn grow_and_prune(
    state: &mut TrainableGaussians,
    statistics: &[f32],
    settings: &GrowthSettings,
    rng: &mut impl Rng,
) -> Outcome {
    let before = state.values.len();
    let mut outcome = Outcome::default();
    let mut keep = vec![true; before];
    for index in chosen(statistics, settings, before) {
        if size(&state.values, index) <= DENSE * settings.extent {
            state.push_copy(index);
            outcome.cloned += 1;
        } else {
            for _ in 0..2 {
                let half = state.push_copy(index);
                shrink_and_move(state.values.base_mut(half), rng);
            }
            keep[index] = false;
            outcome.split += 1;
        }
    }
    keep.resize(state.values.len(), true);
    for (index, keep) in keep.iter_mut().enumerate().filter(|(_, keep)| **keep) {
        let transparent = state.values.base(index)[OPACITY] < logit(MIN_OPACITY);
        // New Gaussians have no statistics yet.
        let radius = if index < before { statistics[index * STATISTICS + 2] } else { 0.0 };
        let large = size(&state.values, index) > MAX_SIZE * settings.extent || radius > MAX_RADIUS;
        if transparent || (settings.prune_large && large) {
            *keep = false;
            outcome.pruned += 1;
        }
    }
    state.retain(&keep);
    outcome
}

/// The Gaussians that grow, ascending: those with the largest gradients if the limit does not allow all.
fn chosen(statistics: &[f32], settings: &GrowthSettings, count: usize) -> Vec<usize> {
    let mut wanted: Vec<(f32, usize)> = statistics
        .chunks_exact(STATISTICS)
        .take(count)
        .enumerate()
        .filter(|(_, row)| row[1] > 0.0)
        .map(|(index, row)| (row[0] / row[1], index))
        .filter(|(gradient, _)| *gradient >= settings.threshold)
        .collect();
    // Cloning and splitting both add one.
    let room = settings.max_gaussians.saturating_sub(count);
    if wanted.len() > room {
        wanted.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanted.truncate(room);
    }
    let mut chosen: Vec<usize> = wanted.into_iter().map(|(_, index)| index).collect();
    chosen.sort_unstable();
    chosen
}

/// The largest standard deviation of a Gaussian.
fn size(rows: &GaussianRows, index: usize) -> f32 {
    rows.base(index)[LOG_SCALE..QUAT].iter().copied().fold(f32::NEG_INFINITY, f32::max).exp()
}

/// Moves a Gaussian to a position drawn from it and shrinks it.
fn shrink_and_move(row: &mut [f32], rng: &mut impl Rng) {
    let [w, x, y, z] = std::array::from_fn(|k| row[QUAT + k]);
    let turn = Quat::from_xyzw(x, y, z, w);
    let turn = if turn.length_squared() > 0.0 { turn.normalize() } else { Quat::IDENTITY };
    let along = Vec3::from_array(std::array::from_fn(|axis| row[LOG_SCALE + axis].exp() * normal(rng)));
    for (value, shift) in row[..LOG_SCALE].iter_mut().zip((turn * along).to_array()) {
        *value += shift;
    }
    for value in &mut row[LOG_SCALE..QUAT] {
        *value -= SHRINK.ln();
    }
}

/// A draw from the standard normal distribution (Box and Muller).
fn normal(rng: &mut impl Rng) -> f32 {
    // In (0, 1], to avoid the logarithm of zero.
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    (radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()) as f32
}

/// Lowers every opacity to at most 0.01 and clears its moments, so that Gaussians without support in the photographs fade out.
pub(super) fn reset_opacities(state: &mut TrainableGaussians) {
    let max = logit(RESET_OPACITY);
    for index in 0..state.values.len() {
        let value = &mut state.values.base_mut(index)[OPACITY];
        *value = value.min(max);
        state.first.base_mut(index)[OPACITY] = 0.0;
        state.second.base_mut(index)[OPACITY] = 0.0;
    }
}

#[cfg(test)]
mod tests;
