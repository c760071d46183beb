//! Latents as they are stored.

/// Latents as the nearest multiples of 1/16 with integers of at most 127.
#[must_use]
pub fn round_latents(values: &[f64]) -> Vec<f64> {
    values.iter().map(|value| (16.0 * value).round_ties_even().clamp(-127.0, 127.0) / 16.0).collect()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        codec::context::stored_planes,
        domain::context_model::{Planes, UpLayer},
        train::twin::context::round_weights,
    };

    #[test]
    fn planes_are_rounded_as_the_codec_stores_them() {
        let mut rng = Pcg64::seed_from_u64(2);
        let mut numbers = |count: usize, size: f32| -> Vec<f32> {
            (0..count).map(|_| rng.random_range(-size..size)).collect()
        };
        let planes = Planes {
            edge: 4,
            channels: 2,
            latents: numbers(3 * 2 * 16, 12.0),
            layers: vec![UpLayer { inputs: 2, outputs: 4, weights: numbers(72, 0.7), bias: vec![0.0; 4] }],
        };
        let stored = stored_planes(&planes);
        let wide = |values: &[f32]| values.iter().map(|value| f64::from(*value)).collect::<Vec<_>>();
        assert_eq!(round_latents(&wide(&planes.latents)), wide(&stored.latents));
        for output in 0..4 {
            let row = |weights: &[f32]| {
                wide(&[&weights[9 * output..][..9], &weights[36 + 9 * output..][..9]].concat())
            };
            let (found, expected) = (row(&planes.layers[0].weights), row(&stored.layers[0].weights));
            assert_eq!(round_weights(&found, 127), expected);
        }
    }
}
