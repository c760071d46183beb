//! Tri-planes of integers as a file stores them: latents and the up-sampling layers that make planes of them.
//!
//! Plane values are in 2^-8 and at most 2^14 - 1 in magnitude.

use super::{
    dense::{MAX_ACTIVATION, MAX_INPUTS, MAX_SHIFT, decode_integers, encode_integers},
    latents::{self, MAX_LATENT, PART},
    texels::{MAX_PLANE_EDGE, PLANES, PlaneTexels},
    upsampling::{IntegerUpLayer, MAX_WEIGHT, Taps},
};
use crate::{
    alloc::check_limit,
    bytes::{Reader, Writer},
    domain::Planes,
    error::Result,
    fit,
    range::{StreamDecoder, StreamEncoder},
};

/// Most channels of a latent or a plane: four taps of each are the most inputs of a dense layer.
const MAX_CHANNELS: usize = MAX_INPUTS / 4;

/// Most up-sampling layers.
const MAX_LAYERS: usize = 6;

/// Most values of the three planes, or of what any layer makes of them. It bounds memory and time whatever a file says.
const MAX_VALUES: usize = 1 << 24;

/// Planes as a file stores them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct IntegerPlanes {
    edge: usize,
    channels: usize,
    /// `[3][channels][edge][edge]`, in 2^-4.
    latents: Vec<i8>,
    layers: Vec<IntegerUpLayer>,
}

impl IntegerPlanes {
    /// Checks that planes can be stored; the error is a description.
    pub(crate) fn check(planes: &Planes) -> Result<(), String> {
        let (mut edge, mut channels) = (planes.edge, planes.channels);
        if planes.layers.len() > MAX_LAYERS {
            return Err(format!("{} layers where at most {MAX_LAYERS} are possible", planes.layers.len()));
        }
        check_size(edge, channels).map_err(|(what, value)| format!("{what} is {value}"))?;
        if planes.latents.len() != PLANES * channels * edge * edge {
            return Err(format!(
                "{} latents for {channels} channels of {edge} x {edge}",
                planes.latents.len()
            ));
        }
        let mut finite = planes.latents.iter().all(|latent| latent.is_finite());
        for layer in &planes.layers {
            let weights = layer.inputs * layer.outputs * 9;
            if layer.inputs != channels || layer.weights.len() != weights || layer.bias.len() != layer.outputs
            {
                return Err("a layer whose parts do not fit".to_owned());
            }
            finite &= layer.weights.iter().chain(&layer.bias).all(|value| value.is_finite());
            (edge, channels) = (2 * edge, layer.outputs);
            check_size(edge, channels).map_err(|(what, value)| format!("{what} is {value}"))?;
        }
        if finite { Ok(()) } else { Err("a value that is not finite".to_owned()) }
    }

    /// The integers of planes that were checked.
    pub(crate) fn quantize(planes: &Planes) -> Self {
        let limit = MAX_LATENT as f32;
        let latent = |value: &f32| (value * 16.0).round_ties_even().clamp(-limit, limit) as i8;
        Self {
            edge: planes.edge,
            channels: planes.channels,
            latents: planes.latents.iter().map(latent).collect(),
            layers: planes.layers.iter().map(IntegerUpLayer::quantize).collect(),
        }
    }

    /// The planes as floats.
    pub(crate) fn as_floats(&self) -> Planes {
        Planes {
            edge: self.edge,
            channels: self.channels,
            latents: self.latents.iter().map(|latent| f32::from(*latent) / 16.0).collect(),
            layers: self.layers.iter().map(IntegerUpLayer::as_floats).collect(),
        }
    }

    /// Channels of the planes.
    pub(crate) fn plane_channels(&self) -> usize {
        self.layers.last().map_or(self.channels, |layer| layer.bias.len())
    }

    /// The planes, up-sampled.
    pub(crate) fn texels(&self) -> PlaneTexels {
        let size = self.edge * self.edge;
        let (mut edge, mut channels) = (self.edge, self.channels);
        // Channels last, as samples and layers take all channels of a place together.
        let mut values = vec![0; self.latents.len()];
        for (plane, latents) in values.chunks_mut(size * channels).zip(self.latents.chunks(size * channels)) {
            for (channel, image) in latents.chunks(size).enumerate() {
                for (place, latent) in image.iter().enumerate() {
                    plane[place * channels + channel] = i16::from(*latent) << 4;
                }
            }
        }
        for (index, layer) in self.layers.iter().enumerate() {
            let low = if index + 1 < self.layers.len() { 0 } else { -MAX_ACTIVATION };
            let taps = Taps::new(layer);
            values = values
                .chunks(edge * edge * channels)
                .flat_map(|plane| taps.apply(plane, edge, low))
                .collect();
            (edge, channels) = (2 * edge, layer.bias.len());
        }
        PlaneTexels { edge, channels, values }
    }

