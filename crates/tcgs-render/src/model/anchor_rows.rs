//! Anchors as the device holds them: one row of parameters per anchor.

use crate::domain::{AnchorScene, Lattice, NearPlane, RenderNetworks, SceneFrame, SceneScale, ViewDegree};

/// Widths of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ModelShape {
    /// Feature width F.
    pub features: usize,
    /// Hidden values of each network.
    pub hidden: usize,
    /// Offsets K an anchor, at most 32.
    pub offsets: usize,
    /// How networks see the direction of view.
    pub view_degree: ViewDegree,
}

impl ModelShape {
    /// Networks as wide as the feature (METHOD.md §2.2), which see the direction alone.
    #[must_use]
    pub const fn new(features: usize, offsets: usize) -> Self {
        Self { features, hidden: features, offsets, view_degree: ViewDegree::DEFAULT }
    }

    /// The widths of a finished scene.
    #[must_use]
    pub fn of(scene: &AnchorScene) -> Self {
        let hidden = scene.networks.opacity.layers.first().map_or(scene.feature_dim, |layer| layer.outputs);
        let view_degree = scene.view_degree().unwrap_or_default();
        Self { features: scene.feature_dim, hidden, offsets: scene.offsets_per_anchor, view_degree }
    }

    /// Most offsets per anchor: a mask is one word.
    pub const MAX_OFFSETS: usize = u32::BITS as usize;

    /// Checks that the kernels know this shape; files may hold others.
    ///
    /// # Errors
    /// Which width is out of range.
    pub fn check(&self) -> Result<(), String> {
        let Self { features, hidden, offsets, .. } = *self;
        if features == 0 {
            return Err("a feature has no channels".to_owned());
        }
        if hidden == 0 {
            return Err("a network has no hidden values".to_owned());
        }
        if !(1..=Self::MAX_OFFSETS).contains(&offsets) {
            return Err(format!("{offsets} offsets an anchor are not 1 to {}", Self::MAX_OFFSETS));
        }
        Ok(())
    }

    /// Values in an anchor's row: feature, six log-scalings, three coordinates an offset.
    #[must_use]
    pub fn row(&self) -> usize {
        self.features + 6 + 3 * self.offsets
    }

    /// Column of the first log-scaling.
    #[must_use]
    pub fn scaling_column(&self) -> usize {
        self.features
    }

    /// Column of the first offset coordinate.
    #[must_use]
    pub fn offset_column(&self) -> usize {
        self.features + 6
    }

    /// Shader definitions of this shape.
    #[must_use]
    pub fn defs(&self) -> [(&'static str, u32); 2] {
        [("FEATURES", self.features as u32), ("OFFSETS", self.offsets as u32)]
    }
}

/// Anchors with their trainable parameters, scalings as logarithms.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchorRows {
    /// Widths.
    pub shape: ModelShape,
    /// The lattice of `cells`.
    pub lattice: Lattice,
    /// Cell of each anchor.
    pub cells: Vec<[i32; 3]>,
    /// `[N][row]` parameters.
    pub values: Vec<f32>,
    /// Bit k set: offset k may make a Gaussian.
    pub masks: Vec<u32>,
}

impl AnchorRows {
    /// Number of anchors.
    #[must_use]
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    /// Whether there is no anchor.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }

    /// The parameters of one anchor.
    #[must_use]
    pub fn row(&self, anchor: usize) -> &[f32] {
        let width = self.shape.row();
        &self.values[anchor * width..(anchor + 1) * width]
    }

    /// World positions, padded to four components.
    #[must_use]
    pub fn positions(&self) -> Vec<[f32; 4]> {
        self.cells
            .iter()
            .map(|cell| {
                let [x, y, z] = self.lattice.position(*cell);
                [x, y, z, 0.0]
            })
            .collect()
    }

    /// Removes the anchors whose mask is empty.
    pub fn drop_empty(&mut self) {
        let keep: Vec<bool> = self.masks.iter().map(|mask| *mask != 0).collect();
        retain_rows(&mut self.cells, 1, &keep);
        retain_rows(&mut self.masks, 1, &keep);
        retain_rows(&mut self.values, self.shape.row(), &keep);
    }

    /// The rows of a finished scene, whose shape must pass [`ModelShape::check`].
    #[must_use]
    pub fn from_scene(scene: &AnchorScene) -> Self {
        let shape = ModelShape::of(scene);
        let mut values = Vec::with_capacity(scene.len() * shape.row());
        let mut masks = Vec::with_capacity(scene.len());
        for anchor in 0..scene.len() {
            values.extend_from_slice(&scene.features[anchor * shape.features..][..shape.features]);
            values.extend(scene.scalings[anchor * 6..][..6].iter().map(|scaling| scaling.max(1e-30).ln()));
            values.extend_from_slice(&scene.offsets[anchor * shape.offsets * 3..][..shape.offsets * 3]);
            let kept = &scene.masks[anchor * shape.offsets..][..shape.offsets];
            masks.push(kept.iter().enumerate().fold(0, |bits, (k, on)| bits | (u32::from(*on) << k)));
        }
        Self { shape, lattice: scene.lattice, cells: scene.cells.clone(), values, masks }
    }

