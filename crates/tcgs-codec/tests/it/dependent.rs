//! Scenes whose attributes are drawn from the predictions of context networks, with those networks as candidates; and the
//! predictions once more, in floats.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use tcgs_codec::{
    context::{Texel, coordinates, neighbors, position_inputs, robust_frame, texels},
    domain::{
        AnchorScene, AttributeGroup, ContextCandidates, ContextFrame, ContextKind, DenseLayer, Mlp,
        PlaneContext, Planes, UpLayer,
    },
};

use super::synthetic::{Normal, Recipe, scene, settings};

/// A scene and what predicts it: features from the anchor and its neighbors, scalings from the anchor, offsets from the
/// position.
pub(super) struct Dependent {
    pub(super) scene: AnchorScene,
    pub(super) candidates: ContextCandidates,
}

/// The kinds that predict the three groups of a [`Dependent`] scene.
pub(super) const KINDS: [ContextKind; 3] =
    [ContextKind::TriPlaneKnn, ContextKind::TriPlane, ContextKind::Position];

/// Mean, base-2 logarithm of the standard deviation (both in base steps) a channel, and step adjustment in octaves.
pub(super) struct Prediction {
    pub(super) means: Vec<f64>,
    pub(super) log_deviations: Vec<f64>,
    pub(super) adjustment: f64,
}

pub(super) fn dependent(recipe: Recipe) -> Dependent {
    let mut scene = scene(recipe);
    let mut random = Pcg64Mcg::seed_from_u64(recipe.seed);
    let frame = robust_frame(&scene.cells);
    let planes = planes(&mut random);
    let channels = planes.plane_channels();
    let widths = [recipe.feature_dim, 6, 3 * recipe.offsets];
    let mut networks =
        |kind: ContextKind| widths.map(|width| Some(network(&mut random, kind.inputs(channels), width)));
    let set = PlaneContext {
        own: networks(ContextKind::TriPlane),
        neighbors: networks(ContextKind::TriPlaneKnn),
        planes,
    };
    let position = widths.map(|width| Some(network(&mut random, ContextKind::Position.inputs(0), width)));
    let candidates = ContextCandidates { frame, static_steps: [0.0, 0.1, -0.1], position, planes: vec![set] };

    let mut normal = Normal::new(recipe.seed ^ 1);
    let settings = settings();
    let bases = [settings.feature_step, settings.scaling_step * scene.lattice.voxel, settings.offset_step];
    for (group, kind) in KINDS.into_iter().enumerate() {
        let predictions = predictions(&scene.cells, &candidates, group, kind);
        let base = f64::from(bases[group]);
        let draw = |prediction: &Prediction| -> Vec<f32> {
            let channels = prediction.means.iter().zip(&prediction.log_deviations);
            channels.map(|(m, l)| (base * (m + libm::exp2(*l) * normal.draw())) as f32).collect()
        };
        let values: Vec<f32> = predictions.iter().flat_map(draw).collect();
        match AttributeGroup::ALL[group] {
            AttributeGroup::Features => scene.features = values,
            AttributeGroup::Scalings => scene.scalings = values.iter().map(|x| x.max(0.0)).collect(),
            AttributeGroup::Offsets => scene.offsets = values,
        }
    }
    Dependent { scene, candidates }
}

fn uniform(random: &mut Pcg64Mcg, count: usize, bound: f32) -> Vec<f32> {
    (0..count).map(|_| random.random_range(-bound..bound)).collect()
}

fn planes(random: &mut Pcg64Mcg) -> Planes {
    let (edge, channels, outputs) = (4, 2, 3);
    Planes {
        edge,
        channels,
        latents: uniform(random, 3 * channels * edge * edge, 4.0),
        layers: vec![UpLayer {
            inputs: channels,
            outputs,
            weights: uniform(random, channels * outputs * 9, 0.7),
            bias: uniform(random, outputs, 0.2),
        }],
    }
}

/// Means of several steps, standard deviations of about one, adjustments of about half an octave.
fn network(random: &mut Pcg64Mcg, inputs: usize, width: usize) -> Mlp {
    let hidden = 6;
    let outputs = AttributeGroup::outputs(width);
    let mut layer = |inputs: usize, outputs: usize| DenseLayer {
        inputs,
        outputs,
        weights: uniform(random, inputs * outputs, 1.5 / (inputs as f32).sqrt()),
        bias: uniform(random, outputs, 0.5),
    };
    let mut layers = vec![layer(inputs, hidden), layer(hidden, outputs)];
    for (row, weights) in layers[1].weights.chunks_mut(hidden).enumerate() {
        let scale = if row < width { 12.0 } else { 0.3 };
        weights.iter_mut().for_each(|weight| *weight *= scale);
    }
    layers[1].bias[..width].iter_mut().for_each(|bias| *bias += 25.0);
    Mlp { layers }
}

