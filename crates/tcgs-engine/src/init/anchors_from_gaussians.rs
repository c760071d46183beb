//! Anchors and render networks that begin as a set of plain Gaussians.
//!
//! Gaussians of a cell become offsets of one anchor, whose networks begin with what the Gaussians are. An offset that no Gaussian
//! took begins transparent.

use std::collections::{BTreeMap, HashSet};

use glam::{Mat3, Quat, Vec3};
use rand::{Rng, RngExt};

use super::{
    FirstAnchors, InitError, MAX_CELL, PassingUnits, VoxelRule, cell_of, cell_within, choose_lattice, coarse,
    first_anchors::{SLOT, SlotTargets},
};
use crate::domain::Lattice;
use crate::model::all_offsets;
use crate::model::{
    AnchorRows, GaussianRows, ModelShape,
    gaussian_rows::{COLOR, LOG_SCALE, OPACITY, QUAT, SH_CONSTANT},
};

/// Target of the opacity network for an offset without a Gaussian, before its tanh.
const TRANSPARENT: f64 = -0.3;
/// Opacity below which a Gaussian is left out, unless all are below it.
const VISIBLE: f32 = 0.05;
/// Opacities that a Gaussian's is held to.
const OPACITIES: [f32; 2] = [0.005, 0.95];
/// Color channels that a Gaussian's is held to: the logistic's reach.
const COLORS: [f32; 2] = [0.01, 0.99];
/// Largest distance of a size's logit from zero.
const SIZE_LOGIT: f32 = 2.5;
/// Weights of random hidden units to the outputs, by the usual.
const RANDOM: f32 = 0.1;
/// Size of an anchor, by the mean size of its Gaussians: the logistic of zero is a half.
const SIZE: f32 = 2.0;

/// A Gaussian as an anchor's offset.
#[derive(Debug, Clone, Copy)]
struct Member {
    mean: Vec3,
    log_scale: [f32; 3],
    quat: [f32; 4],
    opacity: f32,
    color: [f32; 3],
}

impl Member {
    fn of(row: &[f32]) -> Self {
        let quat = Quat::from_xyzw(row[QUAT + 1], row[QUAT + 2], row[QUAT + 3], row[QUAT]);
        let quat = if quat.length_squared() > 0.0 { quat.normalize() } else { Quat::IDENTITY };
        let (quat, log_scale) = nearest_to_the_axes(quat, std::array::from_fn(|axis| row[LOG_SCALE + axis]));
        Self {
            mean: Vec3::new(row[0], row[1], row[2]),
            log_scale,
            quat: [quat.w, quat.x, quat.y, quat.z],
            opacity: (1.0 / (1.0 + (-row[OPACITY]).exp())).clamp(OPACITIES[0], OPACITIES[1]),
            color: std::array::from_fn(|c| (0.5 + SH_CONSTANT * row[COLOR + c]).clamp(COLORS[0], COLORS[1])),
        }
    }

    fn is_finite(&self) -> bool {
        let values = self.log_scale.iter().chain(&self.quat).chain(&self.color);
        self.mean.is_finite() && self.opacity.is_finite() && values.copied().all(f32::is_finite)
    }

    /// About how much of a picture it covers: opacity times the area of its two longer axes.
    fn weight(&self) -> f32 {
        let mut scales = self.log_scale;
        scales.sort_by(f32::total_cmp);
        self.opacity * (scales[1] + scales[2]).exp()
    }
}

/// The same Gaussian with its axes named and turned so that the quaternion's w is largest: of the 24 representations, the one
/// in which neighbors are most alike.
fn nearest_to_the_axes(quat: Quat, log_scale: [f32; 3]) -> (Quat, [f32; 3]) {
    const ORDERS: [([usize; 3], f32); 6] = [
        ([0, 1, 2], 1.0),
        ([1, 2, 0], 1.0),
        ([2, 0, 1], 1.0),
        ([0, 2, 1], -1.0),
        ([2, 1, 0], -1.0),
        ([1, 0, 2], -1.0),
    ];
    let axes = Mat3::from_quat(quat);
    let mut best = (f32::NEG_INFINITY, Mat3::IDENTITY, [0, 1, 2]);
    for (order, parity) in ORDERS {
        let along: [f32; 3] = std::array::from_fn(|axis| axes.col(order[axis])[axis]);
        let mut signs = along.map(|v| if v < 0.0 { -1.0_f32 } else { 1.0 });
        if signs.iter().product::<f32>() * parity < 0.0 {
            let flattest = (0..3).min_by(|a, b| along[*a].abs().total_cmp(&along[*b].abs())).unwrap_or(0);
            signs[flattest] = -signs[flattest];
        }
        let trace: f32 = along.iter().zip(signs).map(|(v, sign)| v * sign).sum();
        if trace > best.0 {
            let [x, y, z] = std::array::from_fn(|axis| signs[axis] * axes.col(order[axis]));
            best = (trace, Mat3::from_cols(x, y, z), order);
        }
    }
    let (_, axes, order) = best;
    let quat = Quat::from_mat3(&axes).normalize();
    (if quat.w < 0.0 { -quat } else { quat }, order.map(|axis| log_scale[axis]))
}

