//! Cases of prefix sums, sorting, lists of visible anchors and dense layers, by the kernels of the device's variant. Truth is integer
//! arithmetic on the CPU, or a product in f64.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::relative_l2,
};
use tcgs_render::{
    Activation, Columns, DenseLayers, InputGradient, WeightGradient,
    gpu::{
        Device, Pairs, RadixSort, Scan, ScanSlots,
        twin::{radix_sort, scan},
    },
    list_visible,
    model::LayerSpec,
    twin::neural::{compact_anchors, dense, dense_input_gradient, dense_weight_gradient, relu, relu_gate},
};

const SUMS: &str = "prefix sums and their total, how many differ";
const PAIRS: &str = "pairs, how many are out of place";
const ANCHORS: &str = "anchors of the lists, how many differ";
const OUTPUTS: &str = "outputs, relative L2";
const BY_INPUTS: &str = "gradient by inputs, relative L2";
const BY_WEIGHTS: &str = "gradient by weights and biases, relative L2";

const DENSE: &[Bound] = &[
    Bound { quantity: OUTPUTS, largest: 2e-6, why: "a chain of 70 products with a rounding of 6e-8 each" },
    Bound { quantity: BY_INPUTS, largest: 2e-6, why: "a chain of 37 products with a rounding of 6e-8 each" },
    Bound {
        quantity: BY_WEIGHTS,
        largest: 2e-6,
        why: "runs of at most 1024 columns, whose roundings of 6e-8 mostly cancel, and sums of those",
    },
];

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "scan-of-a-million-values",
        bounds: &[Bound { quantity: SUMS, largest: 0.0, why: "sums of integers, which saturate alike" }],
        measure: scanned,
    },
    Case {
        name: "sort-of-a-million-pairs",
        bounds: &[Bound { quantity: PAIRS, largest: 0.0, why: "a stable sort has one result" }],
        measure: sorted,
    },
    Case {
        name: "lists-of-visible-anchors",
        bounds: &[Bound { quantity: ANCHORS, largest: 0.0, why: "indices in ascending order" }],
        measure: listed,
    },
    Case { name: "dense-layers", bounds: DENSE, measure: layers },
    Case { name: "dense-layers-without-subgroups", bounds: DENSE, measure: layers_without_subgroups },
];

/// How many elements differ; all of them if the lengths do.
fn differing<T: PartialEq>(found: &[T], truth: &[T]) -> f64 {
    if found.len() != truth.len() {
        return found.len().max(truth.len()) as f64;
    }
    found.iter().zip(truth).filter(|(a, b)| a != b).count() as f64
}

/// Small values, and values that exceed 32 bits together.
fn scanned(device: &Arc<Device>) -> Result<Errors, CaseError> {
    const COUNT: usize = 1_000_003;
    let mut rng = Pcg64::seed_from_u64(71);
    let plan = Scan::plan(device.adapter(), COUNT, ScanSlots { count: 0, total: 0 }).make(device)?;
    let counts = device.upload("counts", &[COUNT as u32])?;
    let mut errors = 0.0;
    for largest in [50, u32::MAX / 1000] {
        let values: Vec<u32> = (0..COUNT).map(|_| rng.random_range(0..largest)).collect();
        let input = device.upload("values", &values)?;
        let (sums, total) = (device.buffer("prefix sums", COUNT)?, device.buffer("total", 1)?);
        let mut recorder = device.recorder("scan");
        plan.record(&mut recorder, &counts, &input, &sums, &total);
        recorder.submit()?;
        let (truth, truth_total) = scan(&values);
        errors += differing(&device.read(&sums)?, &truth) + differing(&device.read(&total)?, &[truth_total]);
    }
    Ok(vec![(SUMS, errors)])
}

/// Keys of which many are equal, and keys of all bits, by 32, 13 and 1 bits.
fn sorted(device: &Arc<Device>) -> Result<Errors, CaseError> {
    const COUNT: usize = 1_000_003;
    let mut rng = Pcg64::seed_from_u64(72);
    let counts = device.upload("counts", &[COUNT as u32])?;
    let mut errors = 0.0;
    for (bits, key_bits) in [(32, 32), (32, 9), (13, 32), (1, 32)] {
        let pairs: Vec<(u32, u32)> =
            (0..COUNT as u32).map(|i| (rng.random::<u32>() >> (32 - key_bits), i)).collect();
        let (keys, values): (Vec<u32>, Vec<u32>) = pairs.iter().copied().unzip();
        let sort = RadixSort::plan(device.adapter(), COUNT, bits, 0).make(device)?;
        let from = Pairs { keys: device.upload("keys", &keys)?, values: device.upload("values", &values)? };
        let spare = Pairs::plan(COUNT).make(device)?;
        let mut recorder = device.recorder("sort");
        let result = sort.record(&mut recorder, &counts, &from, &spare);
        recorder.submit()?;
        let found: Vec<(u32, u32)> =
            device.read(&result.keys)?.into_iter().zip(device.read(&result.values)?).collect();
        errors += differing(&found, &radix_sort(&pairs, bits));
    }
    Ok(vec![(PAIRS, errors)])
}

