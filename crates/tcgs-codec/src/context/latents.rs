//! Latents of planes as adaptive bits: each value is predicted from the previous one and the one above, if that pays.
//!
//! A plane's channels differ in amplitude and smoothness, and there are few values to learn them from. So the only side information is one
//! bit a channel, whether to predict; the magnitude of a value is coded in the context of its neighbors' magnitudes.

use crate::{
    adaptive::AdaptiveBit,
    alloc::reserve,
    error::{DecodeError, Result},
    range::{StreamDecoder, StreamEncoder},
};

/// Section that has the latents, as errors name it.
pub(crate) const PART: &str = "planes";

/// Largest magnitude of a latent, in 2^-4.
pub(crate) const MAX_LATENT: i32 = 127;

/// Binary digits of the largest difference between two latents.
const DIGITS: usize = 8;

/// Values `[images][edge][edge]` in turn, each image predicted or not.
pub(crate) fn encode(latents: &[i8], edge: usize, stream: &mut StreamEncoder) {
    let mut contexts = LatentContexts::new();
    let mut bit = |context: &mut AdaptiveBit, bit: bool| {
        stream.adaptive(context, bit);
        Ok(bit)
    };
    for image in latents.chunks(edge * edge) {
        let mut image: Vec<i8> = image.to_vec();
        let predicted = size(&image, edge, true) < size(&image, edge, false);
        contexts.image(&mut bit, &mut image, edge, predicted).expect("an encoder gets back what it gives");
    }
}

/// Reads `count` images.
pub(crate) fn decode(count: usize, edge: usize, stream: &mut StreamDecoder<'_>) -> Result<Vec<i8>> {
    let size = edge * edge;
    let mut latents = reserve("latents of planes", count * size)?;
    let mut contexts = LatentContexts::new();
    let mut bit = |context: &mut AdaptiveBit, _| stream.adaptive(context);
    for _ in 0..count {
        let start = latents.len();
        latents.resize(start + size, 0);
        contexts.image(&mut bit, &mut latents[start..], edge, false)?;
    }
    Ok(latents)
}

/// Digits of all residuals, an estimate of their cost.
fn size(image: &[i8], edge: usize, predicted: bool) -> u32 {
    (0..image.len())
        .map(|place| digits(i32::from(image[place]) - prediction(image, edge, place, predicted)) as u32)
        .sum()
}

/// The mean of the value to the left and the one above, rounded down; at the rim the one that exists; first of all, zero.
fn prediction(image: &[i8], edge: usize, place: usize, predicted: bool) -> i32 {
    let (column, row) = (place % edge, place / edge);
    let left = || i32::from(image[place - 1]);
    let above = || i32::from(image[place - edge]);
    match (predicted, column, row) {
        (false, ..) | (true, 0, 0) => 0,
        (true, _, 0) => left(),
        (true, 0, _) => above(),
        (true, ..) => (left() + above()) >> 1,
    }
}

/// Binary digits of a magnitude.
fn digits(value: i32) -> usize {
    (i32::BITS - value.abs().leading_zeros()) as usize
}

/// The probabilities, common to all images.
struct LatentContexts {
    predicted: AdaptiveBit,
    /// Whether a residual has more digits than a number, by the digits of its neighbors.
    digits: [[AdaptiveBit; DIGITS]; DIGITS + 1],
    /// Signs, by the signs of the two neighbors.
    sign: [AdaptiveBit; 9],
    /// Lower digits, by the number of digits and the place.
    lower: [[AdaptiveBit; DIGITS]; DIGITS + 1],
}

impl LatentContexts {
    fn new() -> Self {
        let new = AdaptiveBit::NEW;
        Self {
            predicted: new,
            digits: [[new; DIGITS]; DIGITS + 1],
            sign: [new; 9],
            lower: [[new; DIGITS]; DIGITS + 1],
        }
    }

