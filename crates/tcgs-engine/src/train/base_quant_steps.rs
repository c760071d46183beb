//! The base quantization steps of the attribute groups: the width of the noise, and what step adjustments are relative to.
//!
//! Invariant: steps are positive and finite, and depend on the rows only.

use super::BaseQuantStepRule;
use crate::{domain::anchors::SCALINGS_PER_ANCHOR, model::AnchorRows};

/// The published base steps of features, scalings in world units, and offsets (METHOD.md §4.2).
const PUBLISHED: [f32; 3] = [1.0, 1e-3, 0.2];

/// Base steps of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BaseQuantSteps {
    /// Of features.
    pub feature: f32,
    /// Of linear scalings, in voxels.
    pub scaling: f32,
    /// Of offsets.
    pub offset: f32,
}

impl BaseQuantSteps {
    /// The base steps of these rows.
    #[must_use]
    pub fn of(rule: BaseQuantStepRule, anchors: &AnchorRows) -> Self {
        let voxel = anchors.lattice.voxel;
        let wanted = match rule {
            BaseQuantStepRule::Published => [PUBLISHED[0], PUBLISHED[1] / voxel, PUBLISHED[2]],
            BaseQuantStepRule::Relative { feature, scaling, offset, .. } => {
                [feature, scaling * median_scaling(anchors) / voxel, offset]
            }
        };
        let [feature, scaling, offset] = wanted;
        Self { feature, scaling: if scaling.is_normal() { scaling } else { 1.0 }, offset }
    }

    /// The steps with scalings in world units, as in rows.
    #[must_use]
    pub fn in_world(&self, voxel: f32) -> [f32; 3] {
        [self.feature, self.scaling * voxel, self.offset]
    }
}

/// The median of all linear scalings, in world units; 0 without any.
fn median_scaling(anchors: &AnchorRows) -> f32 {
    let column = anchors.shape.scaling_column();
    let mut scalings: Vec<f32> = (0..anchors.len())
        .flat_map(|anchor| &anchors.row(anchor)[column..][..SCALINGS_PER_ANCHOR])
        .map(|log| log.exp())
        .collect();
    let middle = scalings.len() / 2;
    if scalings.is_empty() { 0.0 } else { *scalings.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::Lattice, model::ModelShape};

    const SHAPE: ModelShape = ModelShape::new(2, 2);

    fn anchors(values: Vec<f32>, masks: Vec<u32>) -> AnchorRows {
        let cells = (0..).map(|x| [x, 0, 0]).take(masks.len()).collect();
        AnchorRows { shape: SHAPE, lattice: Lattice { voxel: 0.5, origin: [0.0; 3] }, cells, values, masks }
    }

    const RULE: BaseQuantStepRule =
        BaseQuantStepRule::Relative { feature: 0.5, scaling: 0.25, offset: 0.2, finer_octaves: 1.0 };

    #[test]
    fn the_step_of_scalings_follows_the_scene_and_not_its_unit() {
        let row = |scaling: f32| {
            let mut row = vec![9.0; SHAPE.row()];
            row[SHAPE.scaling_column()..SHAPE.offset_column()].fill(scaling.ln());
            row
        };
        let steps = |unit: f32| {
            let rows = [row(0.1 * unit), row(2.0 * unit), row(1e9 * unit)].concat();
            let mut anchors = anchors(rows, vec![1; 3]);
            anchors.lattice.voxel *= unit;
            BaseQuantSteps::of(RULE, &anchors)
        };
        assert_eq!((steps(1.0).feature, steps(1.0).offset), (0.5, 0.2));
        assert!((steps(1.0).scaling - 1.0).abs() < 1e-5);
        assert!((steps(1000.0).scaling - 1.0).abs() < 1e-5);
        assert!((steps(1000.0).in_world(500.0)[1] - 500.0).abs() < 0.01);
    }

    #[test]
    fn published_steps_are_those_of_the_world_whatever_the_voxel() {
        let steps =
            BaseQuantSteps::of(BaseQuantStepRule::Published, &anchors(vec![0.0; SHAPE.row()], vec![3]));
        assert_eq!((steps.feature, steps.offset), (1.0, 0.2));
        assert!((steps.in_world(0.5)[1] - 1e-3).abs() < 1e-9);
    }

    #[test]
    fn rows_that_hold_nonsense_have_steps_all_the_same() {
        for value in [f32::NAN, f32::INFINITY, 1e38, -1e38] {
            let steps = BaseQuantSteps::of(RULE, &anchors(vec![value; SHAPE.row()], vec![3]));
            for step in steps.in_world(0.5) {
                assert!(step > 0.0 && step.is_finite(), "{value}: {steps:?}");
            }
        }
    }
}
