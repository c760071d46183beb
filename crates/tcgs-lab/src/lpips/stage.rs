//! One stage of the network on both images at once: convolutions, the comparison of their features, pooling.
//!
//! A stage runs in strips of rows on all threads. A strip computes again the few rows around it that its windows look at,
//! so that no strip waits for another and no full-size map is ever kept.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    layout::Window,
    rows::{Convolution, Rows, chunks, pool},
};

/// Pooled rows in a strip. Part of the result's definition only through which rows one matrix product covers.
const STRIP: usize = 8;

/// Keeps features of length zero from being divided by zero.
const EPSILON: f64 = 1e-10;

/// The way from one compared layer to the next, with weights.
#[derive(Debug)]
pub(super) struct LpipsStage {
    pub(super) convolutions: Vec<Convolution>,
    /// Weight of each channel's squared difference.
    pub(super) head: Vec<f32>,
    pub(super) pool: Window,
}

/// What one strip of both maps gives.
struct Strip {
    /// The distance summed over positions.
    distance: f64,
    /// Its rows of the pooled maps.
    pooled: [Vec<f32>; 2],
}

impl LpipsStage {
    /// The mean distance over the positions of this stage's layer, and both maps for the next stage.
    pub(super) fn compare(&self, inputs: &[Rows; 2]) -> (f64, [Rows; 2]) {
        let [height, width] = [inputs[0].height, inputs[0].width].map(|side| {
            self.convolutions.iter().fold(side, |side, convolution| convolution.window.outputs(side))
        });
        let pooled_height = self.pool.outputs(height);
        let strips: Vec<Range<usize>> = chunks(&(0..pooled_height), STRIP).collect();
        let strips: Vec<Strip> =
            strips.into_par_iter().map(|range| self.strip(inputs, range, pooled_height, height)).collect();

        let distance = strips.iter().map(|strip| strip.distance).sum::<f64>() / (width * height) as f64;
        let mut pooled = [Vec::new(), Vec::new()];
        for strip in strips {
            for (whole, part) in pooled.iter_mut().zip(strip.pooled) {
                whole.extend(part);
            }
        }
        let pooled = pooled
            .map(|values| Rows::whole(self.pool.outputs(width), pooled_height, self.head.len(), values));
        (distance, pooled)
    }

    /// The strip with the pooled rows `pooled`, of `pooled_height`; the compared layer has `height` rows.
    fn strip(&self, inputs: &[Rows; 2], pooled: Range<usize>, pooled_height: usize, height: usize) -> Strip {
        // Windows of the pooling may overlap, but each row of the layer is compared once.
        let last = if pooled.end == pooled_height { height } else { pooled.end * self.pool.stride };
        let compared = pooled.start * self.pool.stride..last;
        let needed = compared.start..last.max(self.pool.sources(&pooled, height).end);
        let [a, b] = inputs.each_ref().map(|input| self.features(input, needed.clone()));
        let distance = compared.map(|y| self.row_distance(a.row(y), b.row(y))).sum();
        Strip { distance, pooled: [a, b].map(|map| pool(self.pool, &map, pooled.clone()).values) }
    }

    /// The rows `range` of this stage's layer.
    fn features(&self, input: &Rows, range: Range<usize>) -> Rows {
        let mut heights = vec![input.height];
        for (index, convolution) in self.convolutions.iter().enumerate() {
            heights.push(convolution.window.outputs(heights[index]));
        }
        // From the last convolution back: the rows that each has to give.
        let mut wanted = vec![range];
        for (index, convolution) in self.convolutions.iter().enumerate().skip(1).rev() {
            let next = wanted.last().expect("begins with one");
            wanted.push(convolution.window.sources(next, heights[index]));
        }
        let mut rows: Option<Rows> = None;
        for (convolution, range) in self.convolutions.iter().zip(wanted.into_iter().rev()) {
            rows = Some(convolution.rows(rows.as_ref().unwrap_or(input), range));
        }
        rows.expect("a stage has a convolution")
    }

    /// The distance summed over the positions of one row.
    fn row_distance(&self, a: &[f32], b: &[f32]) -> f64 {
        let channels = self.head.len();
        a.chunks_exact(channels)
            .zip(b.chunks_exact(channels))
            .map(|(a, b)| self.position_distance(a, b))
            .sum()
    }

    fn position_distance(&self, a: &[f32], b: &[f32]) -> f64 {
        let inverse_length = |features: &[f32]| {
            let squares: f64 = features.iter().map(|value| f64::from(*value) * f64::from(*value)).sum();
            1.0 / (squares.sqrt() + EPSILON)
        };
        let (a_inverse, b_inverse) = (inverse_length(a), inverse_length(b));
        self.head
            .iter()
            .zip(a.iter().zip(b))
            .map(|(weight, (a, b))| {
                let difference = f64::from(*a) * a_inverse - f64::from(*b) * b_inverse;
                f64::from(*weight) * difference * difference
            })
            .sum()
    }
}