    /// Codes an image with `bit`, which returns its argument (encoding) or the bit that it reads (decoding).
    fn image(
        &mut self,
        bit: &mut impl FnMut(&mut AdaptiveBit, bool) -> Result<bool>,
        image: &mut [i8],
        edge: usize,
        predicted: bool,
    ) -> Result<()> {
        let predicted = bit(&mut self.predicted, predicted)?;
        // Residuals of this row so far, and of the row above to the right of them.
        let mut residuals = vec![0_i32; edge];
        for place in 0..image.len() {
            let column = place % edge;
            let left = if column > 0 { residuals[column - 1] } else { 0 };
            let above = residuals[column];
            let expected = prediction(image, edge, place, predicted);
            let residual = self.residual(bit, i32::from(image[place]) - expected, left, above)?;
            let value = expected + residual;
            if value.abs() > MAX_LATENT {
                return Err(DecodeError::malformed(PART, "a latent", value));
            }
            residuals[column] = residual;
            image[place] = value as i8;
        }
        Ok(())
    }

    fn residual(
        &mut self,
        bit: &mut impl FnMut(&mut AdaptiveBit, bool) -> Result<bool>,
        residual: i32,
        left: i32,
        above: i32,
    ) -> Result<i32> {
        let around = digits((left.abs() + above.abs() + 1) >> 1);
        let wanted = digits(residual);
        let mut count = 0;
        while count < DIGITS && bit(&mut self.digits[around][count], wanted > count)? {
            count += 1;
        }
        if count == 0 {
            return Ok(0);
        }
        let signs = (left.signum() + 1) * 3 + above.signum() + 1;
        let negative = bit(&mut self.sign[signs as usize], residual < 0)?;
        let mut magnitude = 1;
        for digit in (0..count - 1).rev() {
            let one = bit(&mut self.lower[count][digit], residual.abs() >> digit & 1 == 1)?;
            magnitude = magnitude << 1 | i32::from(one);
        }
        Ok(if negative { -magnitude } else { magnitude })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn coded(latents: &[i8], edge: usize) -> Vec<u8> {
        let mut stream = StreamEncoder::new();
        encode(latents, edge, &mut stream);
        stream.finish()
    }

    fn read(bytes: &[u8], count: usize, edge: usize) -> Result<Vec<i8>> {
        let mut stream = StreamDecoder::new("test", bytes)?;
        let latents = decode(count, edge, &mut stream)?;
        stream.finish()?;
        Ok(latents)
    }

    #[test]
    fn smooth_and_empty_images_cost_little() {
        assert!(coded(&[0; 4096], 16).len() < 8);
        let smooth: Vec<i8> = (0..4096).map(|i| ((i % 32) * 3 + (i / 32) - 90) as i8).collect();
        let rough: Vec<i8> = (0..4096_i32).map(|i| (i * 7919 % 251 - 125) as i8).collect();
        assert!(coded(&smooth[..1024], 32).len() < 300, "{}", coded(&smooth[..1024], 32).len());
        assert!(coded(&rough, 16).len() < 4300, "{}", coded(&rough, 16).len());
    }

    #[test]
    fn latents_beyond_the_range_are_refused() {
        let mut stream = StreamEncoder::new();
        let mut contexts = LatentContexts::new();
        let mut bit = |context: &mut AdaptiveBit, bit: bool| {
            stream.adaptive(context, bit);
            Ok(bit)
        };
        // What `i8` can hold and the format cannot.
        assert!(contexts.image(&mut bit, &mut [-128], 1, false).is_err());
        let bytes = stream.finish();
        assert!(matches!(read(&bytes, 1, 1), Err(DecodeError::Malformed { what: "a latent", .. })));
    }

    proptest! {
        #[test]
        fn latents_come_back(
            edge in 1_usize..9,
            values in prop::collection::vec(-MAX_LATENT..=MAX_LATENT, 0..400),
            small in prop::collection::vec(-2_i32..=2, 0..400),
        ) {
            let mut latents: Vec<i8> = values.iter().chain(&small).map(|value| *value as i8).collect();
            let images = latents.len() / (edge * edge);
            latents.truncate(images * edge * edge);
            prop_assert_eq!(read(&coded(&latents, edge), images, edge), Ok(latents));
        }

        #[test]
        fn any_bytes_are_an_error_or_latents(bytes in prop::collection::vec(any::<u8>(), 0..60), edge in 1_usize..6) {
            if let Ok(latents) = read(&bytes, 3, edge) {
                prop_assert_eq!(latents.len(), 3 * edge * edge);
            }
        }
    }
}
