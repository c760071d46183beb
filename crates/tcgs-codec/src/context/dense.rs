//! Dense layers of integers, and how they are made of floats.
//!
//! Activations are in 2^-8. A row's real weights are its integers times 2^-shift. An output is
//!
//! ```text
//! ((sum of weight x input + half) >> shift) + bias        half = 2^(shift - 1), 0 where shift = 0
//! ```
//!
//! and no i32 overflows: inputs are at most 2^14 - 1 in magnitude, weights at most 127, inputs at most 512, so that the sum
//! is at most 127 x 16383 x 512 = 1 065 288 192 < 2^30; half is at most 2^14, the bias at most 2^24.

use pulp::{Arch, Simd, WithSimd};

use crate::{
    alloc::{check_limit, reserve},
    bytes::{Reader, Writer},
    domain::{DenseLayer, Mlp},
    error::{DecodeError, Result},
    fit,
    range::{StreamDecoder, StreamEncoder},
    symbols::Distribution,
};

/// Widest input of a layer, by the proof above.
pub(crate) const MAX_INPUTS: usize = 512;

/// Largest magnitude of an activation, in 2^-8: just below 64.
pub(crate) const MAX_ACTIVATION: i32 = (1 << 14) - 1;

/// Largest magnitude of an output of the last layer, in 2^-8.
pub(crate) const MAX_OUTPUT: i32 = 1 << 23;

/// Largest right shift of a row: weights below 2^-9 are rounded to multiples of 2^-15.
pub(crate) const MAX_SHIFT: u8 = 15;

/// Most layers of a network.
const MAX_LAYERS: usize = 4;

/// Rows and inputs are padded with zeros to a multiple of this, the width of vector instructions.
const LANES: usize = 16;

/// Integers of one row of weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct WeightBits(u8);

impl WeightBits {
    /// From 2 to 8.
    pub(crate) fn new(bits: u8) -> Option<Self> {
        (2..=8).contains(&bits).then_some(Self(bits))
    }

    /// Largest magnitude: 127 for eight bits.
    pub(crate) fn limit(self) -> i32 {
        (1 << (self.0 - 1)) - 1
    }
}

/// A layer of integers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct IntegerLayer {
    inputs: usize,
    /// Right shift of each row.
    shifts: Vec<u8>,
    /// Row-major, each row padded to `padded(inputs)`.
    weights: Vec<i16>,
    /// In 2^-8.
    bias: Vec<i32>,
}

/// The length that a row of `width` numbers is padded to.
pub(crate) fn padded(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

/// The sum of products of two padded rows. By the module's proof it fits.
#[inline(always)]
pub(crate) fn dot(a: &[i16], b: &[i16]) -> i32 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<{ 4 * LANES }>(), b.as_chunks());
    let mut sum = 0;
    for (a, b) in a.iter().zip(b) {
        sum += products(a, b);
    }
    for (a, b) in a_rest.as_chunks::<LANES>().0.iter().zip(b_rest.as_chunks().0) {
        sum += products(a, b);
    }
    sum
}

/// With the length known, compilers use the instruction that multiplies and adds pairs, and add up lanes once.
#[inline(always)]
fn products<const N: usize>(a: &[i16; N], b: &[i16; N]) -> i32 {
    let mut sum = 0;
    for lane in 0..N {
        sum += i32::from(a[lane]) * i32::from(b[lane]);
    }
    sum
}

/// A network's pass over one anchor, to be compiled for each kind of vectors that processors have.
struct Forward<'a> {
    network: &'a IntegerMlp,
    activations: &'a mut Activations,
    outputs: &'a mut Vec<i32>,
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        self.network.forward(self.activations, self.outputs);
    }
}

/// A sum of products as an activation: rounded to 2^-8, and the bias added.
#[inline(always)]
pub(crate) fn shifted(sum: i32, shift: u8, bias: i32) -> i32 {
    let half = (1_i32 << shift) >> 1;
    ((sum + half) >> shift) + bias
}

