//! Files between two points of the coarsening path: the most important anchors have one group's values of the finer point, all others
//! those of the coarser one, which are multiples of larger steps and mostly zeros.

use std::collections::HashMap;

use crate::domain::{AnchorScene, AttributeGroup, anchors::SCALINGS_PER_ANCHOR};

/// The group's values that anchors have in a file of the coarser point, and the order in which anchors get the finer ones.
pub(super) struct Blend {
    group: AttributeGroup,
    width: usize,
    values: Vec<f32>,
    /// Anchors of the scene, the most important first, each with its row among the values.
    order: Vec<(usize, usize)>,
}

impl Blend {
    /// Of `group` as in `coarser`, which has only anchors of `scene`. `costs` is the importance of each anchor of `scene`.
    pub(super) fn new(
        scene: &AnchorScene,
        coarser: AnchorScene,
        group: AttributeGroup,
        costs: &[f64],
    ) -> Self {
        let rows: HashMap<[i32; 3], usize> =
            coarser.cells.iter().enumerate().map(|(row, cell)| (*cell, row)).collect();
        let mut order: Vec<(usize, usize)> = scene
            .cells
            .iter()
            .enumerate()
            .filter_map(|(anchor, cell)| Some((anchor, *rows.get(cell)?)))
            .collect();
        // Stable: equal costs keep the scene's order.
        order.sort_by(|(a, _), (b, _)| costs[*b].total_cmp(&costs[*a]));
        let (width, values) = match group {
            AttributeGroup::Features => (scene.feature_dim, coarser.features),
            AttributeGroup::Scalings => (SCALINGS_PER_ANCHOR, coarser.scalings),
            AttributeGroup::Offsets => (3 * scene.offsets_per_anchor, coarser.offsets),
        };
        Self { group, width, values, order }
    }

    /// Number of anchors that may have either values.
    pub(super) fn anchors(&self) -> usize {
        self.order.len()
    }

    /// Gives all but the `finer` most important anchors of the scene the coarser values.
    pub(super) fn apply(&self, scene: &mut AnchorScene, finer: usize) {
        let values = match self.group {
            AttributeGroup::Features => &mut scene.features,
            AttributeGroup::Scalings => &mut scene.scalings,
            AttributeGroup::Offsets => &mut scene.offsets,
        };
        for (anchor, row) in &self.order[finer.min(self.order.len())..] {
            let [to, from] = [*anchor, *row].map(|row| row * self.width..(row + 1) * self.width);
            values[to].copy_from_slice(&self.values[from]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{super::test_scene, *};

    fn scene(cells: Vec<[i32; 3]>, value: f32) -> AnchorScene {
        test_scene(cells, [2, 1], |anchor| value + anchor as f32)
    }

    #[test]
    fn the_least_important_anchors_of_the_file_become_coarse() {
        let [a, b, c, d] = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]];
        let fine = scene(vec![a, b, c, d], 0.0);
        // In another order, and one of them is not in the file.
        let coarse = scene(vec![d, b, a], 100.0);
        let blend = Blend::new(&fine, coarse, AttributeGroup::Features, &[5.0, 1.0, 9.0, 3.0]);
        assert_eq!(blend.anchors(), 3);
        let features = |finer| {
            let mut scene = fine.clone();
            blend.apply(&mut scene, finer);
            assert_eq!((&scene.scalings, &scene.offsets), (&fine.scalings, &fine.offsets));
            scene.features.chunks(2).map(|row| row[0]).collect::<Vec<_>>()
        };
        assert_eq!(features(3), [0.0, 1.0, 2.0, 3.0]);
        assert_eq!(features(2), [0.0, 101.0, 2.0, 3.0]);
        assert_eq!(features(1), [0.0, 101.0, 2.0, 100.0]);
        assert_eq!(features(0), [102.0, 101.0, 2.0, 100.0]);
        for (group, width) in [(AttributeGroup::Scalings, 6), (AttributeGroup::Offsets, 3)] {
            let mut scene = fine.clone();
            Blend::new(&fine, self::scene(vec![b], 100.0), group, &[0.0; 4]).apply(&mut scene, 0);
            let values = if width == 6 { &scene.scalings } else { &scene.offsets };
            assert_eq!(values[width..2 * width], vec![100.0; width]);
            assert_eq!(values[0], 0.0);
        }
    }
}
