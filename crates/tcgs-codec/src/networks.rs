//! The render networks as integers: weights with a scale a row, biases with a scale a layer.
//!
//! A weight is `integer x row scale`, a bias `integer x layer scale`, each one f32 multiplication. Row scales are
//! the upper 16 bits of an f32. All integers go through one stream, each kind of each layer with its own fitted
//! distribution. How fine the integers are is the encoder's choice and not part of the format.

use super::{
    alloc::{check_limit, reserve},
    bytes::{Reader, Writer},
    error::{DecodeError, EncodeError, Result},
    fit,
    range::{StreamDecoder, StreamEncoder},
    symbols::Distribution,
};
use crate::domain::{DenseLayer, Mlp, RenderNetworks, anchors::SceneShapeError};

const PART: &str = "networks";

/// Most layers in one network.
const MAX_LAYERS: usize = 8;

/// Widest layer; bounds the allocations of a decoder for any file.
const MAX_WIDTH: usize = 1024;

/// Memory that a parameter takes while decoding: its integer, its value, and the value again in the check.
const PARAMETER_BYTES: u64 = 12;

/// Largest magnitude of a bias's integer. Biases are few and shift every output alike, so they are kept finer
/// than any weight.
const BIAS_LEVELS: f32 = 2047.0;

/// Largest finite number in the upper 16 bits of an f32.
const MAX_SCALE: i32 = 0x7f7f;

/// A dense layer of integers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct QuantizedLayer {
    inputs: usize,
    outputs: usize,
    /// Upper 16 bits of each row's f32 scale.
    row_scales: Vec<i32>,
    weights: Vec<i32>,
    bias_scale: f32,
    bias: Vec<i32>,
}

/// Layers of one network.
pub(super) type QuantizedMlp = Vec<QuantizedLayer>;

/// Opacity, covariance and color network.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct QuantizedNetworks(pub(super) [QuantizedMlp; 3]);

impl QuantizedNetworks {
    /// The networks as floats.
    pub(super) fn dequantize(&self) -> RenderNetworks {
        let [opacity, covariance, color] = &self.0;
        RenderNetworks {
            opacity: dequantize(opacity),
            covariance: dequantize(covariance),
            color: dequantize(color),
        }
    }
}

/// Refuses networks that the format cannot state.
pub(super) fn check(networks: &RenderNetworks) -> Result<(), EncodeError> {
    for mlp in [&networks.opacity, &networks.covariance, &networks.color] {
        let limit = |what, value: usize, limit: usize| match value {
            0 => Err(EncodeError::Shape(SceneShapeError(format!("a network has no {what}")))),
            _ if value > limit => {
                Err(EncodeError::TooLarge { what, value: value as u64, limit: limit as u64 })
            }
            _ => Ok(()),
        };
        limit("layers of a network", mlp.layers.len(), MAX_LAYERS)?;
        mlp.layers.iter().try_for_each(|layer| limit("outputs of a layer", layer.outputs, MAX_WIDTH))?;
    }
    Ok(())
}

/// Quantizes a network with weights of magnitude up to `levels`.
pub(super) fn quantize(mlp: &Mlp, levels: u16) -> QuantizedMlp {
    mlp.layers.iter().map(|layer| quantize_layer(layer, f32::from(levels))).collect()
}

fn quantize_layer(layer: &DenseLayer, levels: f32) -> QuantizedLayer {
    let mut row_scales: Vec<i32> =
        layer.weights.chunks(layer.inputs).map(|row| row_scale(row, levels)).collect();
    // A row of zeros may have any scale; the layer's largest costs fewer bits than an outlier.
    let common = row_scales.iter().copied().max().unwrap_or(0);
    row_scales.iter_mut().filter(|scale| **scale == 0).for_each(|scale| *scale = common);
    let weights = layer
        .weights
        .chunks(layer.inputs)
        .zip(&row_scales)
        .flat_map(|(row, scale)| row.iter().map(|weight| nearest(*weight, from_upper_half(*scale), levels)))
        .collect();
    let bias_scale = largest(&layer.bias) / BIAS_LEVELS;
    let bias = layer.bias.iter().map(|bias| nearest(*bias, bias_scale, BIAS_LEVELS)).collect();
    QuantizedLayer { inputs: layer.inputs, outputs: layer.outputs, row_scales, weights, bias_scale, bias }
}