    /// The planes section.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut writer = Writer::new();
        let mut stream = StreamEncoder::new();
        [self.edge, self.channels, self.layers.len()].iter().for_each(|count| writer.varint(*count as u64));
        for layer in &self.layers {
            writer.varint(layer.bias.len() as u64);
            encode_integers(layer.shifts.iter().map(|shift| i32::from(*shift)), &mut writer, &mut stream);
            encode_integers(layer.weights.iter().map(|w| i32::from(*w)), &mut writer, &mut stream);
            encode_integers(layer.bias.iter().copied(), &mut writer, &mut stream);
        }
        latents::encode(&self.latents, self.edge, &mut stream);
        writer.raw(&stream.finish());
        writer.into_bytes()
    }

    /// Reads the planes section.
    pub(crate) fn decode(section: &[u8], max_memory_bytes: u64) -> Result<Self> {
        let mut reader = Reader::new(PART, section);
        let edge = reader.count("edge of a latent", 1..=MAX_PLANE_EDGE)?;
        let channels = reader.count("channels of a latent", 1..=MAX_CHANNELS)?;
        let count = reader.count("number of layers", 0..=MAX_LAYERS)?;
        let mut heads = Vec::new();
        let (mut wide, mut deep) = (edge, channels);
        let mut max = PLANES * channels * edge * edge;
        check_size(wide, deep).map_err(|(what, value)| reader.malformed(what, value))?;
        for _ in 0..count {
            let outputs = reader.count("channels of a layer", 1..=MAX_CHANNELS)?;
            heads.push((
                deep,
                outputs,
                [fit::read(&mut reader)?, fit::read(&mut reader)?, fit::read(&mut reader)?],
            ));
            (wide, deep) = (2 * wide, outputs);
            check_size(wide, deep).map_err(|(what, value)| reader.malformed(what, value))?;
            max = max.max(PLANES * deep * wide * wide);
        }
        // Input and output of a layer, and the planes joined.
        let memory = 3 * 2 * max as u64;
        check_limit("bytes of memory for planes", memory, max_memory_bytes)?;
        let mut stream = StreamDecoder::new(PART, reader.rest())?;
        let mut layers = Vec::new();
        for (inputs, outputs, [of_shifts, of_weights, of_bias]) in heads {
            let shifts =
                decode_integers(&mut stream, of_shifts, outputs, 0, i32::from(MAX_SHIFT), "a shift")?;
            let size = inputs * outputs * 9;
            let weights =
                decode_integers(&mut stream, of_weights, size, -MAX_WEIGHT, MAX_WEIGHT, "a weight")?;
            let limit = crate::symbols::MAX_SYMBOL;
            let bias = decode_integers(&mut stream, of_bias, outputs, -limit, limit, "a bias")?;
            layers.push(IntegerUpLayer {
                inputs,
                shifts: shifts.into_iter().map(|shift| shift as u8).collect(),
                weights: weights.into_iter().map(|weight| weight as i16).collect(),
                bias,
            });
        }
        let latents = latents::decode(PLANES * channels, edge, &mut stream)?;
        stream.finish()?;
        Ok(Self { edge, channels, latents, layers })
    }
}

