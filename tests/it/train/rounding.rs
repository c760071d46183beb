//! Training rounds networks as the codec does.

use tcgs::{
    codec::{DecodeLimits, decode, encode},
    domain::DenseLayer,
    train::twin::round_rows,
};

#[allow(dead_code, reason = "has more than this test needs")]
#[path = "../../../crates/tcgs-codec/tests/it/synthetic.rs"]
mod synthetic;

use synthetic::{settings, small};

/// What the encoder may take for the weights' levels.
const LEVELS: [u16; 7] = [7, 31, 127, 255, 511, 1023, 2047];

fn rounded(layer: &DenseLayer, levels: u16) -> [Vec<f32>; 2] {
    let rows = layer.weights.chunks(layer.inputs);
    [rows.flat_map(|row| round_rows(row, levels, false)).collect(), round_rows(&layer.bias, 2047, true)]
}

#[test]
fn decoded_networks_are_what_training_rounds_them_to() {
    let scene = small();
    let encoded = encode(&scene, None, &settings()).expect("encodes");
    let decoded = decode(&encoded.bytes, &DecodeLimits::default()).expect("decodes").scene;
    let networks = |scene: &tcgs::domain::AnchorScene| {
        let networks = scene.networks.clone();
        [networks.opacity, networks.covariance, networks.color]
    };
    for (given, found) in networks(&scene).iter().zip(networks(&decoded)) {
        let holds = |levels: u16| {
            // Zeros compare equal whatever their sign, which a file does not keep.
            given.layers.iter().zip(&found.layers).all(|(given, found)| {
                let [weights, bias] = rounded(given, levels);
                weights == found.weights && bias == found.bias
            })
        };
        assert!(LEVELS.into_iter().any(holds), "no levels give what the codec gives");
    }
}
