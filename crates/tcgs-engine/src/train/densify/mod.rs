//! Growth and pruning of anchors (METHOD.md §2.7), on the host.
//!
//! Cells stay distinct: a candidate whose coarse cell already holds an anchor is dropped, and an anchor that is added
//! stands at its coarse cell's lattice point.

use std::collections::{BTreeMap, HashSet};

use rand::{Rng, RngExt};

use super::{MaskRows, Statistics};
use crate::{
    init::{MAX_CELL, cell_of, coarse},
    model::{AnchorRows, all_offsets, retain_rows},
};

/// Anchors whose mean opacity is below this are pruned.
const MIN_OPACITY: f32 = 0.005;
/// Largest log of a base size, in units of the logarithm of the scene's extent (METHOD.md §2.7, made relative).
const MAX_LOG_SIZE: f32 = 0.05;
/// Levels of growth.
const LEVELS: u32 = 3;

/// The settings of one round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DensifySettings {
    /// Threshold on the mean screen gradient at the coarsest level; it doubles with each finer level.
    pub threshold: f32,
    /// Views that an offset must have been seen in.
    pub min_views: f32,
    /// Visits after which an anchor may be pruned.
    pub min_visits: f32,
    /// Coarsest growth cell in lattice cells; each finer level divides it by 4.
    pub coarsest: i32,
    /// Anchors that growth does not go beyond.
    pub max_anchors: usize,
    /// Radius of the cameras, in world units.
    pub extent: f32,
}

/// Anchors with all per-anchor state of their training.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainableAnchors {
    /// Anchors and rows.
    pub anchors: AnchorRows,
    /// First moments of the rows.
    pub first: Vec<f32>,
    /// Second moments of the rows.
    pub second: Vec<f32>,
    /// The masks' logits, while they learn.
    pub masks: Option<MaskRows>,
}

/// The result of one round.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Outcome {
    /// Anchors added.
    pub grown: usize,
    /// Anchors removed.
    pub pruned: usize,
}

/// One round of growth, then pruning.
pub fn densify(
    state: &mut TrainableAnchors,
    statistics: &mut Statistics,
    settings: &DensifySettings,
    rng: &mut impl Rng,
) -> Outcome {
    let before = state.anchors.len();
    let grown = grow(state, statistics, settings, rng);
    reset_seen_offsets(statistics, before, settings.min_views);
    let width = Statistics::width(statistics.shape);
    statistics.values.resize(state.anchors.len() * width, 0.0);
    let pruned = prune(state, statistics, settings);
    clamp_sizes(state, settings.extent);
    Outcome { grown, pruned }
}

/// Adds anchors where offsets moved much on screen; returns how many.
fn grow(
    state: &mut TrainableAnchors,
    statistics: &Statistics,
    settings: &DensifySettings,
    rng: &mut impl Rng,
) -> usize {
    let shape = state.anchors.shape;
    let existing = state.anchors.len();
    let candidates: Vec<(usize, [i32; 3], f32)> = (0..existing)
        .flat_map(|anchor| (0..shape.offsets).map(move |offset| (anchor, offset)))
        .filter(|(anchor, offset)| statistics.views(*anchor, *offset) > settings.min_views)
        .map(|(anchor, offset)| {
            let cell = cell_of(&state.anchors.lattice, offset_position(&state.anchors, anchor, offset));
            (anchor, cell, statistics.mean_gradient(anchor, offset))
        })
        .collect();
    let mut added = 0;
    for level in 0..LEVELS {
        let factor = settings.coarsest / 4_i32.pow(level);
        // A finer level follows only a level that added anchors; cells cannot be finer than the lattice.
        if factor < 1 || (level > 0 && added == 0) {
            break;
        }
        let threshold = settings.threshold * 2.0_f32.powi(level as i32);
        let keep = 1.0 - 0.5_f32.powi(level as i32 + 1);
        let occupied: HashSet<[i32; 3]> =
            state.anchors.cells.iter().map(|cell| coarse(*cell, factor)).collect();
        let mut wanted: BTreeMap<[i32; 3], Candidates> = BTreeMap::new();
        for (anchor, cell, gradient) in &candidates {
            let kept = rng.random::<f32>() < keep;
            if kept && *gradient >= threshold {
                let cell = coarse(*cell, factor);
                if !occupied.contains(&cell) {
                    let candidates = wanted.entry(cell).or_default();
                    candidates.parents.push(*anchor);
                    candidates.gradient = candidates.gradient.max(*gradient);
                }
            }
        }
        keep_largest_gradients(&mut wanted, settings.max_anchors.saturating_sub(state.anchors.len()));
        let log_scale = (factor as f32 * state.anchors.lattice.voxel).ln();
        for (cell, Candidates { parents, .. }) in wanted {
            // A coarse cell may be centered beyond the last lattice cell; clamped to it, it still rounds to itself.
            let cell = cell.map(|c| (c * factor).clamp(-MAX_CELL, MAX_CELL));
            push_anchor(state, cell, &parents, log_scale);
            added += 1;
        }
    }
    added
}

