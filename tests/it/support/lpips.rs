//! Random weights of LPIPS, the same as those of `tests/oracles/lpips_oracle.py`.

use safetensors::{Dtype, tensor::TensorView};

/// The number after the `index` first ones of SplitMix64.
pub fn splitmix(seed: u64, index: u64) -> u64 {
    let mut z = seed.wrapping_add((index + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A tensor of a file of weights.
#[derive(Debug, Clone)]
pub struct Tensor {
    pub name: String,
    pub shape: Vec<usize>,
    pub dtype: Dtype,
    pub bytes: Vec<u8>,
}

impl Tensor {
    pub fn new(name: &str, shape: &[usize], values: impl IntoIterator<Item = f32>) -> Self {
        let bytes = values.into_iter().flat_map(f32::to_le_bytes).collect();
        Self { name: name.to_owned(), shape: shape.to_vec(), dtype: Dtype::F32, bytes }
    }

    pub fn random(name: &str, shape: &[usize], seed: u64, low: f64, high: f64) -> Self {
        let values = (0..shape.iter().product::<usize>() as u64).map(|index| {
            let unit = (splitmix(seed, index) >> 40) as f64 / f64::from(1 << 24);
            (low + (high - low) * unit) as f32
        });
        Self::new(name, shape, values)
    }
}

/// Slice, index, inputs, outputs and kernel size of each convolution, as the `lpips` package names them.
const ALEX: &[(usize, usize, usize, usize, usize)] =
    &[(1, 0, 3, 64, 11), (2, 3, 64, 192, 5), (3, 6, 192, 384, 3), (4, 8, 384, 256, 3), (5, 10, 256, 256, 3)];
const VGG: &[(usize, usize, usize, usize, usize)] = &[
    (1, 0, 3, 64, 3),
    (1, 2, 64, 64, 3),
    (2, 5, 64, 128, 3),
    (2, 7, 128, 128, 3),
    (3, 10, 128, 256, 3),
    (3, 12, 256, 256, 3),
    (3, 14, 256, 256, 3),
    (4, 17, 256, 512, 3),
    (4, 19, 512, 512, 3),
    (4, 21, 512, 512, 3),
    (5, 24, 512, 512, 3),
    (5, 26, 512, 512, 3),
    (5, 28, 512, 512, 3),
];

/// The oracle's weights, named as in the `lpips` package's state.
pub fn weights(net: &str) -> Vec<Tensor> {
    let (number, convolutions) = if net == "alex" { (1, ALEX) } else { (2, VGG) };
    let mut tensors = Vec::new();
    for (slice, index, inputs, outputs, size) in convolutions.iter().copied() {
        let name = format!("net.slice{slice}.{index}");
        let seed = 1000 * number + tensors.len() as u64;
        let bound = (6.0 / (inputs * size * size) as f64).sqrt();
        let shape = [outputs, inputs, size, size];
        tensors.push(Tensor::random(&format!("{name}.weight"), &shape, seed, -bound, bound));
        tensors.push(Tensor::random(&format!("{name}.bias"), &[outputs], seed + 1, -0.1, 0.1));
    }
    for slice in 1..=5 {
        let last = convolutions.iter().rfind(|convolution| convolution.0 == slice).expect("a convolution");
        let seed = 1000 * number + tensors.len() as u64;
        let name = format!("lin{}.model.1.weight", slice - 1);
        tensors.push(Tensor::random(&name, &[1, last.3, 1, 1], seed, 0.0, 1.0));
    }
    tensors
}

/// The names that torchvision gives the convolutions.
pub fn as_torchvision_does(tensors: &mut [Tensor]) {
    for tensor in tensors {
        if let Some((_, rest)) = tensor.name.strip_prefix("net.slice").and_then(|rest| rest.split_once('.')) {
            tensor.name = format!("features.{rest}");
        }
    }
}

pub fn file(tensors: &[Tensor]) -> Vec<u8> {
    let views = tensors.iter().map(|tensor| {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes).expect("a tensor");
        (tensor.name.as_str(), view)
    });
    safetensors::serialize(views, None).expect("serialized")
}
