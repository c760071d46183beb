//! Corrects a model's distributions by the anchor's own earlier channels: what a symbol was, against what was expected of it, shifts the
//! means of the later channels of its group and, with them, their standard deviations (METHOD.md §4.13).
//!
//! Integers only, with proved ranges: a file decodes to the same symbols everywhere.

use super::quant_steps::MAX_MEAN;
use crate::{
    bytes::{Reader, Writer},
    error::Result,
    gaussian::Gaussian,
    gaussian_constants::{INVERSE_SCALE, SCALES},
    symbols::Distribution,
};

/// One, as weights, deviation factors and slopes count: 2^8.
pub(crate) const ONE: i32 = 1 << 8;

/// Largest magnitude of a weight, a deviation factor or a slope.
pub(crate) const MAX_WEIGHT: i32 = 1 << 15;

/// Largest magnitude of a shift of the mean, in sixteenths of a step.
pub(crate) const MAX_SHIFT: i32 = 1 << 24;

/// Unit of a standard deviation: 2^-12 steps.
const DEVIATION_BITS: u32 = 12;

/// Largest standard deviation; times the largest entry of [`INVERSE_SCALE`], it fits 63 bits.
const MAX_DEVIATION: i64 = 1 << 36;

/// 2^22 over a standard deviation in steps, times one in 2^-12 steps, where the two are equal.
const EQUAL: i64 = 1 << (22 + DEVIATION_BITS);

/// What regressions know of a channel: its symbol less the mean that was expected, in sixteenths of a step; 0 of one that is not coded or
/// always the same.
pub(crate) fn residual(base: Distribution, symbol: Option<i32>) -> i64 {
    match (base, symbol) {
        (Distribution::Gaussian(gaussian), Some(symbol)) => {
            16 * i64::from(symbol) - i64::from(gaussian.mean16)
        }
        _ => 0,
    }
}

/// How one channel follows from those before it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ChannelRegression {
    /// Added to the mean, in sixteenths of a step.
    pub(crate) shift: i32,
    /// Factor of the model's standard deviation, in 2^-8; at least 1.
    pub(crate) deviation: i32,
    /// Standard deviation per distance of the mean from the model's, in 2^-8.
    pub(crate) slope: i32,
    /// Of each channel before this one, in 2^-8.
    pub(crate) weights: Vec<i32>,
}

impl ChannelRegression {
    /// The model's distribution, given the `residuals` of the channels before; a constant stays one.
    pub(crate) fn corrected(&self, model: Distribution, residuals: &[i64]) -> Distribution {
        match model {
            Distribution::Gaussian(gaussian) => Distribution::Gaussian(self.gaussian(gaussian, residuals)),
            Distribution::Constant(_) => model,
        }
    }

    fn gaussian(&self, model: Gaussian, residuals: &[i64]) -> Gaussian {
        let weighted =
            self.weights.iter().zip(residuals).map(|(weight, residual)| i64::from(*weight) * residual);
        let one = i64::from(ONE);
        // At most 255 x 2^15 x 2^30, and 2^15 x 2^29 in the slope's product.
        let sum: i64 = weighted.sum();
        let shifted = i64::from(model.mean16) + i64::from(self.shift) + (sum + one / 2).div_euclid(one);
        let mean16 = shifted.clamp(-MAX_MEAN, MAX_MEAN);
        let of_model = EQUAL / i64::from(INVERSE_SCALE[usize::from(model.scale)]);
        let deviation = (i64::from(self.deviation) * of_model).div_euclid(one)
            + i64::from(self.slope) * (mean16 - i64::from(model.mean16));
        let deviation = deviation.clamp(1, MAX_DEVIATION);
        let narrower = INVERSE_SCALE.partition_point(|inverse| deviation * i64::from(*inverse) > EQUAL);
        Gaussian { mean16: mean16 as i32, scale: narrower.min(SCALES - 1) as u8 }
    }
}

/// How the channels of a group follow from each other; `None` for a channel that its model alone describes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct GroupRegression {
    pub(crate) channels: Vec<Option<ChannelRegression>>,
}