/// The offsets that ask for an anchor in a cell.
#[derive(Debug, Default)]
struct Candidates {
    /// The anchor of each.
    parents: Vec<usize>,
    /// The largest mean screen gradient among them.
    gradient: f32,
}

/// Keeps at most `room` cells: those whose candidates moved most on screen, the first cells among equals.
fn keep_largest_gradients(wanted: &mut BTreeMap<[i32; 3], Candidates>, room: usize) {
    if wanted.len() > room {
        let mut order: Vec<(f32, [i32; 3])> =
            wanted.iter().map(|(cell, candidates)| (candidates.gradient, *cell)).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, cell) in &order[room..] {
            wanted.remove(cell);
        }
    }
}

fn offset_position(anchors: &AnchorRows, anchor: usize, offset: usize) -> [f32; 3] {
    let row = anchors.row(anchor);
    let base = anchors.lattice.position(anchors.cells[anchor]);
    let (s, o) = (anchors.shape.scaling_column(), anchors.shape.offset_column() + 3 * offset);
    std::array::from_fn(|axis| base[axis] + row[o + axis] * row[s + axis].exp())
}

/// A new anchor: its feature is the elementwise maximum of its parents', its offsets are zero.
fn push_anchor(state: &mut TrainableAnchors, cell: [i32; 3], parents: &[usize], log_scale: f32) {
    let shape = state.anchors.shape;
    let mut row = vec![0.0; shape.row()];
    for (index, value) in row[..shape.features].iter_mut().enumerate() {
        *value =
            parents.iter().map(|parent| state.anchors.row(*parent)[index]).fold(f32::NEG_INFINITY, f32::max);
    }
    row[shape.scaling_column()..shape.offset_column()].fill(log_scale);
    state.anchors.cells.push(cell);
    state.anchors.values.extend_from_slice(&row);
    state.anchors.masks.push(all_offsets(shape));
    state.first.resize(state.anchors.values.len(), 0.0);
    state.second.resize(state.anchors.values.len(), 0.0);
    if let Some(masks) = &mut state.masks {
        masks.extend(shape.offsets);
    }
}

/// Resets the statistics of offsets that were eligible; those of the others accumulate further.
fn reset_seen_offsets(statistics: &mut Statistics, anchors: usize, min_views: f32) {
    let offsets = statistics.shape.offsets;
    for anchor in 0..anchors {
        let row = statistics.row_mut(anchor);
        for offset in 0..offsets {
            if row[offsets + offset] > min_views {
                row[offset] = 0.0;
                row[offsets + offset] = 0.0;
            }
        }
    }
}

/// Removes anchors that were visited often and stayed transparent, and those that have no offset left; returns how many.
fn prune(state: &mut TrainableAnchors, statistics: &mut Statistics, settings: &DensifySettings) -> usize {
    let offsets = statistics.shape.offsets;
    let mut keep = with_offsets(state);
    for (anchor, keep) in keep.iter_mut().enumerate() {
        let (opacity, visits) = statistics.opacity_and_visits(anchor);
        if visits > settings.min_visits {
            *keep &= opacity >= MIN_OPACITY * visits;
            let row = statistics.row_mut(anchor);
            row[2 * offsets] = 0.0;
            row[2 * offsets + 1] = 0.0;
        }
    }
    retain(state, statistics, &keep)
}

/// Which anchors have an offset left.
fn with_offsets(state: &TrainableAnchors) -> Vec<bool> {
    state.anchors.masks.iter().map(|mask| *mask != 0).collect()
}

/// Removes the anchors that have no offset left; returns how many.
pub(super) fn drop_masked(state: &mut TrainableAnchors, statistics: &mut Statistics) -> usize {
    let keep = with_offsets(state);
    retain(state, statistics, &keep)
}

/// Removes the anchors that are not kept; returns how many there were.
fn retain(state: &mut TrainableAnchors, statistics: &mut Statistics, keep: &[bool]) -> usize {
    let dropped = keep.iter().filter(|keep| !**keep).count();
    if dropped > 0 {
        let shape = state.anchors.shape;
        retain_rows(&mut state.anchors.values, shape.row(), keep);
        retain_rows(&mut state.first, shape.row(), keep);
        retain_rows(&mut state.second, shape.row(), keep);
        retain_rows(&mut state.anchors.cells, 1, keep);
        retain_rows(&mut state.anchors.masks, 1, keep);
        retain_rows(&mut statistics.values, Statistics::width(shape), keep);
        if let Some(masks) = &mut state.masks {
            retain_rows(&mut masks.logits, shape.offsets, keep);
            retain_rows(&mut masks.first, shape.offsets, keep);
            retain_rows(&mut masks.second, shape.offsets, keep);
        }
    }
    dropped
}

fn clamp_sizes(state: &mut TrainableAnchors, extent: f32) {
    let shape = state.anchors.shape;
    let largest = MAX_LOG_SIZE + extent.max(f32::MIN_POSITIVE).ln();
    for row in state.anchors.values.chunks_exact_mut(shape.row()) {
        for value in &mut row[shape.scaling_column() + 3..shape.offset_column()] {
            *value = value.min(largest);
        }
    }
}

#[cfg(test)]
mod tests;