/// The least scale at which no weight exceeds its levels; but where the row has been rounded before, the scale of then,
/// so that a rounded network is stored as it is. Rounding up had made that larger by at most one unit.
fn row_scale(row: &[f32], levels: f32) -> i32 {
    let min = upper_half(largest(row) / levels);
    let exact = |scale: &i32| {
        let scale = from_upper_half(*scale);
        row.iter().all(|weight| nearest(*weight, scale, levels) as f32 * scale == *weight)
    };
    (min..=(min + 1).min(MAX_SCALE)).find(exact).unwrap_or(min)
}

fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |largest, value| value.abs().max(largest))
}

fn nearest(value: f32, scale: f32, levels: f32) -> i32 {
    if scale == 0.0 { 0 } else { (value / scale).round_ties_even().clamp(-levels, levels) as i32 }
}

/// The upper half of a non-negative f32, rounded up so that no weight exceeds its levels.
fn upper_half(scale: f32) -> i32 {
    ((scale.to_bits().saturating_add(0xffff)) >> 16).min(MAX_SCALE as u32) as i32
}

fn from_upper_half(bits: i32) -> f32 {
    f32::from_bits((bits as u32) << 16)
}

/// A network as its decoder will have it.
pub(super) fn dequantize(mlp: &QuantizedMlp) -> Mlp {
    let layer = |layer: &QuantizedLayer| DenseLayer {
        inputs: layer.inputs,
        outputs: layer.outputs,
        weights: layer
            .weights
            .chunks(layer.inputs)
            .zip(&layer.row_scales)
            .flat_map(|(row, scale)| row.iter().map(|weight| *weight as f32 * from_upper_half(*scale)))
            .collect(),
        bias: layer.bias.iter().map(|bias| *bias as f32 * layer.bias_scale).collect(),
    };
    Mlp { layers: mlp.iter().map(layer).collect() }
}

/// The networks section: the shape and distributions of every layer, then one stream.
pub(super) fn encode(networks: &QuantizedNetworks) -> Vec<u8> {
    let _stage = tracing::debug_span!("networks").entered();
    let mut writer = Writer::new();
    let mut stream = StreamEncoder::new();
    for mlp in &networks.0 {
        writer.varint(mlp.len() as u64);
        for layer in mlp {
            writer.varint(layer.outputs as u64);
            writer.f32(layer.bias_scale);
            for integers in [&layer.row_scales, &layer.weights, &layer.bias] {
                let distribution = fit::fit(integers.clone());
                fit::write(distribution, &mut writer);
                integers.iter().for_each(|integer| distribution.encode(&mut stream, *integer));
            }
        }
    }
    writer.raw(&stream.finish());
    writer.into_bytes()
}

/// A layer as the front of the section describes it.
struct LayerHead {
    inputs: usize,
    outputs: usize,
    bias_scale: f32,
    distributions: [Distribution; 3],
}

/// Reads the section of networks with so many `inputs` each, in a file with `offsets` offsets per anchor.
/// Constant parameters take no bytes, so their number is checked against the caller's limit.
pub(super) fn decode(
    section: &[u8],
    inputs: usize,
    offsets: usize,
    max_memory_bytes: u64,
) -> Result<QuantizedNetworks> {
    let _stage = tracing::debug_span!("networks").entered();
    let mut reader = Reader::new(PART, section);
    let outputs = [offsets, 7 * offsets, 3 * offsets];
    let heads = [
        read_heads(&mut reader, inputs, outputs[0])?,
        read_heads(&mut reader, inputs, outputs[1])?,
        read_heads(&mut reader, inputs, outputs[2])?,
    ];
    let size = |head: &LayerHead| (head.inputs + 2) as u64 * head.outputs as u64;
    let memory = heads.iter().flatten().map(size).sum::<u64>() * PARAMETER_BYTES;
    check_limit("bytes of memory for networks", memory, max_memory_bytes)?;
    let mut stream = StreamDecoder::new(PART, reader.rest())?;
    let mut networks = QuantizedNetworks([Vec::new(), Vec::new(), Vec::new()]);
    for (mlp, heads) in networks.0.iter_mut().zip(heads) {
        for head in heads {
            mlp.push(read_layer(&mut stream, &head)?);
        }
    }
    stream.finish()?;
    let finite = |layer: &DenseLayer| layer.weights.iter().chain(&layer.bias).all(|value| value.is_finite());
    if networks.0.iter().all(|mlp| dequantize(mlp).layers.iter().all(finite)) {
        Ok(networks)
    } else {
        Err(reader.malformed("a parameter", "not finite"))
    }
}

