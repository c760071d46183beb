//! The sizes of a dataset that decide how much memory a run takes, of a loaded dataset or of one that was only checked.

use crate::{
    domain::{Dataset, DatasetSummary, Intrinsics, NamedCamera, Split},
    gpu::buffer_bytes,
};

/// Bytes a pixel of a photograph in memory.
const PHOTOGRAPH_BYTES: u64 = 3;

/// What of a dataset decides how much memory a run takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SetSizes {
    /// Size of the image with the most pixels.
    pub largest: [u32; 2],
    /// Whether there are images of other sizes.
    pub mixed: bool,
    /// Bytes of the photographs and masks in memory.
    pub photographs: u64,
    /// Photographs to train on.
    pub training: usize,
    /// Whether there are masks.
    pub masked: bool,
    /// Bytes of the training photographs that may be kept packed: those in memory.
    pub packed: u64,
    /// Points of the cloud; 0 without one.
    pub points: usize,
}

impl SetSizes {
    /// Of a loaded dataset.
    #[must_use]
    pub fn of(dataset: &Dataset) -> Self {
        let sizes = || dataset.frames.iter().map(|frame| [frame.image.width(), frame.image.height()]);
        let largest = largest(sizes());
        Self {
            largest,
            mixed: sizes().any(|size| size != largest),
            photographs: dataset.bytes_in_memory(),
            training: dataset.split(Split::Train).count(),
            masked: dataset.frames.iter().any(|frame| frame.mask.is_some()),
            packed: dataset
                .split(Split::Train)
                .filter(|frame| frame.image.bytes_in_memory() > 0)
                .map(|frame| packed(u64::from(frame.image.width()) * u64::from(frame.image.height())))
                .sum(),
            points: dataset.points.as_ref().map_or(0, |points| points.positions.len()),
        }
    }

    /// Of a dataset with these cameras whose photographs may take `memory_bytes` of memory; those beyond go to a file. Masks are not
    /// counted.
    #[must_use]
    pub fn of_cameras(cameras: &[NamedCamera], points: Option<usize>, memory_bytes: u64) -> Self {
        let size = |camera: &NamedCamera| {
            let Intrinsics { width, height, .. } = camera.camera.intrinsics;
            [width, height]
        };
        let largest = largest(cameras.iter().map(size));
        let pixels = |camera: &NamedCamera| size(camera).map(u64::from).iter().product::<u64>();
        let all = cameras.iter().map(pixels).fold(0, u64::saturating_add);
        let train = cameras.iter().filter(|camera| camera.split == Split::Train);
        let training = train.clone().count();
        let mixed = cameras.iter().any(|camera| size(camera) != largest);
        let train = train.map(pixels).fold(0, u64::saturating_add);
        Self { largest, mixed, training, ..Self::of_pixels(all, train, points, memory_bytes) }
    }

    /// Of a dataset of which the summary alone is known: as of square images of the mean size.
    #[must_use]
    pub fn of_summary(summary: &DatasetSummary, memory_bytes: u64) -> Self {
        let count = (summary.train + summary.test).max(1) as u64;
        let side = (summary.pixels.div_ceil(count) as f64).sqrt().ceil().max(1.0) as u32;
        let train = summary.pixels / count * summary.train as u64;
        let sizes = Self::of_pixels(summary.pixels, train, summary.points, memory_bytes);
        Self { largest: [side, side], training: summary.train, ..sizes }
    }

    fn of_pixels(all: u64, train: u64, points: Option<usize>, memory_bytes: u64) -> Self {
        let bytes = PHOTOGRAPH_BYTES.saturating_mul(all);
        // Those in a file are not kept packed either.
        let kept = if bytes > memory_bytes { memory_bytes as f64 / bytes as f64 } else { 1.0 };
        Self {
            largest: [1, 1],
            mixed: false,
            photographs: bytes.min(memory_bytes),
            training: 0,
            masked: false,
            packed: (packed(train) as f64 * kept) as u64,
            points: points.unwrap_or(0),
        }
    }
}

fn packed(pixels: u64) -> u64 {
    buffer_bytes::<u32>(usize::try_from(pixels).unwrap_or(usize::MAX / 8))
}

fn largest(sizes: impl Iterator<Item = [u32; 2]>) -> [u32; 2] {
    sizes.max_by_key(|[width, height]| u64::from(*width) * u64::from(*height)).unwrap_or([1, 1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Camera, Digest, Frame, Image, Layout, PointCloud, Pose};

    fn camera(width: u32, height: u32, split: Split) -> NamedCamera {
        let intrinsics = Intrinsics::from_horizontal_fov(1.0, width, height).expect("intrinsics");
        let pose = Pose::look_at(glam::DVec3::X, glam::DVec3::ZERO, glam::DVec3::Z).expect("a view");
        NamedCamera {
            name: format!("{width}x{height}"),
            split,
            camera: Camera::new(intrinsics, pose).expect("a camera"),
        }
    }

    #[test]
    fn a_checked_dataset_has_the_sizes_of_the_loaded_one() {
        let cameras =
            [camera(64, 48, Split::Train), camera(32, 16, Split::Train), camera(64, 48, Split::Test)];
        let frames = cameras.iter().map(|NamedCamera { name, split, camera }| {
            let Intrinsics { width, height, .. } = camera.intrinsics;
            let image = Image::new(width, height, 3, vec![0; 3 * (width * height) as usize]);
            let image = image.expect("an image").into();
            Frame { name: name.clone(), camera: *camera, image, mask: None, split: *split }
        });
        let dataset = Dataset {
            layout: Layout::Colmap,
            frames: frames.collect(),
            points: Some(PointCloud { positions: vec![[0.0; 3]; 7], colors: vec![[0; 3]; 7] }),
            digest: Digest::of(b"sizes"),
            notes: Vec::new(),
        };
        let loaded = SetSizes::of(&dataset);
        assert_eq!(SetSizes::of_cameras(&cameras, Some(7), u64::MAX), loaded);
        let half = SetSizes::of_cameras(&cameras, Some(7), loaded.photographs / 2);
        assert_eq!((half.photographs, half.packed), (loaded.photographs / 2, loaded.packed / 2));
        let pixels = 2 * 64 * 48 + 32 * 16;
        let summary =
            DatasetSummary { layout: Layout::Colmap, train: 2, test: 1, pixels, points: None, notes: vec![] };
        let sizes = SetSizes::of_summary(&summary, u64::MAX);
        assert_eq!((sizes.largest, sizes.mixed, sizes.points), ([48, 48], false, 0));
        assert_eq!((sizes.photographs, sizes.training), (loaded.photographs, loaded.training));
    }
}