impl GroupRegression {
    /// The distribution of channel `channel`, given the model's and the residuals of those before.
    pub(crate) fn corrected(&self, channel: usize, model: Distribution, residuals: &[i64]) -> Distribution {
        self.channels[channel].as_ref().map_or(model, |regression| regression.corrected(model, residuals))
    }

    /// Multiplications for one anchor.
    pub(crate) fn multiplications(channels: usize) -> u64 {
        channels as u64 * channels as u64 / 2
    }

    /// Appends this group's part of the section.
    pub(crate) fn write(&self, writer: &mut Writer) {
        for channel in &self.channels {
            let Some(ChannelRegression { shift, deviation, slope, weights }) = channel else {
                writer.varint(0);
                continue;
            };
            writer.varint(u64::from(deviation.unsigned_abs()));
            writer.signed(i64::from(*shift));
            writer.signed(i64::from(*slope));
            weights.iter().for_each(|weight| writer.signed(i64::from(*weight)));
        }
    }

    /// Reads what [`Self::write`] wrote of a group of `channels` channels.
    fn read(reader: &mut Reader<'_>, channels: usize) -> Result<Self> {
        let mut read = Vec::with_capacity(channels);
        for channel in 0..channels {
            let deviation = reader.count("a deviation factor", 0..=MAX_WEIGHT as usize)? as i32;
            if deviation == 0 {
                read.push(None);
                continue;
            }
            let mut signed = |what: &'static str, limit: i32| {
                let value = reader.signed(what)?;
                let allowed = value.unsigned_abs() <= u64::from(limit.unsigned_abs());
                if allowed { Ok(value as i32) } else { Err(reader.malformed(what, value)) }
            };
            let shift = signed("a shift", MAX_SHIFT)?;
            let slope = signed("a slope", MAX_WEIGHT)?;
            let weights = (0..channel).map(|_| signed("a weight", MAX_WEIGHT)).collect::<Result<_, _>>()?;
            read.push(Some(ChannelRegression { shift, deviation, slope, weights }));
        }
        Ok(Self { channels: read })
    }
}

/// The section: which groups have a regression, then each of them; `None` where no group has one.
pub(crate) fn encode(groups: [Option<&GroupRegression>; 3]) -> Option<Vec<u8>> {
    let flags = flags_of(groups.map(|group| group.is_some()));
    if flags == 0 {
        return None;
    }
    let mut writer = Writer::new();
    writer.u8(flags);
    groups.into_iter().flatten().for_each(|group| group.write(&mut writer));
    Some(writer.into_bytes())
}

fn flags_of(groups: [bool; 3]) -> u8 {
    (0..3).map(|group| u8::from(groups[group]) << group).sum()
}

/// The section read: each group's regression, and how many bytes it takes.
pub(crate) struct Regressions {
    pub(crate) groups: [Option<GroupRegression>; 3],
    pub(crate) lengths: [usize; 3],
}

impl Regressions {
    /// Bytes before the first group.
    pub(crate) const FLAGS_BYTES: usize = 1;

    /// Of a file without the section.
    pub(crate) const NONE: Self = Self { groups: [None, None, None], lengths: [0; 3] };