/// Integers of one row: the largest shift with which every weight stays within `limit`, and the nearest integers.
///
/// A row of zeros has shift 0.
pub(crate) fn quantize_row(row: &[f32], limit: i32) -> (u8, Vec<i16>) {
    let limit = limit as f32;
    let largest = row.iter().fold(0.0_f32, |largest, weight| largest.max(weight.abs()));
    let scale = |shift: u8| (1_u32 << shift) as f32;
    let fits = |shift: &u8| (largest * scale(*shift)).round_ties_even() <= limit;
    let shift = if largest == 0.0 { 0 } else { (0..=MAX_SHIFT).rev().find(fits).unwrap_or(0) };
    let integer = |weight: &f32| (weight * scale(shift)).round_ties_even().clamp(-limit, limit) as i16;
    (shift, row.iter().map(integer).collect())
}

/// A bias in 2^-8.
pub(crate) fn quantize_bias(bias: f32) -> i32 {
    let limit = crate::symbols::MAX_SYMBOL as f32;
    (bias * 256.0).round_ties_even().clamp(-limit, limit) as i32
}

impl IntegerLayer {
    fn outputs(&self) -> usize {
        self.bias.len()
    }

    fn quantize(layer: &DenseLayer, bits: WeightBits) -> Self {
        let rows: Vec<(u8, Vec<i16>)> =
            layer.weights.chunks(layer.inputs).map(|row| quantize_row(row, bits.limit())).collect();
        let stride = padded(layer.inputs);
        let mut weights = vec![0; stride * rows.len()];
        for (place, (_, row)) in weights.chunks_mut(stride).zip(&rows) {
            place[..row.len()].copy_from_slice(row);
        }
        Self {
            inputs: layer.inputs,
            shifts: rows.iter().map(|(shift, _)| *shift).collect(),
            weights,
            bias: layer.bias.iter().copied().map(quantize_bias).collect(),
        }
    }

    fn as_floats(&self) -> DenseLayer {
        let rows = self.weights.chunks(padded(self.inputs)).zip(&self.shifts);
        DenseLayer {
            inputs: self.inputs,
            outputs: self.outputs(),
            weights: rows
                .flat_map(|(row, shift)| {
                    let scale = 1.0 / (1_u32 << shift) as f32;
                    row[..self.inputs].iter().map(move |weight| f32::from(*weight) * scale)
                })
                .collect(),
            bias: self.bias.iter().map(|bias| *bias as f32 / 256.0).collect(),
        }
    }

    #[inline(always)]
    fn row(&self, row: usize, input: &[i16]) -> i32 {
        let stride = padded(self.inputs);
        let sum = dot(&self.weights[row * stride..(row + 1) * stride], &input[..stride]);
        shifted(sum, self.shifts[row], self.bias[row])
    }

    #[inline(always)]
    fn hidden(&self, input: &[i16], output: &mut Vec<i16>) {
        output.clear();
        output.resize(padded(self.outputs()), 0);
        for (row, output) in output[..self.outputs()].iter_mut().enumerate() {
            *output = self.row(row, input).clamp(0, MAX_ACTIVATION) as i16;
        }
    }
}

/// A network of integers: ReLU between layers, none after the last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct IntegerMlp {
    layers: Vec<IntegerLayer>,
    bits: WeightBits,
}

/// Activations between layers, reused from anchor to anchor.
#[derive(Debug, Clone, Default)]
pub(crate) struct Activations {
    /// Padded input of the first layer, then the buffers of the following layers in turn.
    pub(crate) input: Vec<i16>,
    other: Vec<i16>,
}

impl IntegerMlp {
    /// The integers of a network whose layers fit each other.
    pub(crate) fn quantize(mlp: &Mlp, bits: WeightBits) -> Self {
        Self { layers: mlp.layers.iter().map(|layer| IntegerLayer::quantize(layer, bits)).collect(), bits }
    }

    /// The network as floats.
    pub(crate) fn as_floats(&self) -> Mlp {
        Mlp { layers: self.layers.iter().map(IntegerLayer::as_floats).collect() }
    }

