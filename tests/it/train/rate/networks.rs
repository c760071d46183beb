//! Networks as a file gives them back: twin and kernel against the codec.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::Mlp,
    model::{ModelShape, NetworkLayout},
    train::{context::RoundedNetworks, twin::round_rows},
};

use crate::support::gpu::gpu;

/// Every network by the twin with these levels.
fn on_twin(mlp: &Mlp, levels: u16) -> Mlp {
    let mut mlp = mlp.clone();
    for layer in &mut mlp.layers {
        let rows = layer.weights.chunks(layer.inputs);
        layer.weights = rows.flat_map(|row| round_rows(row, levels, false)).collect();
        layer.bias = round_rows(&layer.bias, 2047, true);
    }
    mlp
}

fn parameters(layout: &NetworkLayout, seed: u64) -> Vec<f32> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut values = layout.initial(&mut rng);
    // Rows of unlike sizes, and a row of nothing.
    for output in 0..layout.hidden.outputs {
        let size = if output == 5 { 0.0 } else { 10.0_f32.powf(rng.random_range(-3.0..2.0)) };
        for input in 0..layout.hidden.inputs {
            values[layout.hidden.weights + input * layout.hidden.outputs + output] *= size;
        }
    }
    values
}

#[test]
fn the_kernel_rounds_every_bit_as_the_twin_does() {
    let device = gpu();
    for shape in [ModelShape::new(8, 3), ModelShape::new(32, 10)] {
        let layout = NetworkLayout::new(shape);
        for seed in 0..4 {
            let values = parameters(&layout, seed);
            let rounded = RoundedNetworks::plan(&layout).make(&device).expect("the kernel");
            device.write(rounded.parameters(), &vec![1234.5; values.len()]);
            let uploaded = device.upload("networks", &values).expect("room");
            let mut recorder = device.recorder("round");
            rounded.record(&mut recorder, &uploaded).expect("recorded");
            recorder.submit().expect("submitted");
            let found = layout.to_networks(&device.read(rounded.parameters()).expect("read"));
            let given = layout.to_networks(&values);
            let pairs = [
                (&found.opacity, &given.opacity),
                (&found.covariance, &given.covariance),
                (&found.color, &given.color),
            ];
            for (found, given) in pairs {
                let expected = on_twin(given, 127);
                for (found, expected) in found.layers.iter().zip(&expected.layers) {
                    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                    // A zero's sign is lost in a file.
                    let plain = |values: &[f32]| bits(&values.iter().map(|v| v + 0.0).collect::<Vec<_>>());
                    assert!(plain(&found.weights) == plain(&expected.weights));
                    assert!(plain(&found.bias) == plain(&expected.bias));
                }
            }
        }
    }
}