    /// The finished scene with these anchors.
    #[must_use]
    pub fn to_scene(&self, networks: RenderNetworks) -> AnchorScene {
        let shape = self.shape;
        let mut scene = AnchorScene {
            lattice: self.lattice,
            cells: self.cells.clone(),
            feature_dim: shape.features,
            offsets_per_anchor: shape.offsets,
            features: Vec::with_capacity(self.len() * shape.features),
            scalings: Vec::with_capacity(self.len() * 6),
            offsets: Vec::with_capacity(self.len() * shape.offsets * 3),
            masks: Vec::with_capacity(self.len() * shape.offsets),
            networks,
            near: NearPlane::default(),
            scene_scale: SceneScale::default(),
            frame: SceneFrame::WORLD,
        };
        for (anchor, mask) in self.masks.iter().enumerate() {
            let row = self.row(anchor);
            scene.features.extend_from_slice(&row[..shape.features]);
            scene
                .scalings
                .extend(row[shape.scaling_column()..shape.offset_column()].iter().map(|log| log.exp()));
            scene.offsets.extend_from_slice(&row[shape.offset_column()..]);
            scene.masks.extend((0..shape.offsets).map(|k| (mask >> k) & 1 == 1));
        }
        scene
    }
}

/// Keeps the rows of `width` values whose flag is set, in their order.
pub fn retain_rows<T: Copy>(values: &mut Vec<T>, width: usize, keep: &[bool]) {
    let mut next = 0;
    for (row, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        values.copy_within(row * width..(row + 1) * width, next);
        next += width;
    }
    values.truncate(next);
}

/// The mask with every offset on.
#[must_use]
pub fn all_offsets(shape: ModelShape) -> u32 {
    if shape.offsets >= 32 { u32::MAX } else { (1 << shape.offsets) - 1 }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::model::NetworkLayout;

    const SHAPE: ModelShape = ModelShape::new(4, 3);

    #[test]
    fn rows_and_scenes_hold_the_same_anchors() {
        let layout = NetworkLayout::new(SHAPE);
        let networks = layout.to_networks(&layout.initial(&mut rand_pcg::Pcg64::seed_from_u64(1)));
        let rows = AnchorRows {
            shape: SHAPE,
            lattice: Lattice { voxel: 0.5, origin: [1.0, 2.0, 3.0] },
            cells: vec![[0, 0, 0], [2, -4, 6]],
            values: (0..2 * SHAPE.row()).map(|i| 0.25 * i as f32 - 3.0).collect(),
            masks: vec![0b101, 0b010],
        };
        let scene = rows.to_scene(networks);
        scene.check().expect("a consistent scene");
        assert_eq!(scene.masks, [true, false, true, false, true, false]);
        assert_eq!(scene.features[4..], rows.row(1)[..4]);
        assert!((scene.scalings[6] - rows.row(1)[4].exp()).abs() < 1e-6, "scalings become linear");
        assert_eq!(scene.offsets[9..], rows.row(1)[10..]);
        let back = AnchorRows::from_scene(&scene);
        assert_eq!(
            (back.shape, back.lattice, &back.cells, &back.masks),
            (SHAPE, rows.lattice, &rows.cells, &rows.masks)
        );
        for (found, expected) in back.values.iter().zip(&rows.values) {
            assert!((found - expected).abs() <= 1e-6 * expected.abs().max(1.0), "{found} {expected}");
        }
        assert_eq!(rows.positions(), [[1.0, 2.0, 3.0, 0.0], [2.0, 0.0, 6.0, 0.0]]);
    }

    #[test]
    fn a_scaling_of_zero_becomes_a_finite_logarithm() {
        let layout = NetworkLayout::new(SHAPE);
        let rows = AnchorRows {
            shape: SHAPE,
            lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
            cells: vec![[0; 3]],
            values: vec![-1000.0; SHAPE.row()],
            masks: vec![7],
        };
        let scene = rows.to_scene(layout.to_networks(&vec![0.0; layout.parameters]));
        assert_eq!(scene.scalings, [0.0; 6]);
        assert!(AnchorRows::from_scene(&scene).values.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn empty_anchors_go_and_the_others_keep_their_rows() {
        let shape = ModelShape::new(4, 2);
        let mut rows = AnchorRows {
            shape,
            lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
            cells: (0..5).map(|i| [i, 0, 0]).collect(),
            values: (0..5 * shape.row()).map(|i| i as f32).collect(),
            masks: vec![0, 3, 0, 1, 0],
        };
        let kept: Vec<Vec<f32>> = [1, 3].map(|anchor| rows.row(anchor).to_vec()).into();
        rows.drop_empty();
        assert_eq!(
            (rows.cells.as_slice(), rows.masks.as_slice()),
            (&[[1, 0, 0], [3, 0, 0]][..], &[3, 1][..])
        );
        assert_eq!([rows.row(0), rows.row(1)], [&kept[0][..], &kept[1][..]]);
        assert_eq!(rows.values.len(), 2 * shape.row());
    }

    #[test]
    fn every_offset_has_its_bit() {
        for (offsets, mask) in [(1, 1), (10, 0x3ff), (31, 0x7fff_ffff), (32, u32::MAX)] {
            assert_eq!(all_offsets(ModelShape::new(4, offsets)), mask);
        }
    }
}