/// Anchors and networks that make about the visible Gaussians of `rows`, at most `max_anchors`, on a lattice by `rule` for their
/// means; values that no Gaussian determines are drawn from `rng`. Gaussians within `cell` lattice cells become one anchor; a crowded cell is halved.
///
/// # Errors
/// [`InitError`] for no Gaussians, or none whose values are all finite.
pub fn anchors_from_gaussians(
    rows: &GaussianRows,
    rule: impl FnOnce(&[[f32; 3]]) -> VoxelRule,
    cell: i32,
    shape: ModelShape,
    max_anchors: usize,
    units: PassingUnits,
    rng: &mut impl Rng,
) -> Result<FirstAnchors, InitError> {
    if rows.is_empty() {
        return Err(InitError::NoPoints);
    }
    let mut members: Vec<Member> = (0..rows.len()).map(|index| Member::of(rows.base(index))).collect();
    members.retain(Member::is_finite);
    if members.is_empty() {
        return Err(InitError::NonFinite(0));
    }
    if members.iter().any(|member| member.opacity >= VISIBLE) {
        members.retain(|member| member.opacity >= VISIBLE);
    }
    let points: Vec<[f32; 3]> = members.iter().map(|member| member.mean.to_array()).collect();
    let lattice = choose_lattice(&points, rule(&points));
    members.retain(|member| cell_within(&lattice, member.mean.to_array()).is_some());
    let groups = groups(&lattice, &members, cell, shape.offsets, max_anchors);
    let mut anchors = AnchorRows {
        shape,
        lattice,
        cells: place(&lattice, &groups),
        values: vec![0.0; groups.len() * shape.row()],
        masks: vec![all_offsets(shape); groups.len()],
    };
    let mut slots = SlotTargets::with_capacity(groups.len() * shape.offsets);
    for (index, group) in groups.iter().enumerate() {
        let position = Vec3::from_array(lattice.position(anchors.cells[index]));
        let row = &mut anchors.values[index * shape.row()..][..shape.row()];
        write_geometry(row, shape, &lattice, position, group, rng);
        push_targets(row, shape, group, &mut slots);
    }
    Ok(FirstAnchors::from_slot_targets(anchors, slots, units, [RANDOM; 3], rng))
}

/// The Gaussians of one anchor, the weightiest first, and the edge of their cell in lattice cells.
struct Group {
    members: Vec<Member>,
    cell: i32,
}

/// Gaussians by cells of an edge of `cell`, at most `max_members` in each and at most `max_groups` cells, but at least one. Where the limit does not allow to
/// divide crowded cells, only their weightiest are kept.
fn groups(
    lattice: &Lattice,
    members: &[Member],
    cell: i32,
    max_members: usize,
    max_groups: usize,
) -> Vec<Group> {
    let mut found = Vec::new();
    split(lattice, members.to_vec(), max_members, cell, 1, &mut found);
    let mut cell = cell;
    while found.len() > max_groups.max(1) && cell < MAX_CELL {
        found.clear();
        split(lattice, members.to_vec(), max_members, cell, cell, &mut found);
        cell *= 2;
    }
    found
}

/// Divides crowded cells of an edge of `cell` down to one of `min_cell`.
fn split(
    lattice: &Lattice,
    members: Vec<Member>,
    max_members: usize,
    cell: i32,
    min_cell: i32,
    found: &mut Vec<Group>,
) {
    let mut cells: BTreeMap<[i32; 3], Vec<Member>> = BTreeMap::new();
    for member in members {
        cells.entry(coarse(cell_of(lattice, member.mean.to_array()), cell)).or_default().push(member);
    }
    for (_, mut members) in cells {
        if members.len() > max_members && cell > min_cell {
            split(lattice, members, max_members, cell / 2, min_cell, found);
        } else {
            members.sort_by(|a, b| b.weight().total_cmp(&a.weight()));
            members.truncate(max_members);
            found.push(Group { members, cell });
        }
    }
}