fn read_heads(reader: &mut Reader<'_>, inputs: usize, outputs: usize) -> Result<Vec<LayerHead>> {
    let count = reader.count("number of layers", 1..=MAX_LAYERS)?;
    let mut heads = Vec::new();
    let mut width = inputs;
    for _ in 0..count {
        let head = LayerHead {
            inputs: width,
            outputs: reader.count("layer width", 1..=MAX_WIDTH)?,
            bias_scale: reader.f32("bias scale")?,
            distributions: [fit::read(reader)?, fit::read(reader)?, fit::read(reader)?],
        };
        if !(head.bias_scale.is_finite() && head.bias_scale.is_sign_positive()) {
            return Err(reader.malformed("bias scale", head.bias_scale));
        }
        width = head.outputs;
        heads.push(head);
    }
    if width == outputs { Ok(heads) } else { Err(reader.malformed("last layer's width", width)) }
}

fn read_layer(stream: &mut StreamDecoder<'_>, head: &LayerHead) -> Result<QuantizedLayer> {
    let mut integers = |distribution: Distribution, count: usize| {
        let mut integers = reserve("network parameters", count)?;
        for _ in 0..count {
            integers.push(distribution.decode(stream)?);
        }
        Ok::<_, DecodeError>(integers)
    };
    let [of_scales, of_weights, of_bias] = head.distributions;
    let row_scales = integers(of_scales, head.outputs)?;
    let weights = integers(of_weights, head.inputs * head.outputs)?;
    let bias = integers(of_bias, head.outputs)?;
    if let Some(scale) = row_scales.iter().find(|scale| !(0..=MAX_SCALE).contains(*scale)) {
        return Err(DecodeError::malformed(PART, "a row scale", scale));
    }
    Ok(QuantizedLayer {
        inputs: head.inputs,
        outputs: head.outputs,
        row_scales,
        weights,
        bias_scale: head.bias_scale,
        bias,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(inputs: usize, outputs: usize, value: impl Fn(usize) -> f32) -> DenseLayer {
        DenseLayer {
            inputs,
            outputs,
            weights: (0..inputs * outputs).map(&value).collect(),
            bias: (0..outputs).map(|index| value(index + 1) * 3.0).collect(),
        }
    }

    fn networks(value: impl Fn(usize) -> f32 + Copy) -> RenderNetworks {
        let mlp = |outputs| Mlp { layers: vec![layer(6, 5, value), layer(5, outputs, value)] };
        RenderNetworks { opacity: mlp(3), covariance: mlp(21), color: mlp(9) }
    }

    fn quantized(networks: &RenderNetworks, levels: u16) -> QuantizedNetworks {
        QuantizedNetworks([
            quantize(&networks.opacity, levels),
            quantize(&networks.covariance, levels),
            quantize(&networks.color, levels),
        ])
    }

    #[test]
    fn parameters_are_within_half_a_level() {
        let network = networks(|index| ((index * 37 % 101) as f32 - 50.0) * 0.013);
        let decoded = quantized(&network, 127).dequantize();
        for (mlp, back) in [
            (&network.opacity, &decoded.opacity),
            (&network.covariance, &decoded.covariance),
            (&network.color, &decoded.color),
        ] {
            for (layer, back) in mlp.layers.iter().zip(&back.layers) {
                for (row, row_back) in
                    layer.weights.chunks(layer.inputs).zip(back.weights.chunks(layer.inputs))
                {
                    // Rounding the scale up to 8 bits of mantissa costs at most 1/128 of a level.
                    let bound = largest(row) / 127.0 * 0.51;
                    assert!(row.iter().zip(row_back).all(|(a, b)| (a - b).abs() <= bound));
                }
                let bound = largest(&layer.bias) / BIAS_LEVELS * 0.501;
                assert!(layer.bias.iter().zip(&back.bias).all(|(a, b)| (a - b).abs() <= bound));
            }
        }
    }

    #[test]
    fn networks_come_back_from_their_section() {
        let cases: [fn(usize) -> f32; 5] = [
            |index| ((index * 37 % 101) as f32 - 50.0) * 0.013,
            |_| 0.0,
            |index| if index % 6 < 3 { 0.0 } else { 1e-41 * index as f32 },
            |index| if index % 2 == 0 { f32::MAX / 4.0 } else { -f32::MIN_POSITIVE },
            |_| 0.25,
        ];
        for (case, value) in cases.into_iter().enumerate() {
            for levels in [127, 1023] {
                let quantized = quantized(&networks(value), levels);
                let section = encode(&quantized);
                assert_eq!(decode(&section, 6, 3, u64::MAX), Ok(quantized), "case {case}");
            }
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        let section = encode(&quantized(&networks(|index| index as f32), 127));
        assert!(decode(&section, 6, 4, u64::MAX).is_err());
        assert!(decode(&[0], 6, 3, u64::MAX).is_err());
        assert!(decode(&[1, 0x81, 0x08], 6, 3, u64::MAX).is_err(), "a layer 1025 wide");
        assert!(matches!(decode(&section, 6, 3, 1000), Err(DecodeError::Limit { .. })));
        let empty = Mlp { layers: Vec::new() };
        let all = RenderNetworks { opacity: empty.clone(), covariance: empty.clone(), color: empty };
        assert!(matches!(check(&all), Err(EncodeError::Shape(_))));
    }

    #[test]
    fn networks_are_as_deep_and_wide_as_the_format_allows() {
        let with = |layers: usize, outputs: usize| {
            let layer = |outputs: usize| DenseLayer {
                inputs: 1,
                outputs,
                weights: vec![0.0; outputs],
                bias: vec![0.0; outputs],
            };
            let mut color = Mlp { layers: vec![layer(1); layers] };
            color.layers[0] = layer(outputs);
            check(&RenderNetworks { color, ..networks(|_| 0.0) })
        };
        assert_eq!(with(8, 1024), Ok(()));
        let (what, value, limit) = ("layers of a network", 9, 8);
        assert_eq!(with(9, 1), Err(EncodeError::TooLarge { what, value, limit }));
        let (what, value, limit) = ("outputs of a layer", 1025, 1024);
        assert_eq!(with(1, 1025), Err(EncodeError::TooLarge { what, value, limit }));
        assert!(matches!(with(1, 0), Err(EncodeError::Shape(_))));

        // Of the two front layers, their scales and three constants of zero.
        let head = |outputs: &[u8], bias_scale: f32| {
            [outputs, &bias_scale.to_le_bytes(), &[0, 64, 0, 64, 0, 64]].concat()
        };
        let read = |count: u8, first: &[u8], bias_scale: f32| {
            let rest = head(&[3], 1.0).repeat(usize::from(count) - 1);
            let section = [&[count][..], &head(first, bias_scale), &rest].concat();
            read_heads(&mut Reader::new(PART, &section), 6, 3).map(|heads| heads.len())
        };
        assert_eq!(read(8, &[0x80, 0x08], 0.0), Ok(8));
        for (count, first, bias_scale) in [(9, &[3][..], 1.0), (2, &[0x81, 0x08], 1.0), (2, &[0], 1.0)]
            .into_iter()
            .chain([-1.0, -0.0, f32::INFINITY, f32::NAN].map(|bias_scale| (2, &[3][..], bias_scale)))
        {
            let error = read(count, first, bias_scale).expect_err("must be refused");
            assert!(matches!(error, DecodeError::Malformed { .. }), "{error}");
        }
    }

    #[test]
    fn the_memory_limit_covers_integers_values_and_their_check() {
        let section = encode(&quantized(&networks(|index| index as f32), 127));
        let Err(DecodeError::Limit { value, limit: 1, .. }) = decode(&section, 6, 3, 1) else {
            panic!("must be refused")
        };
        // Weights and biases are held three times, scales of rows once.
        let layers = [(6, 5), (5, 3), (6, 5), (5, 21), (6, 5), (5, 9)];
        let bytes = |(inputs, outputs): (u64, u64)| 4 * outputs * (3 * (inputs + 1) + 1);
        let bytes: u64 = layers.into_iter().map(bytes).sum();
        assert!((bytes..=bytes * 3 / 2).contains(&value), "{value} for {bytes}");
    }
}
