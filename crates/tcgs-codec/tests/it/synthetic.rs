//! Seeded scenes with the statistics of trained ones, made without any platform's own mathematics.

use std::collections::BTreeSet;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use tcgs_codec::{
    ContextSettings, EncodeSettings, Provenance,
    domain::{
        AnchorScene, Background, DenseLayer, Digest, Lattice, Mlp, NearPlane, RenderNetworks, SceneFrame,
        SceneScale, ViewDegree, anchors::SCALINGS_PER_ANCHOR,
    },
};

/// Normal deviates from a seed.
pub(super) struct Normal(Pcg64Mcg);

impl Normal {
    pub(super) fn new(seed: u64) -> Self {
        Self(Pcg64Mcg::seed_from_u64(seed))
    }

    pub(super) fn draw(&mut self) -> f64 {
        let (u, v): (f64, f64) = (self.0.random(), self.0.random());
        libm::sqrt(-2.0 * libm::log(1.0 - u)) * libm::cos(std::f64::consts::TAU * v)
    }

    fn uniform(&mut self) -> f64 {
        self.0.random()
    }
}

/// Shape of a synthetic scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct Recipe {
    pub(super) seed: u64,
    pub(super) anchors: usize,
    pub(super) feature_dim: usize,
    pub(super) offsets: usize,
    /// Share of offsets that are masked off.
    pub(super) masked: f64,
}

/// Standard deviation of a feature channel, in steps of one.
pub(super) fn feature_sigma(channel: usize) -> f64 {
    0.4 + 0.35 * channel as f64
}

pub(super) fn scene(recipe: Recipe) -> AnchorScene {
    let Recipe { seed, anchors, feature_dim, offsets, masked } = recipe;
    let mut normal = Normal::new(seed);
    let voxel = 0.01_f32;
    let cells = shell(&mut normal, anchors);
    let features = (0..anchors * feature_dim)
        .map(|index| (feature_sigma(index % feature_dim) * normal.draw()) as f32)
        .collect();
    let scalings = (0..anchors * SCALINGS_PER_ANCHOR)
        .map(|_| voxel * libm::exp(0.4 + 0.5 * normal.draw()) as f32)
        .collect();
    let offset_values = (0..anchors * offsets * 3).map(|_| normal.draw() as f32).collect();
    let mut masks: Vec<bool> = (0..anchors * offsets).map(|_| normal.uniform() >= masked).collect();
    for anchor in masks.chunks_mut(offsets) {
        anchor[0] |= !anchor.iter().any(|kept| *kept);
    }
    AnchorScene {
        lattice: Lattice { voxel, origin: [0.25, -1.5, 3.0] },
        cells,
        feature_dim,
        offsets_per_anchor: offsets,
        features,
        scalings,
        offsets: offset_values,
        masks,
        networks: networks(&mut normal, [feature_dim + ViewDegree::DEFAULT.inputs(), feature_dim, offsets]),
        near: NearPlane::default(),
        scene_scale: SceneScale::default(),
        frame: SceneFrame::WORLD,
    }
}

/// Cells near a sphere, as trained anchors are near surfaces, in no particular order.
fn shell(normal: &mut Normal, count: usize) -> Vec<[i32; 3]> {
    let radius = 3.0 + libm::sqrt(count as f64) * 0.45;
    let mut taken = BTreeSet::new();
    let mut cells = Vec::new();
    while cells.len() < count {
        let direction = [normal.draw(), normal.draw(), normal.draw()];
        let length = libm::sqrt(direction.iter().map(|x| x * x).sum());
        let reach = (radius + 0.7 * normal.draw()) / length;
        let cell = direction.map(|x| libm::round(x * reach) as i32 - 5);
        if taken.insert(cell) {
            cells.push(cell);
        }
    }
    cells
}

/// Networks with these numbers of inputs, hidden values and offsets per anchor.
pub(super) fn networks(normal: &mut Normal, [inputs, hidden, offsets]: [usize; 3]) -> RenderNetworks {
    let mut layer = |inputs: usize, outputs: usize| DenseLayer {
        inputs,
        outputs,
        weights: (0..inputs * outputs)
            .map(|_| (0.6 * normal.draw() / libm::sqrt(inputs as f64)) as f32)
            .collect(),
        bias: (0..outputs).map(|_| (0.1 * normal.draw()) as f32).collect(),
    };
    let mut mlp = |outputs| Mlp { layers: vec![layer(inputs, hidden), layer(hidden, outputs)] };
    RenderNetworks { opacity: mlp(offsets), covariance: mlp(7 * offsets), color: mlp(3 * offsets) }
}

pub(super) fn settings() -> EncodeSettings {
    EncodeSettings {
        background: Background::White,
        feature_step: 1.0,
        scaling_step: 0.05,
        offset_step: 0.2,
        context: ContextSettings::default(),
        provenance: Provenance {
            generator: "tcgs test".to_owned(),
            dataset: Some(Digest::of(b"a dataset")),
            adapter: Some("an adapter".to_owned()),
            settings: serde_json::json!({ "preset": "preview", "seed": 7 }),
        },
    }
}

/// A scene whose anchors are each large or small, flat or round, bright or dark as a whole: channels follow from those before.
pub(super) fn related(recipe: Recipe) -> AnchorScene {
    let mut scene = scene(recipe);
    let mut normal = Normal::new(recipe.seed ^ 2);
    for row in scene.scalings.chunks_mut(SCALINGS_PER_ANCHOR) {
        let size = 0.02 * libm::exp(0.8 * normal.draw());
        row.iter_mut().for_each(|scaling| *scaling = (size * libm::exp(0.1 * normal.draw())) as f32);
    }
    for row in scene.features.chunks_mut(recipe.feature_dim) {
        let common = 6.0 * normal.draw();
        row.iter_mut().for_each(|feature| *feature = (common + 0.8 * normal.draw()) as f32);
    }
    for row in scene.offsets.chunks_mut(3 * recipe.offsets) {
        let common = 2.0 * normal.draw();
        row.iter_mut().for_each(|offset| *offset = (common + 0.2 * normal.draw()) as f32);
    }
    scene
}

/// A scene whose file is a few kilobytes.
pub(super) fn small() -> AnchorScene {
    scene(Recipe { seed: 11, anchors: 120, feature_dim: 8, offsets: 4, masked: 0.3 })
}

/// The smallest scene that still has every part.
pub(super) fn tiny() -> AnchorScene {
    scene(Recipe { seed: 5, anchors: 3, feature_dim: 1, offsets: 1, masked: 0.0 })
}