/// Checks the size of planes; the error is the name of the value and the value.
fn check_size(edge: usize, channels: usize) -> Result<(), (&'static str, usize)> {
    if !(1..=MAX_PLANE_EDGE).contains(&edge) {
        return Err(("the edge of a plane", edge));
    }
    if !(1..=MAX_CHANNELS).contains(&channels) {
        return Err(("the channels of a plane", channels));
    }
    match PLANES * channels * edge * edge {
        ..=MAX_VALUES => Ok(()),
        values => Err(("the number of plane values", values)),
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::{
        DecodeError,
        context::{floats::up_sampled, texels},
        domain::UpLayer,
    };

    fn planes(random: &mut Pcg64Mcg, edge: usize, widths: &[usize]) -> Planes {
        let mut uniform = |count: usize, bound: f32| -> Vec<f32> {
            (0..count).map(|_| random.random_range(-bound..bound)).collect()
        };
        Planes {
            edge,
            channels: widths[0],
            latents: uniform(PLANES * widths[0] * edge * edge, 3.0),
            layers: widths
                .windows(2)
                .map(|pair| UpLayer {
                    inputs: pair[0],
                    outputs: pair[1],
                    weights: uniform(pair[0] * pair[1] * 9, 0.5),
                    bias: uniform(pair[1], 0.3),
                })
                .collect(),
        }
    }

    #[test]
    fn up_sampling_follows_its_definition() {
        let mut random = Pcg64Mcg::seed_from_u64(4);
        for widths in [&[3][..], &[4, 5], &[3, 6, 4], &[2, 3, 3, 2]] {
            let integers = IntegerPlanes::quantize(&planes(&mut random, 3, widths));
            let exact = up_sampled(&integers.as_floats());
            let texels = integers.texels();
            let channels = *widths.last().expect("a width");
            assert_eq!((texels.edge, texels.channels), (3 << (widths.len() - 1), channels));
            let size = texels.edge * texels.edge;
            for (index, value) in texels.values.iter().enumerate() {
                let (plane, rest) = (index / (size * channels), index % (size * channels));
                let exact = exact[(plane * channels + rest % channels) * size + rest / channels];
                // Half a 2^-8 a layer, grown by weights of at most 24 terms of 0.5.
                let bound = [0.01, 0.5, 4.0, 12.0][widths.len() - 1] / 256.0;
                assert!((f64::from(*value) / 256.0 - exact).abs() <= bound, "{value} for {exact}");
            }
        }
    }

    #[test]
    fn the_stored_form_is_a_fixed_point_and_comes_back() {
        let mut random = Pcg64Mcg::seed_from_u64(5);
        for widths in [&[3][..], &[4, 5], &[2, 16, 8]] {
            let integers = IntegerPlanes::quantize(&planes(&mut random, 5, widths));
            assert_eq!(IntegerPlanes::quantize(&integers.as_floats()), integers);
            let section = integers.encode();
            assert_eq!(IntegerPlanes::decode(&section, u64::MAX), Ok(integers.clone()));
            assert!(matches!(IntegerPlanes::decode(&section, 100), Err(DecodeError::Limit { .. })));
            for length in 0..section.len() {
                // A cut stream may decode to other symbols, but never to the same ones.
                assert_ne!(IntegerPlanes::decode(&section[..length], u64::MAX), Ok(integers.clone()));
            }
        }
    }

    #[test]
    fn sizes_beyond_the_format_are_refused() {
        let section = |counts: &[u64]| {
            let mut writer = Writer::new();
            counts.iter().for_each(|count| writer.varint(*count));
            writer.into_bytes()
        };
        for counts in [[0, 1, 0], [1025, 1, 0], [1, 0, 0], [1, 129, 0], [1, 1, 7], [1024, 6, 0]] {
            let result = IntegerPlanes::decode(&section(&counts), u64::MAX);
            assert!(matches!(result, Err(DecodeError::Malformed { .. })), "{counts:?}: {result:?}");
        }
        let mut random = Pcg64Mcg::seed_from_u64(6);
        let good = planes(&mut random, 2, &[2, 3]);
        assert_eq!(IntegerPlanes::check(&good), Ok(()));
        let refused = |change: fn(&mut Planes)| {
            let mut planes = good.clone();
            change(&mut planes);
            assert!(IntegerPlanes::check(&planes).is_err());
        };
        refused(|planes| planes.latents[0] = f32::NAN);
        refused(|planes| planes.layers[0].bias[0] = f32::INFINITY);
        refused(|planes| planes.edge = 3);
        refused(|planes| planes.layers[0].inputs = 3);
        refused(|planes| planes.layers[0].outputs = 0);
        refused(|planes| planes.layers[0].weights.push(0.0));
        refused(|planes| planes.layers[0].bias.push(0.0));
        refused(|planes| (planes.layers[0].inputs, planes.layers[0].outputs) = (3, 2));
        refused(|planes| planes.latents.push(0.0));
    }

    /// Edge, channels and layers of `channels` channels, each constant.
    fn constant_planes(edge: u64, widths: &[u64]) -> Vec<u8> {
        let mut writer = Writer::new();
        [edge, widths[0], widths.len() as u64 - 1].iter().for_each(|count| writer.varint(*count));
        for width in &widths[1..] {
            writer.varint(*width);
            writer.raw(&[0, 64, 0, 64, 0, 64]);
        }
        writer.into_bytes()
    }

    #[test]
    fn planes_are_as_large_as_the_format_allows_after_every_layer() {
        let refusal = |edge: u64, widths: &[u64]| {
            let section = constant_planes(edge, widths);
            IntegerPlanes::decode(&section, 1).expect_err("no memory is allowed").to_string()
        };
        for (edge, widths) in
            [(512, &[1, 1][..]), (16, &[1; 7]), (1, &[128, 128]), (512, &[1, 5]), (1023, &[5])]
        {
            let error = refusal(edge, widths);
            assert!(error.contains("bytes of memory for planes"), "{edge}, {widths:?}: {error}");
        }
        for (edge, widths, wrong) in [
            (513, &[1, 1][..], "the edge of a plane is 1026"),
            (257, &[1, 1, 1], "the edge of a plane is 1028"),
            (1, &[1; 8], "number of layers is 7"),
            (1, &[1, 129], "channels of a layer is 129"),
            (512, &[1, 6], "the number of plane values is 18874368"),
            (512, &[1, 6, 1], "the number of plane values is 18874368"),
        ] {
            let error = refusal(edge, widths);
            assert!(error.contains(wrong), "{edge}, {widths:?}: {error}");
        }
        let mut random = Pcg64Mcg::seed_from_u64(8);
        assert_eq!(IntegerPlanes::check(&planes(&mut random, 2, &[1; 7])), Ok(()));
        for (edge, widths) in [(2, &[1; 8][..]), (513, &[1, 1])] {
            assert!(IntegerPlanes::check(&planes(&mut random, edge, widths)).is_err());
        }
    }

    #[test]
    fn the_memory_limit_covers_the_largest_layer() {
        for (edge, widths, largest) in [
            (8, &[3][..], 3 * 3 * 64),
            (8, &[3, 5], 3 * 5 * 256),
            (8, &[100, 2], 3 * 100 * 64),
            (4, &[2, 50, 1], 3 * 50 * 64),
        ] {
            let read = IntegerPlanes::decode(&constant_planes(edge, widths), 1);
            let Err(DecodeError::Limit { value, limit: 1, .. }) = read else { panic!("{read:?}") };
            // Values of 16 bits: input and output of a layer, and the planes joined.
            assert_eq!(value, 3 * 2 * largest, "{widths:?} at {edge}");
        }
    }

    #[test]
    fn no_sum_overflows_at_the_extremes_of_every_range() {
        for sign in [1_i16, -1] {
            let (inputs, outputs) = (MAX_CHANNELS, 2);
            let layer = IntegerUpLayer {
                inputs,
                shifts: vec![0, MAX_SHIFT],
                weights: vec![127 * sign; inputs * outputs * 9],
                bias: vec![(1 << 24) * i32::from(sign); outputs],
            };
            let values =
                Taps::new(&layer).apply(&vec![MAX_ACTIVATION as i16; 4 * inputs], 2, -MAX_ACTIVATION);
            let texels = PlaneTexels { edge: 4, channels: outputs, values: values.repeat(PLANES) };
            let mut sample = vec![0; texels.sample_width()];
            for v in [-(1 << 17), -70_000, 0, 1 << 17] {
                texels.sample(&texels::texels([v; 3], 4), &mut sample);
                assert!(sample.iter().all(|value| value.abs() == MAX_ACTIVATION as i16), "{sample:?}");
            }
        }
    }

    #[test]
    fn samples_are_bilinear() {
        let mut random = Pcg64Mcg::seed_from_u64(7);
        let texels = IntegerPlanes::quantize(&planes(&mut random, 6, &[3])).texels();
        let mut sample = vec![0; texels.sample_width()];
        for v in (-(1 << 17)..=1 << 17).step_by(3001) {
            let places = texels::texels([v, -v, v / 3], texels.edge());
            texels.sample(&places, &mut sample);
            for (plane, place) in places.iter().enumerate() {
                for channel in 0..3 {
                    let at = |x: u32, y: u32| {
                        let index = ((plane * 6 + y as usize) * 6 + x as usize) * 3 + channel;
                        f64::from(texels.values[index])
                    };
                    let (fx, fy) = (f64::from(place.fx) / 256.0, f64::from(place.fy) / 256.0);
                    let exact = (at(place.x0, place.y0) * (1.0 - fx) + at(place.x1, place.y0) * fx)
                        * (1.0 - fy)
                        + (at(place.x0, place.y1) * (1.0 - fx) + at(place.x1, place.y1) * fx) * fy;
                    assert_eq!(f64::from(sample[plane * 3 + channel]), libm::floor(exact));
                }
            }
        }
    }
}
