//! The inputs of the context networks for each anchor: samples of the planes at the anchor and at its neighbors, and its position.

use rayon::prelude::*;

use super::{
    coordinates, neighbors, position_inputs, texels,
    texels::{PLANES, PlaneTexels},
};
use crate::domain::{
    ContextFrame,
    context_model::{ContextKind, NEIGHBORS},
};

/// Anchors that are worth a task of their own.
const TASK: usize = 1024;

/// Inputs of a file's networks for its anchors; empty if there are only tables.
#[derive(Debug, Default)]
pub(crate) struct AnchorContext {
    coordinates: Vec<[i32; 3]>,
    /// Values a sample, none without planes.
    width: usize,
    /// `[N][width]`.
    samples: Vec<i16>,
    /// Empty if no network uses neighbors.
    neighbors: Vec<[u32; NEIGHBORS]>,
}

impl AnchorContext {
    /// The anchors' places in `frame`, without planes.
    pub(crate) fn new(frame: &ContextFrame, cells: &[[i32; 3]]) -> Self {
        let coordinates = coordinates(frame, cells);
        Self { coordinates, ..Self::default() }
    }

    /// Finds each anchor's neighbors.
    pub(crate) fn find_neighbors(&mut self, cells: &[[i32; 3]]) {
        let _stage = tracing::debug_span!("neighbors").entered();
        self.neighbors = neighbors(cells);
    }

    /// Sets the result of [`Self::find_neighbors`].
    pub(crate) fn set_neighbors(&mut self, neighbors: Vec<[u32; NEIGHBORS]>) {
        self.neighbors = neighbors;
    }

    /// Moves the neighbors out.
    pub(crate) fn take_neighbors(&mut self) -> Vec<[u32; NEIGHBORS]> {
        std::mem::take(&mut self.neighbors)
    }

    /// Whether they were found.
    pub(crate) fn has_neighbors(&self) -> bool {
        !self.neighbors.is_empty()
    }

    /// Samples the planes at each anchor.
    pub(crate) fn sample(&mut self, planes: &PlaneTexels) {
        let _stage = tracing::debug_span!("planes").entered();
        self.width = planes.sample_width();
        self.samples = vec![0; self.width * self.coordinates.len()];
        self.samples.par_chunks_mut(self.width).zip(&self.coordinates).with_min_len(TASK).for_each(
            |(sample, coordinate)| {
                planes.sample(&texels(*coordinate, planes.edge()), sample);
            },
        );
    }

    /// Bytes of memory for an anchor, with planes of `channels` channels each, with or without neighbors.
    pub(crate) fn bytes_per_anchor(channels: usize, neighbors: bool) -> u64 {
        // Coordinates; samples; neighbors by rank and by index, and the sort keys and boxes of their search.
        12 + 2 * (PLANES * channels) as u64 + if neighbors { 2 * 16 + 24 + 4 + 8 } else { 0 }
    }

    /// Writes the inputs of a network of `kind` for an anchor to `inputs`.
    pub(crate) fn inputs(&self, kind: ContextKind, anchor: usize, inputs: &mut Vec<i16>) {
        inputs.clear();
        let sample = |anchor: usize| &self.samples[anchor * self.width..(anchor + 1) * self.width];
        match kind {
            ContextKind::Position => {}
            ContextKind::TriPlane => inputs.extend_from_slice(sample(anchor)),
            ContextKind::TriPlaneKnn => {
                self.neighbors[anchor]
                    .iter()
                    .for_each(|near| inputs.extend_from_slice(sample(*near as usize)));
            }
        }
        inputs.extend(position_inputs(self.coordinates[anchor]));
    }
}