/// None, few, half and all of 300 001 anchors.
fn listed(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let mut rng = Pcg64::seed_from_u64(73);
    let mut errors = 0.0;
    for share in [0.0, 0.01, 0.5, 1.0] {
        let visible: Vec<bool> = (0..300_001).map(|_| rng.random::<f64>() < share).collect();
        errors += differing(&list_visible(device, &visible)?, &compact_anchors(&visible));
    }
    Ok(vec![(ANCHORS, errors)])
}

fn layers(device: &Arc<Device>) -> Result<Errors, CaseError> {
    measure_layer(device, device.subgroups().lanes())
}

fn layers_without_subgroups(device: &Arc<Device>) -> Result<Errors, CaseError> {
    measure_layer(device, None)
}

/// A layer of sizes that are no multiples of a tile, at more columns than a run.
const LAYER: LayerSpec =
    LayerSpec { inputs: 70, outputs: 37, weights: 0, bias: 70 * 37, input_row: 0, output_row: 0 };
const PARAMETERS: usize = 71 * 37;
const COLUMNS: usize = 3001;

/// Columns of random values from -1 to 1, in f32.
fn random_columns(rng: &mut Pcg64, rows: usize) -> Vec<Vec<f64>> {
    let mut column = || (0..rows).map(|_| f64::from(rng.random_range(-1.0..1.0_f32))).collect();
    (0..COLUMNS).map(|_| column()).collect()
}

/// Rows of `capacity` values, as the device has them.
fn by_rows(columns: &[Vec<f64>], capacity: usize) -> Vec<f32> {
    let mut values = vec![0.0; columns[0].len() * capacity];
    for (column, of) in columns.iter().enumerate() {
        for (row, value) in of.iter().enumerate() {
            values[row * capacity + column] = *value as f32;
        }
    }
    values
}

/// The columns of rows, one after the other.
fn by_columns(rows: &[f32], capacity: usize) -> Vec<f64> {
    let column = |column: usize| rows.iter().skip(column).step_by(capacity).map(|value| f64::from(*value));
    (0..COLUMNS).flat_map(column).collect()
}

/// The layer with a ReLU, and its gradients: by inputs that passed a ReLU themselves, and by weights.
fn measure_layer(device: &Arc<Device>, subgroups: Option<u32>) -> Result<Errors, CaseError> {
    let mut rng = Pcg64::seed_from_u64(74);
    let parameters: Vec<f32> = (0..PARAMETERS).map(|_| rng.random_range(-1.0..1.0)).collect();
    let inputs: Vec<Vec<f64>> = random_columns(&mut rng, LAYER.inputs).into_iter().map(relu).collect();
    let d_outputs = random_columns(&mut rng, LAYER.outputs);

    let capacity = Columns::capacity_for(COLUMNS);
    let dense_layers = DenseLayers::new(device, subgroups, [LAYER])?;
    let list = device.upload("columns", &[COLUMNS as u32])?;
    let columns = Columns { list: &list, capacity };
    let uploaded = device.upload("parameters", &parameters)?;
    let input = device.upload("inputs", &by_rows(&inputs, capacity))?;
    let d_output = device.upload("gradients by outputs", &by_rows(&d_outputs, capacity))?;
    let output = device.buffer("outputs", LAYER.outputs * capacity)?;
    let d_input = device.buffer("gradients by inputs", LAYER.inputs * capacity)?;
    let partials = DenseLayers::partials("partial sums", capacity, [LAYER], PARAMETERS).make(device)?;
    let sums = device.buffer("gradients by parameters", PARAMETERS)?;

    let mut recorder = device.recorder("a dense layer");
    let layer = columns.layer(&LAYER);
    let by_input = InputGradient { rows: LAYER.inputs, relu: Some(&input), buffer: &d_input };
    let by_weight = WeightGradient { parameters: PARAMETERS, partials: &partials, sums: &sums };
    dense_layers.load(&mut recorder, &uploaded);
    dense_layers.forward(&mut recorder, layer, &uploaded, &input, &output, Activation::Relu)?;
    dense_layers.input_gradient(&mut recorder, layer, &uploaded, &d_output, by_input)?;
    dense_layers.weight_gradient(&mut recorder, layer, &input, &d_output, by_weight)?;
    dense_layers.finish_weight_gradients(&mut recorder, columns, by_weight)?;
    recorder.submit()?;

    let parameters: Vec<f64> = parameters.into_iter().map(f64::from).collect();
    let outputs: Vec<f64> =
        inputs.iter().flat_map(|column| relu(dense(&LAYER, &parameters, column))).collect();
    let by_inputs: Vec<f64> = inputs
        .iter()
        .zip(&d_outputs)
        .flat_map(|(column, d_output)| {
            let mut gradient = vec![0.0; LAYER.inputs];
            dense_input_gradient(&LAYER, &parameters, d_output, &mut gradient);
            relu_gate(column, gradient)
        })
        .collect();
    let mut by_weights = vec![0.0; PARAMETERS];
    dense_weight_gradient(&LAYER, &inputs, &d_outputs, &mut by_weights);
    let found_by_weights: Vec<f64> = device.read(&sums)?.into_iter().map(f64::from).collect();
    Ok(vec![
        (OUTPUTS, relative_l2(&by_columns(&device.read(&output)?, capacity), &outputs)),
        (BY_INPUTS, relative_l2(&by_columns(&device.read(&d_input)?, capacity), &by_inputs)),
        (BY_WEIGHTS, relative_l2(&found_by_weights, &by_weights)),
    ])
}
