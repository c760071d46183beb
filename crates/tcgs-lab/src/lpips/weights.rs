//! Reads a network's weights from safetensors, every shape and value checked.

use ndarray::Array2;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::{
    Lpips, LpipsError,
    layout::{self, ConvolutionLayout, SCALE, SHIFT},
    rows::Convolution,
    stage::LpipsStage,
};
use tcgs_codec::domain::LpipsNetwork;

/// The network in the bytes of a safetensors file.
pub(super) fn read(bytes: &[u8]) -> Result<Lpips, LpipsError> {
    let tensors = SafeTensors::deserialize(bytes)?;
    let network = recognize(&tensors)?;
    let file = File { tensors, network };
    let stages = layout::stages(network)
        .iter()
        .enumerate()
        .map(|(index, stage)| {
            let convolutions: Vec<Convolution> = stage
                .convolutions
                .iter()
                .map(|convolution| file.convolution(index, convolution))
                .collect::<Result<_, _>>()?;
            let channels = convolutions.last().map_or(0, |convolution| convolution.bias.len());
            Ok(LpipsStage {
                head: file.values(&head_names(index), &[1, channels, 1, 1])?,
                convolutions,
                pool: stage.pool,
            })
        })
        .collect::<Result<_, LpipsError>>()?;
    let scale = file.scaling("scaling_layer.scale", SCALE)?;
    if scale.contains(&0.0) {
        return Err(LpipsError::Value { tensor: "scaling_layer.scale".to_owned() });
    }
    Ok(Lpips { network, shift: file.scaling("scaling_layer.shift", SHIFT)?, scale, stages })
}

/// Tells the networks apart by their first convolution.
fn recognize(tensors: &SafeTensors<'_>) -> Result<LpipsNetwork, LpipsError> {
    let (tensor, view) = find(tensors, &convolution_names(0, 0, "weight"))?;
    match view.shape() {
        [64, 3, 11, 11] => Ok(LpipsNetwork::Alex),
        [64, 3, 3, 3] => Ok(LpipsNetwork::Vgg),
        found => Err(LpipsError::UnknownNetwork { tensor, found: found.to_vec() }),
    }
}

/// What a convolution's tensor may be called: by torchvision, and inside the `lpips` package's own network.
fn convolution_names(stage: usize, index: usize, what: &str) -> [String; 2] {
    [format!("features.{index}.{what}"), format!("net.slice{}.{index}.{what}", stage + 1)]
}

/// What a head may be called: as an attribute of the `lpips` package's network, and in its list.
fn head_names(stage: usize) -> [String; 2] {
    [format!("lin{stage}.model.1.weight"), format!("lins.{stage}.model.1.weight")]
}

fn find<'a>(tensors: &SafeTensors<'a>, names: &[String]) -> Result<(String, TensorView<'a>), LpipsError> {
    names
        .iter()
        .find_map(|name| Some((name.clone(), tensors.tensor(name).ok()?)))
        .ok_or_else(|| LpipsError::Missing { wanted: names.join(" or ") })
}

struct File<'a> {
    tensors: SafeTensors<'a>,
    network: LpipsNetwork,
}

impl File<'_> {
    fn convolution(&self, stage: usize, layout: &ConvolutionLayout) -> Result<Convolution, LpipsError> {
        let ConvolutionLayout { index, inputs, outputs, window } = *layout;
        let size = window.size;
        let stored =
            self.values(&convolution_names(stage, index, "weight"), &[outputs, inputs, size, size])?;
        let bias = self.values(&convolution_names(stage, index, "bias"), &[outputs])?;
        let kernel = Array2::from_shape_fn((size * size * inputs, outputs), |(row, output)| {
            let (place, input) = (row / inputs, row % inputs);
            stored[(output * inputs + input) * size * size + place]
        });
        Ok(Convolution { window, kernel, bias })
    }

    /// The constants that inputs are scaled by, which only the `lpips` package's own state holds.
    fn scaling(&self, name: &str, otherwise: [f32; 3]) -> Result<[f32; 3], LpipsError> {
        match self.values(&[name.to_owned()], &[1, 3, 1, 1]) {
            Ok(values) => Ok(values.try_into().unwrap_or(otherwise)),
            Err(LpipsError::Missing { .. }) => Ok(otherwise),
            Err(error) => Err(error),
        }
    }

    /// The values of the first tensor of these names that there is, if it is of the shape.
    fn values(&self, names: &[String], expected: &[usize]) -> Result<Vec<f32>, LpipsError> {
        let (tensor, view) = find(&self.tensors, names)?;
        if view.shape() != expected {
            return Err(LpipsError::Shape {
                tensor,
                network: self.network,
                expected: expected.to_vec(),
                found: view.shape().to_vec(),
            });
        }
        if view.dtype() != Dtype::F32 {
            return Err(LpipsError::Type { tensor, found: view.dtype() });
        }
        let values: Vec<f32> = view
            .data()
            .chunks_exact(size_of::<f32>())
            .map(|bytes| f32::from_le_bytes(bytes.try_into().expect("four bytes")))
            .collect();
        if values.iter().any(|value| !value.is_finite()) {
            return Err(LpipsError::Value { tensor });
        }
        Ok(values)
    }
}
