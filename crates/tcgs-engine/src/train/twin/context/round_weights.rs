//! Weights of a network as they are stored.

/// Most binary places of a weight in a file.
const MAX_FRACTION_BITS: i32 = 15;

/// One output's weights as integers of at most `levels` over the largest power of two up to 2^15 that they allow.
#[must_use]
pub fn round_weights(row: &[f64], levels: u8) -> Vec<f64> {
    let levels = f64::from(levels);
    let largest = row.iter().fold(0.0, |largest: f64, weight| largest.max(weight.abs()));
    let places = (1..=MAX_FRACTION_BITS)
        .rev()
        .find(|places| (largest * 2_f64.powi(*places)).round_ties_even() <= levels);
    let scale = 2_f64.powi(places.unwrap_or(0));
    row.iter().map(|weight| (weight * scale).round_ties_even().clamp(-levels, levels) / scale).collect()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::{
        codec::context::stored_network,
        domain::{DenseLayer, Mlp},
    };

    #[test]
    fn a_networks_weights_are_rounded_as_the_codec_stores_them() {
        let mut rng = Pcg64::seed_from_u64(1);
        for (bits, levels) in [(8, 127), (6, 31), (4, 7)] {
            let (inputs, outputs) = (19, 60);
            // From less than the finest step to more than the coarsest holds; every other row has ties.
            let weights = (0..outputs).flat_map(|output| {
                let size = 2_f32.powi(output - 36);
                let tie = |rng: &mut Pcg64| rng.random_range(-255..256) as f32 / 256.0;
                (0..inputs)
                    .map(|_| size * if output % 2 == 0 { tie(&mut rng) } else { rng.random_range(-1.0..1.0) })
                    .collect::<Vec<f32>>()
            });
            let layer = DenseLayer {
                inputs,
                outputs: outputs as usize,
                weights: weights.collect(),
                bias: vec![0.0; outputs as usize],
            };
            let stored = stored_network(&Mlp { layers: vec![layer.clone()] }, bits);
            for (row, expected) in
                layer.weights.chunks_exact(inputs).zip(stored.layers[0].weights.chunks_exact(inputs))
            {
                let row: Vec<f64> = row.iter().map(|weight| f64::from(*weight)).collect();
                let expected: Vec<f64> = expected.iter().map(|weight| f64::from(*weight)).collect();
                assert_eq!(round_weights(&row, levels), expected, "{bits} bits");
            }
        }
    }
}