/// What the float network of a group says of every anchor, from float planes. Anchors in the order of `cells`.
pub(super) fn predictions(
    cells: &[[i32; 3]],
    candidates: &ContextCandidates,
    group: usize,
    kind: ContextKind,
) -> Vec<Prediction> {
    let set = &candidates.planes[0];
    let mlp = match kind {
        ContextKind::Position => &candidates.position,
        ContextKind::TriPlane => &set.own,
        ContextKind::TriPlaneKnn => &set.neighbors,
    }[group]
        .as_ref()
        .expect("every network is there");
    let coordinates = coordinates(&candidates.frame, cells);
    let grown = grow(&set.planes);
    let sample = |anchor: usize| -> Vec<f64> {
        let places = texels(coordinates[anchor], set.planes.plane_edge());
        places.iter().enumerate().flat_map(|(plane, texel)| grown.sample(plane, texel)).collect()
    };
    let near = neighbors(cells);
    (0..cells.len())
        .map(|anchor| {
            let mut input: Vec<f64> =
                near[anchor][..kind.sampled()].iter().flat_map(|near| sample(*near as usize)).collect();
            input.extend(position_inputs(coordinates[anchor]).map(|x| f64::from(x) / 256.0));
            let outputs = forward(mlp, &input);
            let width = outputs.len() / 2;
            Prediction {
                means: outputs[..width].to_vec(),
                log_deviations: outputs[width..2 * width].to_vec(),
                adjustment: outputs[2 * width],
            }
        })
        .collect()
}

fn forward(mlp: &Mlp, input: &[f64]) -> Vec<f64> {
    let mut values = input.to_vec();
    for (index, layer) in mlp.layers.iter().enumerate() {
        if index > 0 {
            values.iter_mut().for_each(|value| *value = value.max(0.0));
        }
        assert_eq!(layer.inputs, values.len());
        let rows = layer.weights.chunks(layer.inputs).zip(&layer.bias);
        values = rows
            .map(|(row, bias)| {
                f64::from(*bias) + row.iter().zip(&values).map(|(w, x)| f64::from(*w) * x).sum::<f64>()
            })
            .collect();
    }
    values
}

/// Planes in floats.
struct Grown {
    edge: usize,
    channels: usize,
    /// `[3][C][R][R]`.
    values: Vec<f64>,
}

impl Grown {
    fn sample(&self, plane: usize, texel: &Texel) -> Vec<f64> {
        let (fx, fy) = (f64::from(texel.fx) / 256.0, f64::from(texel.fy) / 256.0);
        (0..self.channels)
            .map(|channel| {
                let image = (plane * self.channels + channel) * self.edge * self.edge;
                let at = |x: u32, y: u32| self.values[image + y as usize * self.edge + x as usize];
                (at(texel.x0, texel.y0) * (1.0 - fx) + at(texel.x1, texel.y0) * fx) * (1.0 - fy)
                    + (at(texel.x0, texel.y1) * (1.0 - fx) + at(texel.x1, texel.y1) * fx) * fy
            })
            .collect()
    }
}

/// One layer of up-sampling, by its definition.
fn grow(planes: &Planes) -> Grown {
    let [layer] = &planes.layers[..] else { panic!("one layer") };
    let (edge, wide) = (planes.edge, 2 * planes.edge);
    let mut values = vec![0.0; 3 * layer.outputs * wide * wide];
    for (image, values) in values.chunks_mut(wide * wide).enumerate() {
        let (plane, output) = (image / layer.outputs, image % layer.outputs);
        values.fill(f64::from(layer.bias[output]));
        for input in 0..layer.inputs {
            for place in 0..edge * edge {
                let value = planes.latents[(plane * layer.inputs + input) * edge * edge + place];
                for tap in 0..9 {
                    let x = (2 * (place % edge) + tap % 3).wrapping_sub(1);
                    let y = (2 * (place / edge) + tap / 3).wrapping_sub(1);
                    if x < wide && y < wide {
                        let weight = layer.weights[(input * layer.outputs + output) * 9 + tap];
                        values[y * wide + x] += f64::from(value) * f64::from(weight);
                    }
                }
            }
        }
    }
    Grown { edge: wide, channels: layer.outputs, values }
}

/// The frame of a scene without extent, for candidates that use none.
pub(super) const UNIT_FRAME: ContextFrame = ContextFrame { center: [0; 3], half: [1; 3] };
