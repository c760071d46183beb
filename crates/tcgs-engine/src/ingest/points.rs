//! The point cloud under construction, kept or only counted.

use super::error::{IngestErrorKind, Result};
use crate::domain::PointCloud;

/// Points, kept or only counted.
pub(super) struct Points {
    count: usize,
    limit: usize,
    has_colors: bool,
    cloud: Option<PointCloud>,
}

impl Points {
    /// None yet; at most `limit`.
    pub(super) fn new(keep: bool, limit: usize) -> Self {
        Self { count: 0, limit, has_colors: true, cloud: keep.then(PointCloud::default) }
    }

    /// Makes room for `count` points, which the bytes of a file were found to have room for.
    ///
    /// # Errors
    /// [`IngestErrorKind::TooManyPoints`].
    pub(super) fn reserve(&mut self, count: usize) -> Result<()> {
        if count > self.limit {
            return Err(IngestErrorKind::TooManyPoints { limit: self.limit });
        }
        if let Some(cloud) = &mut self.cloud {
            cloud.positions.reserve_exact(count);
            cloud.colors.reserve_exact(count);
        }
        Ok(())
    }

    /// Adds a point.
    ///
    /// # Errors
    /// [`IngestErrorKind::TooManyPoints`].
    pub(super) fn push(&mut self, position: [f64; 3], color: [u8; 3]) -> Result<()> {
        if self.count == self.limit {
            return Err(IngestErrorKind::TooManyPoints { limit: self.limit });
        }
        self.count += 1;
        if let Some(cloud) = &mut self.cloud {
            cloud.positions.push(position);
            cloud.colors.push(color);
        }
        Ok(())
    }

    /// Whether they are kept.
    pub(super) fn keeps(&self) -> bool {
        self.cloud.is_some()
    }

    /// Gives the last points these colors, in order.
    pub(super) fn recolor(&mut self, colors: impl ExactSizeIterator<Item = [u8; 3]>) {
        if let Some(cloud) = &mut self.cloud {
            let first = cloud.colors.len().saturating_sub(colors.len());
            for (to, color) in cloud.colors[first..].iter_mut().zip(colors) {
                *to = color;
            }
        }
    }

    /// Says that the file has no colors, so that those of the points mean nothing.
    pub(super) fn without_colors(&mut self) {
        self.has_colors = false;
    }

    /// Whether the points have colors of their own.
    pub(super) fn has_colors(&self) -> bool {
        self.has_colors
    }

    /// The points so far, if they are kept.
    pub(super) fn cloud(&self) -> Option<&PointCloud> {
        self.cloud.as_ref()
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// The points, if they were kept.
    pub(super) fn into_cloud(self) -> Option<PointCloud> {
        self.cloud
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_counted_and_kept_only_where_they_are_wanted() {
        for keep in [false, true] {
            let mut points = Points::new(keep, 2);
            assert!(points.reserve(2).is_ok());
            assert!(matches!(points.reserve(3), Err(IngestErrorKind::TooManyPoints { limit: 2 })));
            assert!(points.push([1.0; 3], [1; 3]).is_ok() && points.push([2.0; 3], [2; 3]).is_ok());
            assert!(matches!(
                points.push([3.0; 3], [3; 3]),
                Err(IngestErrorKind::TooManyPoints { limit: 2 })
            ));
            assert_eq!(points.count(), 2);
            assert_eq!(points.into_cloud().map(|cloud| cloud.positions.len()), keep.then_some(2));
        }
    }
}
