//! The decode hash, which is equal on two machines if they decoded the same scene.
//!
//! It is a hash of hashes of runs of anchors, so that the runs can be hashed in parallel.

use rayon::prelude::*;
use sha2::{Digest as _, Sha256};

use crate::domain::{AnchorScene, Digest, Mlp, anchors::SCALINGS_PER_ANCHOR};

/// Anchors in a run, but for the last. Part of the hash's definition, whatever the chunks of a file.
const RUN: usize = 4096;

/// Bytes gathered before they are hashed.
const BLOCK: usize = 1 << 12;

/// SHA-256 over, little-endian, f32 by their bits:
///
/// 1. N, F, K as u64; voxel and the origin's x, y, z as f32;
/// 2. for each run of 4096 anchors in order, the last of what is left, the SHA-256 of the run's cells as i32
///    `[n][3]`; features, scalings, offsets as f32 `[n][F]`, `[n][6]`, `[n][K][3]`; masks as one byte each, `[n][K]`;
/// 3. opacity, covariance and color network, each: number of layers as u64, then a layer's inputs and outputs
///    as u64, its weights as f32 `[outputs][inputs]`, its bias as f32 `[outputs]`.
#[must_use]
pub fn decode_digest(scene: &AnchorScene) -> Digest {
    let _stage = tracing::debug_span!("digest").entered();
    let mut hash = Hash(Sha256::new());
    [scene.len(), scene.feature_dim, scene.offsets_per_anchor].iter().for_each(|count| hash.count(*count));
    hash.floats(&[scene.lattice.voxel]);
    hash.floats(&scene.lattice.origin);
    let runs: Vec<[u8; 32]> =
        (0..scene.len().div_ceil(RUN)).into_par_iter().map(|run| run_digest(scene, run)).collect();
    runs.iter().for_each(|run| hash.0.update(run));
    hash.network(&scene.networks.opacity);
    hash.network(&scene.networks.covariance);
    hash.network(&scene.networks.color);
    Digest::from_bytes(hash.0.finalize().into())
}

fn run_digest(scene: &AnchorScene, run: usize) -> [u8; 32] {
    fn part<T>(values: &[T], run: usize, width: usize) -> &[T] {
        let end = values.len();
        &values[(run * RUN * width).min(end)..((run + 1) * RUN * width).min(end)]
    }
    let k = scene.offsets_per_anchor;
    let mut hash = Hash(Sha256::new());
    hash.values(part(&scene.cells, run, 1).as_flattened(), i32::to_le_bytes);
    hash.floats(part(&scene.features, run, scene.feature_dim));
    hash.floats(part(&scene.scalings, run, SCALINGS_PER_ANCHOR));
    hash.floats(part(&scene.offsets, run, 3 * k));
    hash.values(part(&scene.masks, run, k), |kept| [u8::from(kept)]);
    hash.0.finalize().into()
}

struct Hash(Sha256);

impl Hash {
    fn count(&mut self, count: usize) {
        self.0.update((count as u64).to_le_bytes());
    }

    fn floats(&mut self, values: &[f32]) {
        self.values(values, f32::to_le_bytes);
    }

    fn values<T: Copy, const N: usize>(&mut self, values: &[T], bytes: impl Fn(T) -> [u8; N]) {
        let mut block = [0; BLOCK];
        for values in values.chunks(BLOCK / N) {
            let block = &mut block[..values.len() * N];
            for (place, value) in block.chunks_exact_mut(N).zip(values) {
                place.copy_from_slice(&bytes(*value));
            }
            self.0.update(block);
        }
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
