//! Small random context models.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    codec::context::robust_frame,
    domain::ContextKind,
    train::{
        context::{ContextAnchors, ContextConfig, ContextLayout, ContextPass, PlaneConfig, PlaneSource},
        twin::context::ContextTwin,
    },
};

pub(super) const KINDS: [ContextKind; 3] =
    [ContextKind::Position, ContextKind::TriPlane, ContextKind::TriPlaneKnn];

pub(super) const TWO_LAYERS: PlaneConfig =
    PlaneConfig { edge: 16, channels: 8, layers: 2, hidden: 5, latents: 3 };

/// Every way in which planes are used, without rounded weights.
pub(super) fn passes() -> [ContextPass; 4] {
    let pass = |source, reconstruction| ContextPass { source, reconstruction, ..ContextPass::RAW };
    [
        ContextPass::RAW,
        pass(PlaneSource::Raw, 3.0),
        pass(PlaneSource::Reconstructed, 3.0),
        pass(PlaneSource::Latents, 0.0),
    ]
}

/// A model, its anchors, a sample of them and gradients by the outputs.
pub(super) struct Scene {
    pub(super) layout: ContextLayout,
    pub(super) anchors: ContextAnchors,
    pub(super) values: Vec<f32>,
    pub(super) sample: Vec<u32>,
    /// A column for each sampled anchor.
    pub(super) d_outputs: Vec<Vec<f32>>,
}

impl Scene {
    pub(super) fn random(
        seed: u64,
        kind: ContextKind,
        planes: PlaneConfig,
        count: usize,
        sampled: usize,
    ) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let config = ContextConfig { kind, channels: [3, 6, 4], hidden: [7, 4, 6], planes };
        let layout = ContextLayout::new(config).expect("known sizes");
        let mut cells: Vec<[i32; 3]> =
            (0..count).map(|_| [0; 3].map(|_| rng.random_range(-40..40))).collect();
        // Some lie at the rim of the planes.
        cells.iter_mut().step_by(9).for_each(|cell| *cell = cell.map(|c| c * 30));
        let anchors = ContextAnchors::new(&config, &robust_frame(&cells), &cells);
        anchors.check(&config).expect("tables that fit");
        let mut values: Vec<f32> = (0..layout.parameters).map(|_| rng.random_range(-0.3..0.3)).collect();
        for range in [layout.planes.clone(), layout.latents.clone()] {
            values[range].iter_mut().for_each(|value| *value *= 5.0);
        }
        // Not ascending: the order of columns is the caller's.
        let mut order: Vec<u32> = (0..count as u32).collect();
        for place in 0..sampled {
            let other = rng.random_range(place..count);
            order.swap(place, other);
        }
        let outputs = config.output_rows()[3];
        Self {
            d_outputs: (0..sampled)
                .map(|_| (0..outputs).map(|_| rng.random_range(-1.0..1.0)).collect())
                .collect(),
            sample: order[..sampled].to_vec(),
            layout,
            anchors,
            values,
        }
    }

    pub(super) fn twin(&self, pass: ContextPass, rounds: bool) -> ContextTwin<'_> {
        ContextTwin { layout: &self.layout, anchors: &self.anchors, sample: &self.sample, pass, rounds }
    }

    pub(super) fn wide_values(&self) -> Vec<f64> {
        self.values.iter().map(|value| f64::from(*value)).collect()
    }

    pub(super) fn wide_gradients(&self) -> Vec<Vec<f64>> {
        self.d_outputs.iter().map(|column| column.iter().map(|d| f64::from(*d)).collect()).collect()
    }
}