/// Distinct cells, each the free one nearest (along x) to its group's mean.
fn place(lattice: &Lattice, groups: &[Group]) -> Vec<[i32; 3]> {
    let mut taken = HashSet::new();
    let mut free = |group: &Group| {
        let sum: Vec3 = group.members.iter().map(|member| member.mean).sum();
        let [x, y, z] = cell_of(lattice, (sum / group.members.len() as f32).to_array());
        (0..).flat_map(|away| [[x + away, y, z], [x - away, y, z]]).find(|cell| taken.insert(*cell))
    };
    groups.iter().filter_map(&mut free).collect()
}

/// Log-scalings and offsets. Offsets without a Gaussian lie anywhere in the cell.
fn write_geometry(
    row: &mut [f32],
    shape: ModelShape,
    lattice: &Lattice,
    position: Vec3,
    group: &Group,
    rng: &mut impl Rng,
) {
    let reach = 0.5 * group.cell as f32 * lattice.voxel;
    let (scalings, offsets) = row[shape.scaling_column()..].split_at_mut(6);
    scalings[..3].fill(reach.ln());
    for (axis, scaling) in scalings[3..].iter_mut().enumerate() {
        let sum: f32 = group.members.iter().map(|member| member.log_scale[axis]).sum();
        *scaling = sum / group.members.len() as f32 + SIZE.ln();
    }
    for (slot, offset) in offsets.chunks_exact_mut(3).enumerate() {
        let at = group.members.get(slot).map(|member| ((member.mean - position) / reach).to_array());
        let at = at.unwrap_or_else(|| std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        offset.copy_from_slice(&at);
    }
}

/// Appends the targets of an anchor's slots.
fn push_targets(row: &[f32], shape: ModelShape, group: &Group, to: &mut SlotTargets) {
    let slots: Vec<[f64; SLOT]> = group
        .members
        .iter()
        .map(|member| {
            let mut slot = [0.0; SLOT];
            slot[0] = f64::from(member.opacity.atanh());
            for axis in 0..3 {
                let share = (member.log_scale[axis] - row[shape.scaling_column() + 3 + axis]).exp();
                let share = share.clamp(1e-3, 1.0 - 1e-3);
                slot[1 + axis] = f64::from((share / (1.0 - share)).ln().clamp(-SIZE_LOGIT, SIZE_LOGIT));
            }
            for (to, value) in slot[4..8].iter_mut().zip(member.quat) {
                *to = f64::from(value);
            }
            for (to, value) in slot[8..].iter_mut().zip(member.color) {
                *to = f64::from((value / (1.0 - value)).ln());
            }
            slot
        })
        .collect();
    let mut mean = [0.0; SLOT];
    for (value, mean) in mean.iter_mut().enumerate() {
        *mean = slots.iter().map(|slot| slot[value]).sum::<f64>() / slots.len() as f64;
    }
    mean[0] = TRANSPARENT;
    for index in 0..shape.offsets {
        match slots.get(index) {
            Some(slot) => to.push(slot, |_| true),
            None => to.push(&mean, |value| value == 0),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{domain::ViewDegree, init::first_anchors::tests::outputs, model::NetworkLayout};

    const SHAPE: ModelShape = ModelShape::new(16, 4);

    /// Gaussians over a sphere whose color, size and opacity change slowly along it.
    fn sphere(count: usize) -> GaussianRows {
        let mut rows = GaussianRows::zero(count);
        for index in 0..count {
            let z = 1.0 - 2.0 * (index as f32 + 0.5) / count as f32;
            let turn = 2.4 * index as f32;
            let mean = Vec3::new((1.0 - z * z).sqrt() * turn.cos(), (1.0 - z * z).sqrt() * turn.sin(), z);
            let row = rows.base_mut(index);
            row[..LOG_SCALE].copy_from_slice(&mean.to_array());
            row[LOG_SCALE..QUAT].copy_from_slice(&[-3.0 + 0.2 * z, -3.2, -3.4]);
            row[QUAT..OPACITY].copy_from_slice(&[1.0, 0.1 * mean.x, 0.1 * mean.y, 0.0]);
            row[OPACITY] = 1.0 + 0.5 * mean.x;
            row[COLOR..].copy_from_slice(&[mean.x, mean.y, 0.5 * mean.z]);
        }
        rows
    }

    fn begin(rows: &GaussianRows, max_anchors: usize) -> FirstAnchors {
        begin_with(rows, max_anchors, PassingUnits::LINEAR)
    }

    fn begin_with(rows: &GaussianRows, max_anchors: usize, units: PassingUnits) -> FirstAnchors {
        let rule = |means: &[[f32; 3]]| VoxelRule::OfSpacing(1.0 / 16.0).for_points(means, 1.0);
        let mut rng = Pcg64::seed_from_u64(1);
        anchors_from_gaussians(rows, rule, 24, SHAPE, max_anchors, units, &mut rng).expect("anchors")
    }

    #[test]
    fn anchors_make_about_the_gaussians_that_they_were_made_of() {
        let rows = sphere(600);
        let first = begin(&rows, 1000);
        let anchors = &first.anchors;
        assert!((150..500).contains(&anchors.len()), "{}", anchors.len());
        let distinct: HashSet<_> = anchors.cells.iter().collect();
        assert_eq!(distinct.len(), anchors.len());
        let logistic = |v: f32| 1.0 / (1.0 + (-v).exp());
        let (mut live, mut worst_color, mut worst_opacity, mut worst_size) = (0, 0.0_f32, 0.0_f32, 0.0_f32);
        for anchor in 0..anchors.len() {
            let row = anchors.row(anchor);
            let said = outputs(&first, anchor);
            let base = Vec3::from_array(anchors.lattice.position(anchors.cells[anchor]));
            let reach = row[SHAPE.scaling_column()].exp();
            for slot in (0..SHAPE.offsets).filter(|slot| said[*slot] > 0.0) {
                live += 1;
                let at = base + reach * Vec3::from_slice(&row[SHAPE.offset_column() + 3 * slot..][..3]);
                let of = |i: &usize| Vec3::from_slice(&rows.base(*i)[..3]).distance(at);
                let gaussian = (0..600).min_by(|a, b| of(a).total_cmp(&of(b))).expect("one");
                assert!(of(&gaussian) < 1e-4, "an offset without a Gaussian shows");
                let expected = Member::of(rows.base(gaussian));
                worst_opacity = worst_opacity.max((said[slot].tanh() - expected.opacity).abs());
                for c in 0..3 {
                    let found = logistic(said[8 * SHAPE.offsets + 3 * slot + c]);
                    worst_color = worst_color.max((found - expected.color[c]).abs());
                    let size = logistic(said[SHAPE.offsets + 7 * slot + c])
                        * row[SHAPE.scaling_column() + 3 + c].exp();
                    worst_size = worst_size.max((size / expected.log_scale[c].exp()).ln().abs());
                }
            }
        }
        assert_eq!(live, 600, "every Gaussian shows");
        assert!(
            worst_color < 0.1 && worst_opacity < 0.1 && worst_size < 0.2,
            "{worst_color} {worst_opacity} {worst_size}"
        );
    }

    /// The share of hidden units that pass components on and are cut off, seen from a side.
    fn cut_off(first: &FirstAnchors, side: [f32; 3]) -> f64 {
        let hidden = NetworkLayout::new(SHAPE).hidden;
        let (mut cut, mut all) = (0, 0);
        for anchor in 0..first.anchors.len() {
            let mut input = first.anchors.row(anchor)[..SHAPE.features].to_vec();
            input.extend(side);
            // Three quarters of each head's units; the last input is the distance, which they do not see.
            for unit in (0..3)
                .flat_map(|head| (0..SHAPE.features * 3 / 4).map(move |unit| head * SHAPE.features + unit))
            {
                let weight = |input: usize| first.networks[hidden.weights + input * hidden.outputs + unit];
                let sum: f32 = input.iter().enumerate().map(|(index, value)| weight(index) * value).sum();
                cut += usize::from(first.networks[hidden.bias + unit] + sum < 0.0);
                all += 1;
            }
        }
        cut as f64 / all as f64
    }

    #[test]
    fn rectifying_units_cut_off_a_sixth_and_linear_ones_hardly_any() {
        let rows = sphere(600);
        let (side, other) = ([0.6, 0.0, 0.8], [0.0, -1.0, 0.0]);
        let linear = begin_with(&rows, 1000, PassingUnits::LINEAR);
        let rectifying = begin_with(&rows, 1000, PassingUnits::RECTIFYING);
        assert_eq!(linear.anchors, rectifying.anchors);
        assert!(cut_off(&linear, side) < 0.02, "{}", cut_off(&linear, side));
        let shares = [side, other].map(|side| cut_off(&rectifying, side));
        assert!(shares.iter().all(|share| (0.1..0.25).contains(share)), "{shares:?}");
        assert_ne!(shares[0], shares[1], "others from another side");
    }

    #[test]
    fn harmonics_begin_a_tenth_as_strong_and_the_distance_unseen() {
        let shape = ModelShape { view_degree: ViewDegree::MAX, ..SHAPE };
        let rule = |means: &[[f32; 3]]| VoxelRule::OfSpacing(1.0 / 16.0).for_points(means, 1.0);
        let (units, mut rng) = (PassingUnits::RECTIFYING, Pcg64::seed_from_u64(1));
        let first =
            anchors_from_gaussians(&sphere(600), rule, 24, shape, 1000, units, &mut rng).expect("anchors");
        let hidden = NetworkLayout::new(shape).hidden;
        let largest = |inputs: std::ops::Range<usize>, unit: usize| {
            let weights =
                inputs.map(|input| first.networks[hidden.weights + input * hidden.outputs + unit].abs());
            weights.fold(0.0, f32::max)
        };
        let usual = 1.0 / (hidden.inputs as f32).sqrt();
        let f = shape.features;
        for unit in 0..f * 3 / 4 {
            assert_eq!(largest(f + 3..f + 4, unit), 0.0, "the distance");
            assert!(
                (0.01 * usual..=0.1 * usual).contains(&largest(f + 4..hidden.inputs, unit)),
                "unit {unit}"
            );
        }
        let of_direction = (0..f * 3 / 4).map(|unit| largest(f..f + 3, unit)).fold(0.0, f32::max);
        assert!(of_direction > 0.5 * usual);
    }

    #[test]
    fn crowds_are_divided_limits_kept_and_what_is_transparent_left_out() {
        let mut rows = sphere(600);
        assert!(begin(&rows, 20).anchors.len() <= 20);
        for index in 100..600 {
            rows.base_mut(index)[OPACITY] = -4.0;
        }
        assert!(begin(&rows, 1000).anchors.len() <= 100);
        for index in 0..600 {
            rows.base_mut(index)[OPACITY] = -9.0;
        }
        assert!(begin(&rows, 1000).anchors.len() > 100, "better than nothing");
        let mut crowd = GaussianRows::zero(50);
        for index in 0..50 {
            crowd.base_mut(index)[..3].copy_from_slice(&[1e-3 * index as f32, 0.0, 0.0]);
        }
        assert!(begin(&crowd, 1000).anchors.len() >= 13, "four offsets per anchor");
    }

    #[test]
    fn gaussians_that_no_scene_can_begin_with_are_named() {
        let refused = |rows: &GaussianRows| {
            let rule = |_: &[[f32; 3]]| VoxelRule::Fixed(1.0);
            let (units, mut rng) = (PassingUnits::LINEAR, Pcg64::seed_from_u64(1));
            anchors_from_gaussians(rows, rule, 24, SHAPE, 9, units, &mut rng).expect_err("refused")
        };
        assert_eq!(refused(&GaussianRows::zero(0)), InitError::NoPoints);
        let mut rows = sphere(2);
        rows.base_mut(1)[2] = f32::NAN;
        assert!(begin(&rows, 9).anchors.values.iter().all(|v| v.is_finite()), "it is left out");
        rows.base_mut(0)[COLOR] = f32::INFINITY;
        rows.base_mut(0)[LOG_SCALE] = f32::NAN;
        assert_eq!(refused(&rows), InitError::NonFinite(0));
    }

    #[test]
    fn the_same_gaussian_with_its_axes_renamed_is_the_same() {
        let covariance = |quat: Quat, log_scale: [f32; 3]| {
            let half = Mat3::from_quat(quat) * Mat3::from_diagonal(Vec3::from_array(log_scale.map(f32::exp)));
            half * half.transpose()
        };
        for turn in 0..40 {
            let angle = turn as f32;
            let quat =
                Quat::from_xyzw(angle.sin(), (2.0 * angle).cos(), 0.3, (3.0 * angle).sin()).normalize();
            let log_scale = [-1.0, 0.0, 0.5];
            let (nearest, scales) = nearest_to_the_axes(quat, log_scale);
            assert!(nearest.w > 0.85, "within 63 degrees: {nearest:?}");
            let difference = covariance(quat, log_scale) - covariance(nearest, scales);
            assert!(difference.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{difference:?}");
        }
    }
}
