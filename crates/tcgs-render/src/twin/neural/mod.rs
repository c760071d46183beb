//! From anchors to the Gaussians of a view, and the gradients back, on the CPU in f64; every kernel has a function of its name.
//!
//! A column holds the values of one visible anchor, in the order of the kernels' rows.

mod anchor_row;
mod anchor_statistics;
mod anchor_visible;
mod compact_anchors;
mod count_gaussians;
mod count_visible_anchors;
mod feature_gradient;
mod list_visible_anchors;
mod network_input;
mod opaque_anchors;
mod output_column;
mod spawn_gaussians;
mod spawn_gradient;
mod visible_offsets;
mod volume;

use glam::DVec3;

pub use anchor_statistics::anchor_statistics;
pub use anchor_visible::anchor_visible;
pub use compact_anchors::compact_anchors;
pub use count_gaussians::count_gaussians;
pub use count_visible_anchors::count_visible_anchors;
pub use feature_gradient::feature_gradient;
pub use list_visible_anchors::list_visible_anchors;
pub use network_input::network_input;
pub use opaque_anchors::opaque_anchors;
pub use spawn_gaussians::spawn_gaussians;
pub use spawn_gradient::spawn_gradient;
pub use visible_offsets::visible_offsets;
pub use volume::volume;

pub use super::dense::{
    dense, dense_input_gradient, dense_software, dense_weight_gradient, dense_weight_gradient_software,
    pack_weights, relu, relu_gate, sum_partials, sum_weight_gradient,
};
use super::{Gaussian, GaussianGradient, Projection};
use crate::{
    domain::SceneScale,
    model::{AnchorRows, ModelShape, NetworkLayout},
};

/// Larger magnitudes count as infinite.
const LIMIT: f64 = 1e30;

/// Visible anchors that one partial sum of a weight gradient covers.
const GRADIENT_RUN: usize = 1024;

/// Anchors and networks.
#[derive(Debug, Clone, PartialEq)]
pub struct Anchors {
    /// Widths.
    pub shape: ModelShape,
    /// World positions.
    pub positions: Vec<DVec3>,
    /// `[N][row]` parameters.
    pub rows: Vec<f64>,
    /// Bit k set: offset k may make a Gaussian.
    pub masks: Vec<u32>,
    /// The networks' flat parameters.
    pub networks: Vec<f64>,
    /// The unit of the networks' distances.
    pub scene_scale: SceneScale,
}

impl Anchors {
    /// The numbers that the device gets, in f64.
    #[must_use]
    pub fn new(anchors: &AnchorRows, networks: &[f32], scene_scale: SceneScale) -> Self {
        let position = |p: &[f32; 4]| DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
        Self {
            shape: anchors.shape,
            positions: anchors.positions().iter().map(position).collect(),
            rows: anchors.values.iter().map(|v| f64::from(*v)).collect(),
            masks: anchors.masks.clone(),
            networks: networks.iter().map(|v| f64::from(*v)).collect(),
            scene_scale,
        }
    }

    /// The parameters of one anchor.
    #[must_use]
    pub fn row(&self, anchor: usize) -> &[f64] {
        &self.rows[anchor * self.shape.row()..][..self.shape.row()]
    }
}

/// Everything that the forward pass computes; one column or K Gaussians for each entry of `list`.
#[derive(Debug, Clone)]
pub struct NeuralForward {
    /// Visible anchors, ascending.
    pub list: Vec<u32>,
    /// The networks' inputs.
    pub input: Vec<Vec<f64>>,
    /// Hidden values after the ReLU.
    pub hidden: Vec<Vec<f64>>,
    /// The networks' outputs, before any activation.
    pub outputs: Vec<Vec<f64>>,
    /// The Gaussians; none where the opacity is not positive or the mask is off.
    pub gaussians: Vec<Option<Gaussian>>,
}

/// Gradients in the layouts of [`Anchors::rows`] and [`Anchors::networks`].
#[derive(Debug, Clone, PartialEq)]
pub struct AnchorGradient {
    /// By the anchors' rows; zero for anchors that the view does not show.
    pub rows: Vec<f64>,
    /// By the networks' parameters.
    pub networks: Vec<f64>,
}

