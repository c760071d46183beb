//! The statistics for growth and pruning, accumulated over views (METHOD.md §2.6).

use crate::model::ModelShape;

/// Statistics of all anchors, `[N][2 K + 2]`: K sums of screen-gradient norms, K counts of views, a sum of positive
/// opacities, visits.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Widths of the model.
    pub shape: ModelShape,
    /// The rows.
    pub values: Vec<f32>,
}

impl Statistics {
    /// Values per anchor.
    #[must_use]
    pub fn width(shape: ModelShape) -> usize {
        2 * shape.offsets + 2
    }

    /// Bytes for `anchors` anchors.
    #[must_use]
    pub fn bytes(shape: ModelShape, anchors: usize) -> u64 {
        (anchors * Self::width(shape) * size_of::<f32>()) as u64
    }

    /// Zero statistics of `anchors` anchors.
    #[must_use]
    pub fn zero(shape: ModelShape, anchors: usize) -> Self {
        Self { shape, values: vec![0.0; anchors * Self::width(shape)] }
    }

    /// One anchor's row.
    #[must_use]
    pub fn row(&self, anchor: usize) -> &[f32] {
        let width = Self::width(self.shape);
        &self.values[anchor * width..(anchor + 1) * width]
    }

    /// One anchor's row, to change.
    pub fn row_mut(&mut self, anchor: usize) -> &mut [f32] {
        let width = Self::width(self.shape);
        &mut self.values[anchor * width..(anchor + 1) * width]
    }

    /// Mean gradient norm of an offset over the views that showed it.
    #[must_use]
    pub fn mean_gradient(&self, anchor: usize, offset: usize) -> f32 {
        let row = self.row(anchor);
        let views = row[self.shape.offsets + offset];
        if views > 0.0 { row[offset] / views } else { 0.0 }
    }

    /// Views that showed an offset.
    #[must_use]
    pub fn views(&self, anchor: usize, offset: usize) -> f32 {
        self.row(anchor)[self.shape.offsets + offset]
    }

    /// Sum of positive opacities, and visits.
    #[must_use]
    pub fn opacity_and_visits(&self, anchor: usize) -> (f32, f32) {
        let row = self.row(anchor);
        (row[2 * self.shape.offsets], row[2 * self.shape.offsets + 1])
    }
}
