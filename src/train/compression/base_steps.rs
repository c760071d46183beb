//! The base steps of the attribute groups: what noise is as wide as, and what the context model's step adjustments start
//! from.
//!
//! What always holds: steps are positive and finite, and a function of the rows alone.

use super::BaseStepRule;
use crate::{domain::anchors::SCALINGS_PER_ANCHOR, model::AnchorRows};

/// The published base steps of features, scalings in world units, and offsets (method.md §4.13).
const PUBLISHED: [f32; 3] = [1.0, 1e-3, 0.2];

/// No base step is finer: attributes that have learnt nothing yet have no spread.
const FINEST: [f32; 3] = [1e-3, 1e-3, 1e-4];

/// Base steps of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BaseSteps {
    /// Of features.
    pub feature: f32,
    /// Of linear scalings, in voxels.
    pub scaling: f32,
    /// Of offsets.
    pub offset: f32,
}

impl BaseSteps {
    /// The base steps of these rows.
    #[must_use]
    pub fn of(rule: BaseStepRule, anchors: &AnchorRows) -> Self {
        let voxel = anchors.lattice.voxel;
        let wanted = match rule {
            BaseStepRule::Published => [PUBLISHED[0], PUBLISHED[1] / voxel, PUBLISHED[2]],
            BaseStepRule::OfSpread(shares) => {
                let spreads = spreads(anchors);
                std::array::from_fn(|group| shares[group] * spreads[group])
            }
        };
        let [feature, scaling, offset] = std::array::from_fn(|group| {
            let step: f32 = wanted[group];
            if step.is_finite() { step.max(FINEST[group]) } else { PUBLISHED[group] }
        });
        Self { feature, scaling, offset }
    }

    /// The same as rows have them, scalings in world units.
    #[must_use]
    pub fn in_world(&self, voxel: f32) -> [f32; 3] {
        [self.feature, self.scaling * voxel, self.offset]
    }
}

/// Medians of the magnitudes of features, of scalings in voxels, and of the offsets that are not masked.
fn spreads(anchors: &AnchorRows) -> [f32; 3] {
    let shape = anchors.shape;
    let (mut features, mut scalings, mut offsets) = (Vec::new(), Vec::new(), Vec::new());
    for (anchor, mask) in anchors.masks.iter().enumerate() {
        let row = anchors.row(anchor);
        features.extend(row[..shape.features].iter().map(|value| value.abs()));
        let logs = &row[shape.scaling_column()..][..SCALINGS_PER_ANCHOR];
        scalings.extend(logs.iter().map(|log| log.exp() / anchors.lattice.voxel));
        let kept = row[shape.offset_column()..].as_chunks::<3>().0.iter().enumerate();
        offsets
            .extend(kept.filter(|(k, _)| (mask >> k) & 1 == 1).flat_map(|(_, offset)| offset.map(f32::abs)));
    }
    [features, scalings, offsets].map(median)
}

fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::Lattice, model::Shape};

    const SHAPE: Shape = Shape { features: 2, offsets: 2 };

    fn anchors(values: Vec<f32>, masks: Vec<u32>) -> AnchorRows {
        let cells = (0..).map(|x| [x, 0, 0]).take(masks.len()).collect();
        AnchorRows { shape: SHAPE, lattice: Lattice { voxel: 0.5, origin: [0.0; 3] }, cells, values, masks }
    }

    #[test]
    fn spreads_are_medians_of_magnitudes_and_masked_offsets_do_not_count() {
        let row = |feature: f32, log: f32, offset: f32| {
            let mut row = vec![feature; 2];
            row.extend([log; 6]);
            row.extend([offset, -offset, offset, 100.0, 100.0, 100.0]);
            row
        };
        let rows = [row(-1.0, 0.0, 0.1), row(2.0, 2.0_f32.ln(), 0.2), row(4.0, 40.0, 0.3)].concat();
        let steps = BaseSteps::of(BaseStepRule::OfSpread([0.5, 0.25, 1.0]), &anchors(rows, vec![1; 3]));
        assert_eq!((steps.feature, steps.scaling, steps.offset), (1.0, 1.0, 0.2));
        assert_eq!(steps.in_world(0.5), [1.0, 0.5, 0.2]);
    }

    #[test]
    fn published_steps_are_those_of_the_world_whatever_the_voxel() {
        let steps = BaseSteps::of(BaseStepRule::Published, &anchors(vec![0.0; SHAPE.row()], vec![3]));
        assert_eq!((steps.feature, steps.offset), (1.0, 0.2));
        assert!((steps.in_world(0.5)[1] - 1e-3).abs() < 1e-9);
    }

    #[test]
    fn rows_that_have_learnt_nothing_or_nonsense_have_steps_all_the_same() {
        for (value, mask) in [(0.0, 3), (f32::NAN, 3), (f32::INFINITY, 3), (1e38, 0)] {
            let steps = BaseSteps::of(
                BaseStepRule::OfSpread([0.25, 0.1, 0.1]),
                &anchors(vec![value; SHAPE.row()], vec![mask]),
            );
            for step in steps.in_world(0.5) {
                assert!(step > 0.0 && step.is_finite(), "{value}: {steps:?}");
            }
        }
    }
}
