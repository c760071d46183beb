//! The decode hash: one number that says whether two machines decoded the same scene.

use sha2::{Digest as _, Sha256};

use crate::domain::{AnchorScene, Digest, Mlp};

/// SHA-256 over all decoded attributes, little-endian, f32 by their bits, in this order:
///
/// 1. N, F, K as u64; voxel and the origin's x, y, z as f32;
/// 2. cells as i32 `[N][3]`; features, scalings, offsets as f32 `[N][F]`, `[N][6]`, `[N][K][3]`; masks as one
///    byte each, `[N][K]`;
/// 3. opacity, covariance and colour network, each: number of layers as u64, then a layer's inputs and outputs
///    as u64, its weights as f32 `[outputs][inputs]`, its bias as f32 `[outputs]`.
#[must_use]
pub fn decode_digest(scene: &AnchorScene) -> Digest {
    let mut hash = Hash(Sha256::new());
    [scene.len(), scene.feature_dim, scene.offsets_per_anchor].iter().for_each(|count| hash.count(*count));
    hash.floats(&[scene.lattice.voxel]);
    hash.floats(&scene.lattice.origin);
    hash.bytes(scene.cells.as_flattened().iter().map(|coordinate| coordinate.to_le_bytes()));
    hash.floats(&scene.features);
    hash.floats(&scene.scalings);
    hash.floats(&scene.offsets);
    hash.bytes(scene.masks.iter().map(|kept| [u8::from(*kept)]));
    hash.network(&scene.networks.opacity);
    hash.network(&scene.networks.covariance);
    hash.network(&scene.networks.color);
    Digest::from_bytes(hash.0.finalize().into())
}

struct Hash(Sha256);

impl Hash {
    fn count(&mut self, count: usize) {
        self.0.update((count as u64).to_le_bytes());
    }

    fn floats(&mut self, values: &[f32]) {
        self.bytes(values.iter().map(|value| value.to_le_bytes()));
    }

    fn bytes<const N: usize>(&mut self, values: impl Iterator<Item = [u8; N]>) {
        let mut block = Vec::with_capacity(BLOCK + N);
        for value in values {
            block.extend(value);
            if block.len() >= BLOCK {
                self.0.update(&block);
                block.clear();
            }
        }
        self.0.update(&block);
    }

    fn network(&mut self, mlp: &Mlp) {
        self.count(mlp.layers.len());
        for layer in &mlp.layers {
            self.count(layer.inputs);
            self.count(layer.outputs);
            self.floats(&layer.weights);
            self.floats(&layer.bias);
        }
    }
}

/// Bytes gathered before they are hashed.
const BLOCK: usize = 1 << 14;
