//! Hardware and software adapters compute the same.

use super::{
    dense, dense_software, dense_weight_gradient, dense_weight_gradient_software, pack_weights,
    sum_weight_gradient,
};
use crate::model::{ModelShape, NetworkLayout};

#[test]
fn both_sets_of_kernels_compute_the_same() {
    let layout = NetworkLayout::new(ModelShape::new(5, 3));
    let number = |i: usize| ((i * 7919 % 1000) as f64) / 500.0 - 1.0;
    let parameters: Vec<f64> = (0..layout.parameters).map(number).collect();
    let columns = |first: usize, rows: usize| -> Vec<Vec<f64>> {
        (0..4).map(|c| (0..rows).map(|i| number(first + rows * c + i)).collect()).collect()
    };
    let (inputs, d_outputs) = (columns(100, 15), columns(500, 33));
    for layer in layout.layers() {
        let packed = pack_weights(&layer, &parameters);
        assert!(packed.iter().all(|row| row.len() % 4 == 0));
        for input in &inputs {
            let found = dense_software(&layer, &packed, &parameters, input);
            assert_eq!(found, dense(&layer, &parameters, input));
        }
        let mut expected = vec![0.0; layout.parameters];
        dense_weight_gradient(&layer, &inputs, &d_outputs, &mut expected);
        let mut partial = vec![vec![0.0; layer.outputs]; layer.inputs + 1];
        dense_weight_gradient_software(&layer, &inputs, &d_outputs, &mut partial);
        let mut found = vec![0.0; layout.parameters];
        sum_weight_gradient(&layer, &[partial], &mut found);
        assert_eq!(found, expected);
    }
}
