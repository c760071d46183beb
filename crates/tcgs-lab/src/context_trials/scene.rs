//! The scene of a trial: a compact part of a finished scene, or of several side by side.

use tcgs_engine::pipeline::scene_file::undecodable;

use tcgs_codec::{
    DecodeLimits, decode,
    domain::{AnchorScene, Problem, anchors::SCALINGS_PER_ANCHOR},
    stored_steps,
};
use tcgs_engine::train::BaseQuantSteps;

/// Anchors with one quantization step for each attribute group.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialScene {
    pub scene: AnchorScene,
    /// The steps: the geometric means of the anchors' own.
    pub steps: BaseQuantSteps,
}

impl TrialScene {
    /// The scene of a `.tcgs` file, anchors in the file's order.
    ///
    /// # Errors
    /// `undecodable` as for decoding.
    pub fn read(bytes: &[u8]) -> Result<Self, Problem> {
        let limits = DecodeLimits::default();
        let scene = decode(bytes, &limits).map_err(undecodable)?.scene;
        let stored = stored_steps(bytes, &limits).map_err(undecodable)?;
        let [feature, scaling, offset] = stored.steps.map(|steps| geometric_mean(&steps));
        let steps = BaseQuantSteps { feature, scaling: scaling / scene.lattice.voxel, offset };
        Ok(Self { scene, steps })
    }

    /// At most `anchors` anchors from the middle of the order, which are a compact part where the order is that of a file.
    #[must_use]
    pub fn crop(&self, anchors: usize) -> Self {
        let scene = &self.scene;
        let kept = anchors.min(scene.len());
        let first = (scene.len() - kept) / 2;
        let of = |values: &[f32], width: usize| values[first * width..(first + kept) * width].to_vec();
        let k = scene.offsets_per_anchor;
        let scene = AnchorScene {
            lattice: scene.lattice,
            cells: scene.cells[first..first + kept].to_vec(),
            feature_dim: scene.feature_dim,
            offsets_per_anchor: k,
            features: of(&scene.features, scene.feature_dim),
            scalings: of(&scene.scalings, SCALINGS_PER_ANCHOR),
            offsets: of(&scene.offsets, 3 * k),
            masks: scene.masks[first * k..(first + kept) * k].to_vec(),
            networks: scene.networks.clone(),
            near: scene.near,
            scene_scale: scene.scene_scale,
            frame: scene.frame,
        };
        Self { scene, steps: self.steps }
    }

    /// Adds the anchors of another scene behind this one's largest x, with values as many steps large as they are. Networks stay
    /// this scene's.
    ///
    /// # Errors
    /// `undecodable` if the scenes differ in the width of features or in the offsets per anchor, or do not fit a lattice together.
    pub fn put_beside(&mut self, other: &Self) -> Result<(), Problem> {
        let (scene, added) = (&mut self.scene, &other.scene);
        let widths = |scene: &AnchorScene| [scene.feature_dim, scene.offsets_per_anchor];
        if widths(scene) != widths(added) {
            let [[f, k], [other_f, other_k]] = [widths(scene), widths(added)];
            return Err(undecodable(format!(
                "scenes side by side need equal widths: {f} feature channels and {k} offsets per anchor here, {other_f} and \
                 {other_k} there; train both with --without basis"
            )));
        }
        let smallest =
            |scene: &AnchorScene| scene.cells.iter().map(|cell| i64::from(cell[0])).min().unwrap_or(0);
        let largest =
            |scene: &AnchorScene| scene.cells.iter().map(|cell| i64::from(cell[0])).max().unwrap_or(0);
        let gap = (largest(scene) - smallest(scene)) / 8 + 1;
        let shift = largest(scene) + gap - smallest(added);
        for [x, y, z] in &added.cells {
            let x = i32::try_from(i64::from(*x) + shift)
                .map_err(|_| undecodable("the scenes are too large to lie side by side on one lattice"))?;
            scene.cells.push([x, *y, *z]);
        }
        let (to, from) = (self.steps, other.steps);
        let scaling = (to.scaling * scene.lattice.voxel) / (from.scaling * added.lattice.voxel);
        let extend =
            |to: &mut Vec<f32>, from: &[f32], factor: f32| to.extend(from.iter().map(|value| value * factor));
        extend(&mut scene.features, &added.features, to.feature / from.feature);
        extend(&mut scene.scalings, &added.scalings, scaling);
        extend(&mut scene.offsets, &added.offsets, to.offset / from.offset);
        scene.masks.extend_from_slice(&added.masks);
        Ok(())
    }
}

fn geometric_mean(steps: &[f32]) -> f32 {
    let logarithms: f64 = steps.iter().map(|step| f64::from(*step).ln()).sum();
    (logarithms / steps.len().max(1) as f64).exp() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn golden() -> TrialScene {
        TrialScene::read(include_bytes!("../../../../tests/golden/trained_v1.tcgs")).expect("a file")
    }

    #[test]
    fn a_crop_is_a_run_of_the_order() {
        let whole = golden();
        let crop = whole.crop(10);
        let first = (whole.scene.len() - 10) / 2;
        assert_eq!(crop.scene.cells, whole.scene.cells[first..first + 10]);
        assert_eq!(crop.scene.check(), Ok(()));
        let width = whole.scene.feature_dim;
        assert_eq!(crop.scene.features[..width], whole.scene.features[first * width..(first + 1) * width]);
        assert_eq!(whole.crop(usize::MAX), whole);
    }

    #[test]
    fn scenes_side_by_side_keep_their_symbols_and_do_not_overlap() {
        let (mut both, one) = (golden(), golden());
        let mut coarse = one.clone();
        coarse.steps = BaseQuantSteps { feature: 2.0 * one.steps.feature, ..one.steps };
        coarse.scene.features.iter_mut().for_each(|value| *value *= 2.0);
        both.put_beside(&coarse).expect("equal widths");
        let n = one.scene.len();
        assert_eq!((both.scene.len(), both.scene.check()), (2 * n, Ok(())));
        assert_eq!(both.scene.features[..n * one.scene.feature_dim], one.scene.features);
        assert_eq!(both.scene.features[n * one.scene.feature_dim..], one.scene.features);
        let x = |range: std::ops::Range<usize>| both.scene.cells[range].iter().map(|cell| cell[0]);
        assert!(x(0..n).max() < x(n..2 * n).min());
    }

    #[test]
    fn scenes_of_other_widths_are_refused() {
        let (mut one, mut other) = (golden(), golden());
        other.scene.feature_dim += 1;
        let problem = one.put_beside(&other).expect_err("widths differ");
        assert!(problem.detail.contains("--without basis"), "{problem:?}");
    }
}