    /// Outputs in 2^-8 for `activations.input`, which is padded; the input is lost.
    pub(crate) fn outputs(&self, activations: &mut Activations, outputs: &mut Vec<i32>) {
        // The same integers whatever the machine's vectors are; wider ones are only faster.
        Arch::new().dispatch(Forward { network: self, activations, outputs });
    }

    #[inline(always)]
    fn forward(&self, activations: &mut Activations, outputs: &mut Vec<i32>) {
        let last = self.hidden(activations);
        outputs.resize(last.outputs(), 0);
        for (row, output) in outputs.iter_mut().enumerate() {
            *output = last.row(row, &activations.input).clamp(-MAX_OUTPUT, MAX_OUTPUT);
        }
    }

    /// Runs all layers but the last, which is returned; its input is `activations.input`.
    #[inline(always)]
    fn hidden(&self, activations: &mut Activations) -> &IntegerLayer {
        let (last, before) = self.layers.split_last().expect("a network has a layer");
        for layer in before {
            layer.hidden(&activations.input, &mut activations.other);
            std::mem::swap(&mut activations.input, &mut activations.other);
        }
        last
    }

    /// Multiplications for one anchor.
    pub(crate) fn multiplications(&self) -> u64 {
        self.layers.iter().map(|layer| (layer.inputs * layer.outputs()) as u64).sum()
    }

    /// Adds to the bias of the last output, in 2^-8.
    pub(crate) fn shift_last_output(&mut self, by: i32) {
        if let Some(bias) = self.layers.last_mut().and_then(|layer| layer.bias.last_mut()) {
            let limit = crate::symbols::MAX_SYMBOL;
            *bias = (*bias + by).clamp(-limit, limit);
        }
    }

    /// Checks that a network can be stored as integers; the error is a description.
    pub(crate) fn check(mlp: &Mlp, inputs: usize, outputs: usize) -> Result<(), String> {
        if mlp.layers.is_empty() || mlp.layers.len() > MAX_LAYERS {
            return Err(format!("{} layers where 1 to {MAX_LAYERS} are possible", mlp.layers.len()));
        }
        if let Some(wide) = mlp.layers.iter().find(|layer| !(1..=MAX_INPUTS).contains(&layer.inputs)) {
            return Err(format!("a layer of {} inputs where 1 to {MAX_INPUTS} are possible", wide.inputs));
        }
        mlp.check(inputs, outputs)
    }

    /// Stores the layers' shapes and distributions, then their integers as one stream.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut writer = Writer::new();
        let mut stream = StreamEncoder::new();
        writer.u8(self.bits.0);
        writer.varint(self.layers.len() as u64);
        for layer in &self.layers {
            writer.varint(layer.outputs() as u64);
            let weights = layer.weights.chunks(padded(layer.inputs)).flat_map(|row| &row[..layer.inputs]);
            encode_integers(layer.shifts.iter().map(|shift| i32::from(*shift)), &mut writer, &mut stream);
            encode_integers(weights.map(|weight| i32::from(*weight)), &mut writer, &mut stream);
            encode_integers(layer.bias.iter().copied(), &mut writer, &mut stream);
        }
        writer.raw(&stream.finish());
        writer.into_bytes()
    }

    /// Reads the rest of `reader` as a network; `part` names it in errors.
    pub(crate) fn decode(
        part: &'static str,
        reader: &mut Reader<'_>,
        inputs: usize,
        outputs: usize,
        max_memory_bytes: u64,
    ) -> Result<Self> {
        if inputs > MAX_INPUTS {
            return Err(reader.malformed("inputs of a network", inputs));
        }
        let bits = reader.u8("bits of a weight")?;
        let Some(bits) = WeightBits::new(bits) else {
            return Err(reader.malformed("bits of a weight", bits));
        };
        let count = reader.count("number of layers", 1..=MAX_LAYERS)?;
        let mut heads = Vec::new();
        let mut width = inputs;
        for layer in 0..count {
            // Outputs are the next layer's inputs; the last layer's are the channels', which may be more.
            let limit = if layer + 1 == count { outputs.max(1) } else { MAX_INPUTS };
            let rows = reader.count("layer width", 1..=limit)?;
            heads.push((width, rows, [fit::read(reader)?, fit::read(reader)?, fit::read(reader)?]));
            width = rows;
        }
        if width != outputs {
            return Err(reader.malformed("last layer's width", width));
        }
        // A weight is held twice while its row is read.
        let size = |(inputs, outputs, _): &(usize, usize, _)| (padded(*inputs) + 8) as u64 * *outputs as u64;
        let memory = heads.iter().map(size).sum::<u64>() * 4;
        check_limit("bytes of memory for context networks", memory, max_memory_bytes)?;
        let mut stream = StreamDecoder::new(part, reader.rest())?;
        let mut layers = Vec::new();
        for (inputs, outputs, [of_shifts, of_weights, of_bias]) in heads {
            let shifts =
                decode_integers(&mut stream, of_shifts, outputs, 0, i32::from(MAX_SHIFT), "a shift")?;
            let stride = padded(inputs);
            let mut weights = reserve("context weights", outputs * stride)?;
            for _ in 0..outputs {
                let limit = bits.limit();
                let row = decode_integers(&mut stream, of_weights, inputs, -limit, limit, "a weight")?;
                weights.extend(row.into_iter().map(|weight| weight as i16));
                weights.resize(weights.len().next_multiple_of(stride), 0);
            }
            let limit = crate::symbols::MAX_SYMBOL;
            let bias = decode_integers(&mut stream, of_bias, outputs, -limit, limit, "a bias")?;
            let shifts = shifts.into_iter().map(|shift| shift as u8).collect();
            layers.push(IntegerLayer { inputs, shifts, weights, bias });
        }
        stream.finish()?;
        Ok(Self { layers, bits })
    }
}