    /// Reads the section of groups of `channels` channels.
    pub(crate) fn read(section: &[u8], channels: [usize; 3]) -> Result<Self> {
        let mut reader = Reader::new("regression", section);
        let flags = reader.u8("groups")?;
        if flags == 0 || flags > flags_of([true; 3]) {
            return Err(reader.malformed("groups", flags));
        }
        let mut read = Self::NONE;
        for (group, channels) in channels.into_iter().enumerate() {
            let start = reader.position();
            if flags >> group & 1 == 1 {
                read.groups[group] = Some(GroupRegression::read(&mut reader, channels)?);
            }
            read.lengths[group] = reader.position() - start;
        }
        reader.end()?;
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unchanged(weights: usize) -> ChannelRegression {
        ChannelRegression { shift: 0, deviation: ONE, slope: 0, weights: vec![0; weights] }
    }

    #[test]
    fn without_weights_a_gaussian_stays_as_it_is() {
        for scale in 0..SCALES as u8 {
            for mean16 in [0, -37, 1 << 20, -(1 << 28)] {
                let model = Gaussian { mean16, scale };
                assert_eq!(unchanged(2).gaussian(model, &[99, -1 << 29]), model);
            }
        }
    }

    #[test]
    fn means_and_deviations_are_those_of_the_equations() {
        let model = Gaussian { mean16: 160, scale: 24 };
        let sigma = libm::exp2(-3.5 + 7.0 * 24.0 / 32.0);
        for (shift, deviation, slope, weights, residuals) in [
            (0, 256, 0, [128, 0], [320, 7]),
            (-9, 300, 8, [-77, 256], [1000, -50]),
            (5, 40, 100, [30, 3], [5000, 9]),
            (0, 256, -300, [256, 0], [-90, 4]),
        ] {
            let regression = ChannelRegression { shift, deviation, slope, weights: weights.to_vec() };
            let found = regression.gaussian(model, &residuals);
            let sum: f64 = weights.iter().zip(residuals).map(|(w, r)| f64::from(*w) / 256.0 * r as f64).sum();
            let mean = 160.0 + f64::from(shift) + sum;
            assert!((f64::from(found.mean16) - mean).abs() <= 0.5, "{regression:?}: {found:?}, {mean}");
            let expected = f64::from(deviation) / 256.0 * sigma
                + f64::from(slope) / 256.0 * (f64::from(found.mean16) - 160.0) / 16.0;
            // The next of the 64 that is no narrower.
            let next = (16.0 + 32.0 / 7.0 * expected.log2()).ceil();
            assert!((f64::from(found.scale) - next).abs() < 1e-9, "{regression:?}: {found:?}, {expected}");
        }
    }

    #[test]
    fn a_deviation_below_zero_is_the_narrowest_and_one_beyond_the_table_the_widest() {
        let model = Gaussian { mean16: 0, scale: 24 };
        let regression = ChannelRegression { shift: 0, deviation: ONE, slope: 1000, weights: vec![ONE] };
        assert_eq!(regression.gaussian(model, &[-1000]), Gaussian { mean16: -1000, scale: 0 });
        assert_eq!(regression.gaussian(model, &[1 << 20]), Gaussian { mean16: 1 << 20, scale: 63 });
    }

    #[test]
    fn the_largest_numbers_of_the_format_do_not_overflow() {
        let weights = vec![-MAX_WEIGHT; 255];
        let residuals = vec![-(1_i64 << 30); 255];
        for sign in [1, -1] {
            let regression = ChannelRegression {
                shift: sign * MAX_SHIFT,
                deviation: MAX_WEIGHT,
                slope: sign * MAX_WEIGHT,
                weights: weights.iter().map(|weight| sign * weight).collect(),
            };
            for model in [Gaussian { mean16: 1 << 28, scale: 63 }, Gaussian { mean16: -(1 << 28), scale: 0 }]
            {
                let found = regression.gaussian(model, &residuals);
                assert!(i64::from(found.mean16).abs() <= MAX_MEAN && usize::from(found.scale) < SCALES);
            }
        }
    }

    #[test]
    fn a_section_comes_back_and_what_it_must_not_hold_is_refused() {
        let channel = |weights: Vec<i32>| ChannelRegression { shift: -3, deviation: 500, slope: 7, weights };
        let group = GroupRegression {
            channels: vec![None, Some(channel(vec![-300])), None, Some(channel(vec![1, MAX_WEIGHT, -9]))],
        };
        let section = encode([None, Some(&group), None]).expect("a group has one");
        let read = Regressions::read(&section, [9, 4, 2]).expect("reads");
        assert_eq!(read.groups, [None, Some(group), None]);
        assert_eq!(read.lengths, [0, section.len() - Regressions::FLAGS_BYTES, 0]);
        assert_eq!(encode([None; 3]), None);

        let refused = |section: &[u8]| Regressions::read(section, [1, 1, 1]).is_err();
        assert!(!refused(&[1, 0]));
        for section in [&[][..], &[0], &[8, 0], &[1], &[1, 0, 0], &[1, 0x81, 0x80, 0x02, 0, 0]] {
            assert!(refused(section), "{section:?}");
        }
    }
}