/// From anchors to Gaussians.
#[must_use]
pub fn neural_forward(projection: &Projection, anchors: &Anchors) -> NeuralForward {
    let layout = NetworkLayout::new(anchors.shape);
    let visible: Vec<bool> = anchors
        .positions
        .iter()
        .enumerate()
        .map(|(anchor, position)| anchor_visible(projection, *position, anchors.shape, anchors.row(anchor)))
        .collect();
    let mut spawned = NeuralForward {
        list: compact_anchors(&visible),
        input: Vec::new(),
        hidden: Vec::new(),
        outputs: Vec::new(),
        gaussians: Vec::new(),
    };
    for anchor in spawned.list.iter().map(|anchor| *anchor as usize) {
        let (position, row, mask) = (anchors.positions[anchor], anchors.row(anchor), anchors.masks[anchor]);
        let input = network_input(projection, position, anchors.shape, row, anchors.scene_scale);
        let hidden = relu(dense(&layout.hidden, &anchors.networks, &input));
        let outputs: Vec<f64> =
            layout.heads.iter().flat_map(|head| dense(head, &anchors.networks, &hidden)).collect();
        debug_assert!(
            opaque_anchors(mask, &outputs[..anchors.shape.offsets])
                || spawn_gaussians(position, anchors.shape, row, mask, &outputs).iter().all(Option::is_none)
        );
        spawned.gaussians.extend(spawn_gaussians(position, anchors.shape, row, mask, &outputs));
        spawned.input.push(input);
        spawned.hidden.push(hidden);
        spawned.outputs.push(outputs);
    }
    spawned
}

/// From the gradients by Gaussians to those by anchors and networks, with `volume_weight` times the gradient of [`volume`](fn@volume).
#[must_use]
pub fn neural_backward(
    anchors: &Anchors,
    spawned: &NeuralForward,
    d_gaussians: &[GaussianGradient],
    volume_weight: f64,
) -> AnchorGradient {
    let (shape, layout) = (anchors.shape, NetworkLayout::new(anchors.shape));
    let [_, opaque, _] = count_gaussians(shape, &spawned.list, &spawned.gaussians);
    let mut rows = vec![0.0; anchors.rows.len()];
    let (mut d_outputs, mut d_hidden) = (Vec::new(), Vec::new());
    for (index, anchor) in spawned.list.iter().map(|anchor| *anchor as usize).enumerate() {
        let d_row = &mut rows[anchor * shape.row()..][..shape.row()];
        let range = index * shape.offsets..(index + 1) * shape.offsets;
        let column = spawn_gradient(
            shape,
            anchors.row(anchor),
            &spawned.outputs[index],
            &spawned.gaussians[range.clone()],
            &d_gaussians[range],
            volume_weight / f64::from(opaque.max(1)),
            d_row,
        );
        let mut d_column = vec![0.0; layout.hidden.outputs];
        for head in &layout.heads {
            dense_input_gradient(head, &anchors.networks, &column, &mut d_column);
        }
        let d_column = relu_gate(&spawned.hidden[index], d_column);
        let mut d_input = vec![0.0; layout.hidden.inputs];
        dense_input_gradient(&layout.hidden, &anchors.networks, &d_column, &mut d_input);
        feature_gradient(shape, &d_input, d_row);
        d_outputs.push(column);
        d_hidden.push(d_column);
    }
    let partials: Vec<Vec<f64>> = (0..spawned.list.len())
        .step_by(GRADIENT_RUN)
        .map(|first| {
            let run = first..(first + GRADIENT_RUN).min(spawned.list.len());
            let mut partial = vec![0.0; layout.parameters];
            for head in &layout.heads {
                let (hidden, d_outputs) = (&spawned.hidden[run.clone()], &d_outputs[run.clone()]);
                dense_weight_gradient(head, hidden, d_outputs, &mut partial);
            }
            dense_weight_gradient(&layout.hidden, &spawned.input[run.clone()], &d_hidden[run], &mut partial);
            partial
        })
        .collect();
    AnchorGradient { rows, networks: sum_partials(layout.parameters, &partials) }
}
