//! A context model whose predictions fit the synthetic scenes: planes and networks of usual widths, with small random
//! weights, whose last biases are the scenes' means and standard deviations.

use tcgs::{
    codec::{
        ContextChoice, ContextSearch, ContextSettings, GroupChoice, RegressionSearch, context::robust_frame,
    },
    domain::{
        AnchorScene, ContextCandidates, DenseLayer, Mlp,
        anchors::SCALINGS_PER_ANCHOR,
        context_model::{AttributeGroup, ContextKind, PlaneContext, Planes, UpLayer},
    },
};

use crate::synthetic::{Normal, feature_sigma};

/// Texels along the edge of a latent, and channels of latents and planes.
const EDGE: usize = 64;
const LATENTS: usize = 4;
const CHANNELS: usize = 8;

/// Hidden units of the groups' networks.
const HIDDEN: [usize; 3] = [32, 16, 16];

/// Planes and neighbors for every group, 8 bits a weight, and nothing to choose from.
pub(crate) const FIXED: ContextSettings = ContextSettings {
    search: ContextSearch::Fixed(ContextChoice {
        planes: Some(0),
        groups: [GroupChoice::Network { kind: ContextKind::TriPlaneKnn, weight_bits: 8 }; 3],
    }),
    regression: RegressionSearch::WhereItPays,
    coarser: [0; 3],
};

/// Products of the three networks for one anchor.
pub(crate) fn products(feature_dim: usize, offsets: usize) -> usize {
    let inputs = ContextKind::TriPlaneKnn.inputs(CHANNELS);
    let outputs = channels(feature_dim, offsets).map(AttributeGroup::outputs);
    HIDDEN.iter().zip(outputs).map(|(hidden, outputs)| hidden * (inputs + outputs)).sum()
}

fn channels(feature_dim: usize, offsets: usize) -> [usize; 3] {
    [feature_dim, SCALINGS_PER_ANCHOR, 3 * offsets]
}

pub(crate) fn candidates(scene: &AnchorScene) -> ContextCandidates {
    let mut normal = Normal::new(8);
    let mut draws = |count: usize, sigma: f64| -> Vec<f32> {
        (0..count).map(|_| (sigma * normal.draw()) as f32).collect()
    };
    let planes = Planes {
        edge: EDGE,
        channels: LATENTS,
        latents: draws(3 * LATENTS * EDGE * EDGE, 0.5),
        layers: [LATENTS, CHANNELS]
            .map(|inputs| UpLayer {
                inputs,
                outputs: CHANNELS,
                weights: draws(9 * inputs * CHANNELS, 0.2),
                bias: draws(CHANNELS, 0.1),
            })
            .to_vec(),
    };
    let inputs = ContextKind::TriPlaneKnn.inputs(CHANNELS);
    // Means and standard deviations in base steps, as the scenes are made and the tests' settings quantize them.
    let groups: [Vec<(f64, f64)>; 3] = [
        (0..scene.feature_dim).map(|channel| (0.0, feature_sigma(channel))).collect(),
        vec![(34.0, 18.0); SCALINGS_PER_ANCHOR],
        vec![(0.0, 5.0); 3 * scene.offsets_per_anchor],
    ];
    let mut network = |group: &[(f64, f64)], hidden: usize| {
        let outputs = AttributeGroup::outputs(group.len());
        let means = group.iter().map(|(mean, _)| *mean as f32);
        let spreads = group.iter().map(|(_, sigma)| libm::log2(*sigma) as f32);
        Mlp {
            layers: vec![
                DenseLayer {
                    inputs,
                    outputs: hidden,
                    weights: draws(hidden * inputs, 0.1),
                    bias: draws(hidden, 0.1),
                },
                DenseLayer {
                    inputs: hidden,
                    outputs,
                    weights: draws(outputs * hidden, 0.01),
                    bias: means.chain(spreads).chain([0.0]).collect(),
                },
            ],
        }
    };
    let neighbors = [0, 1, 2].map(|group| Some(network(&groups[group], HIDDEN[group])));
    ContextCandidates {
        frame: robust_frame(&scene.cells),
        static_steps: [0.0; 3],
        position: [None, None, None],
        planes: vec![PlaneContext { planes, own: [None, None, None], neighbors }],
    }
}