/// Codes integers by the distribution that suits them, which goes into `writer`.
pub(crate) fn encode_integers(
    integers: impl Iterator<Item = i32>,
    writer: &mut Writer,
    stream: &mut StreamEncoder,
) {
    let integers: Vec<i32> = integers.collect();
    let distribution = fit::fit(integers.clone());
    fit::write(distribution, writer);
    integers.iter().for_each(|integer| distribution.encode(stream, *integer));
}

/// Reads `count` integers from `low` to `high`.
pub(crate) fn decode_integers(
    stream: &mut StreamDecoder<'_>,
    distribution: Distribution,
    count: usize,
    low: i32,
    high: i32,
    what: &'static str,
) -> Result<Vec<i32>> {
    let mut integers = reserve(what, count)?;
    for _ in 0..count {
        let integer = distribution.decode(stream)?;
        if !(low..=high).contains(&integer) {
            let value = integer.to_string();
            return Err(DecodeError::Malformed { part: stream.part(), what, value });
        }
        integers.push(integer);
    }
    Ok(integers)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    fn bits(bits: u8) -> WeightBits {
        WeightBits::new(bits).expect("a width that is possible")
    }

    fn mlp(random: &mut Pcg64Mcg, widths: &[usize]) -> Mlp {
        let mut layer = |inputs: usize, outputs: usize| {
            let bound = 1.0 / (inputs as f32).sqrt();
            let mut uniform = |count: usize| (0..count).map(|_| random.random_range(-bound..bound)).collect();
            DenseLayer { inputs, outputs, weights: uniform(inputs * outputs), bias: uniform(outputs) }
        };
        Mlp { layers: widths.windows(2).map(|pair| layer(pair[0], pair[1])).collect() }
    }

    fn float_forward(mlp: &Mlp, input: &[f64]) -> Vec<f64> {
        let mut values = input.to_vec();
        for (index, layer) in mlp.layers.iter().enumerate() {
            if index > 0 {
                values.iter_mut().for_each(|value| *value = value.max(0.0));
            }
            let rows = layer.weights.chunks(layer.inputs).zip(&layer.bias);
            values = rows
                .map(|(row, bias)| {
                    f64::from(*bias) + row.iter().zip(&values).map(|(w, x)| f64::from(*w) * x).sum::<f64>()
                })
                .collect();
        }
        values
    }

    fn integer_forward(mlp: &IntegerMlp, input: &[i16]) -> Vec<i32> {
        let mut activations = Activations { input: input.to_vec(), ..Activations::default() };
        activations.input.resize(padded(input.len()), 0);
        let mut outputs = Vec::new();
        mlp.outputs(&mut activations, &mut outputs);
        outputs
    }

    #[test]
    fn integers_follow_the_float_network_that_they_stand_for() {
        let mut random = Pcg64Mcg::seed_from_u64(1);
        for width in [8, 6, 4] {
            let mlp = mlp(&mut random, &[108, 32, 16, 13]);
            let integers = IntegerMlp::quantize(&mlp, bits(width));
            let floats = integers.as_floats();
            for _ in 0..50 {
                let input: Vec<i16> = (0..108).map(|_| random.random_range(-512..=512)).collect();
                let exact: Vec<f64> = input.iter().map(|x| f64::from(*x) / 256.0).collect();
                let outputs = integer_forward(&integers, &input);
                for (output, exact) in outputs.iter().zip(float_forward(&floats, &exact)) {
                    // Half a 2^-8 is rounded away in each layer; weights below 1 pass on less than sqrt(width) of it.
                    assert!((f64::from(*output) / 256.0 - exact).abs() < 6.0 / 256.0);
                }
            }
        }
    }

    #[test]
    fn weights_and_biases_are_within_half_a_unit() {
        let mut random = Pcg64Mcg::seed_from_u64(2);
        for width in [8, 6, 4] {
            let mlp = mlp(&mut random, &[40, 9]);
            let floats = IntegerMlp::quantize(&mlp, bits(width)).as_floats();
            let limit = bits(width).limit() as f32;
            for (row, back) in mlp.layers[0].weights.chunks(40).zip(floats.layers[0].weights.chunks(40)) {
                let largest = row.iter().fold(0.0_f32, |max, w| max.max(w.abs()));
                // Shifts are powers of two: up to a factor of two is lost, and half a unit by rounding.
                let bound = largest / limit * 1.01;
                assert!(row.iter().zip(back).all(|(a, b)| (a - b).abs() <= bound), "{width} bits");
            }
            let bias = mlp.layers[0].bias.iter().zip(&floats.layers[0].bias);
            assert!(bias.clone().all(|(a, b)| (a - b).abs() <= 0.5 / 256.0));
            let again = IntegerMlp::quantize(&floats, bits(width));
            assert_eq!(again.as_floats(), floats, "the stored form is a fixed point");
        }
    }

    /// The proof of the module, at its extremes; overflow would panic in this build.
    #[test]
    fn no_sum_overflows_at_the_extremes_of_every_range() {
        for sign in [1_i16, -1] {
            let stride = padded(MAX_INPUTS);
            for shift in [0, 1, MAX_SHIFT] {
                let layer = |bias: i32| IntegerLayer {
                    inputs: MAX_INPUTS,
                    shifts: vec![shift; MAX_INPUTS],
                    weights: vec![127 * sign; stride * MAX_INPUTS],
                    bias: vec![bias; MAX_INPUTS],
                };
                let bias = crate::symbols::MAX_SYMBOL * i32::from(sign);
                let mlp = IntegerMlp { layers: vec![layer(bias), layer(bias)], bits: bits(8) };
                let outputs = integer_forward(&mlp, &[MAX_ACTIVATION as i16; MAX_INPUTS]);
                assert!(outputs.iter().all(|output| output.abs() <= MAX_OUTPUT));
            }
        }
        let sum = 127_i64 * i64::from(MAX_ACTIVATION) * MAX_INPUTS as i64;
        assert!(sum + (1 << 14) + (1 << 24) < i64::from(i32::MAX));
    }

    #[test]
    fn networks_come_back_and_what_is_out_of_range_is_refused() {
        let mut random = Pcg64Mcg::seed_from_u64(3);
        for width in [8, 6, 4] {
            let mlp = IntegerMlp::quantize(&mlp(&mut random, &[18, 16, 7]), bits(width));
            let bytes = mlp.encode();
            let read = |bytes: &[u8], inputs, outputs| {
                IntegerMlp::decode("test", &mut Reader::new("test", bytes), inputs, outputs, u64::MAX)
            };
            assert_eq!(read(&bytes, 18, 7), Ok(mlp.clone()));
            assert!(read(&bytes, 18, 8).is_err() && read(&bytes, 17, 7).is_err());
            for length in 0..bytes.len() {
                // A cut stream may decode to other symbols, but never to the same ones.
                assert_ne!(read(&bytes[..length], 18, 7), Ok(mlp.clone()));
            }
            let mut narrower = bytes.clone();
            narrower[0] = width - 1;
            assert!(matches!(
                read(&narrower, 18, 7),
                Err(DecodeError::Malformed { part: "test", what: "a weight", .. })
            ));
            for wrong in [0, 1, 9, 255] {
                narrower[0] = wrong;
                assert!(matches!(read(&narrower, 18, 7), Err(DecodeError::Malformed { .. })));
            }
        }
    }

    #[test]
    fn networks_are_as_deep_and_wide_as_the_format_allows() {
        let constant = |widths: &[usize]| {
            let layer = |pair: &[usize]| DenseLayer {
                inputs: pair[0],
                outputs: pair[1],
                weights: vec![0.5; pair[0] * pair[1]],
                bias: vec![0.0; pair[1]],
            };
            Mlp { layers: widths.windows(2).map(layer).collect() }
        };
        let read = |widths: &[usize]| {
            let (inputs, outputs) = (widths[0], widths[widths.len() - 1]);
            let mlp = IntegerMlp::quantize(&constant(widths), bits(8));
            let bytes = mlp.encode();
            let read =
                IntegerMlp::decode("test", &mut Reader::new("test", &bytes), inputs, outputs, u64::MAX)?;
            assert_eq!(read, mlp);
            Ok::<_, DecodeError>(())
        };
        // As wide as all channels of the widest scene.
        for widths in [&[512, 513][..], &[1, 512, 513], &[3, 2, 2, 2, 2]] {
            let outputs = widths[widths.len() - 1];
            assert_eq!(IntegerMlp::check(&constant(widths), widths[0], outputs), Ok(()));
            assert_eq!(read(widths), Ok(()));
        }
        for (widths, wrong) in [
            (&[513, 1][..], "inputs of a network is 513"),
            (&[1, 513, 1], "layer width is 513"),
            (&[3, 2, 2, 2, 2, 2], "number of layers is 5"),
        ] {
            let outputs = widths[widths.len() - 1];
            assert!(IntegerMlp::check(&constant(widths), widths[0], outputs).is_err(), "{widths:?}");
            let error = read(widths).expect_err("must be refused").to_string();
            assert!(error.contains(wrong), "{error}");
        }
    }

    #[test]
    fn the_memory_limit_covers_weights_and_rows() {
        let mut random = Pcg64Mcg::seed_from_u64(4);
        let bytes = IntegerMlp::quantize(&mlp(&mut random, &[18, 40, 7]), bits(8)).encode();
        let read = IntegerMlp::decode("test", &mut Reader::new("test", &bytes), 18, 7, 1);
        let Err(DecodeError::Limit { value, limit: 1, .. }) = read else { panic!("{read:?}") };
        // Padded rows of 16 bits; a shift and a bias a row, first as 32 bits.
        let memory = 40 * (2 * 32 + 9) + 7 * (2 * 48 + 9);
        assert!((memory..=4 * memory).contains(&value), "{value} bytes for {memory}");
    }

    #[test]
    fn rows_of_zeros_and_of_huge_or_tiny_weights_are_stored() {
        assert_eq!(quantize_row(&[0.0, 0.0], 127), (0, vec![0, 0]));
        assert_eq!(quantize_row(&[1000.0, -3.0], 127), (0, vec![127, -3]));
        assert_eq!(quantize_row(&[1e-20, -1e-30], 127), (MAX_SHIFT, vec![0, 0]));
        assert_eq!(quantize_row(&[0.5, -0.25], 7), (3, vec![4, -2]));
        assert_eq!(quantize_bias(1e20), crate::symbols::MAX_SYMBOL);
    }
}
