//! One photograph of a surveyed dataset: how its stored pixels and masks become those that are trained on, and the memory that takes.

use std::sync::{Arc, OnceLock};

use image::metadata::Orientation;

use super::{
    distortion::{Crop, Distortion},
    error::{IngestErrorKind, Result},
    images::DECODE_BYTES,
    mask_pixels::Plane,
    mask_reader::FrameMasks,
    plan::PlannedFrame,
    sampling, valid_region,
};
use crate::domain::{Camera, Image, Intrinsics, PixelMask};

/// The pixels that a lens saw, computed once they are wanted.
pub(super) type ValidPixels = Arc<OnceLock<PixelMask>>;

/// One frame and how its image is processed.
pub(super) struct SurveyedFrame {
    pub(super) frame: PlannedFrame,
    /// The camera of the finished image.
    pub(super) camera: Camera,
    /// How the stored pixels are turned first.
    pub(super) turn: Orientation,
    /// Pinhole intrinsics of the image so turned, distortion aside.
    pub(super) stored: Intrinsics,
    /// Whether the stored image may be transparent.
    pub(super) alpha: bool,
    pub(super) distortion: Distortion,
    pub(super) crop: Crop,
    /// The masks, and what they mean.
    pub(super) masks: FrameMasks,
    /// The pixels that the lens saw, computed once for all photographs of a camera and size; `None` if it saw all.
    pub(super) valid: Option<ValidPixels>,
}

/// Bytes a pixel of an image in single precision, as the filter that downscales works on it.
const FILTER_BYTES: u64 = 16;

impl SurveyedFrame {
    /// The most memory that decoding and finishing the image takes, besides the stored file.
    pub(super) fn decode_bytes(&self) -> u64 {
        let (from, to) = (&self.stored, &self.camera.intrinsics);
        let pixels = |width: u32, height: u32| u64::from(width) * u64::from(height);
        let channels = if self.alpha || self.masks.cuts_out() { 4 } else { 3 };
        // As stored, undistorted, weighted by alpha; then filtered down, then across.
        let mut resampling = channels * pixels(from.width, from.height);
        if !self.distortion.is_none() {
            resampling += channels * pixels(from.width, from.height);
        }
        if self.crop.width != to.width {
            let weighted =
                if self.alpha { FILTER_BYTES * pixels(self.crop.width, self.crop.height) } else { 0 };
            resampling += weighted
                + FILTER_BYTES * pixels(self.crop.width, to.height)
                + (FILTER_BYTES + channels) * pixels(to.width, to.height);
        }
        let masks = self.masks.decode_bytes(pixels(from.width, from.height), self.alpha);
        resampling.max(DECODE_BYTES * pixels(from.width, from.height)).saturating_add(masks)
    }

    /// Width and height of the stored and turned image.
    pub(super) fn stored_size(&self) -> (u32, u32) {
        (self.stored.width, self.stored.height)
    }

    /// Which pixels of the finished image count by a mask of the stored and turned one: those of which all that they show does.
    pub(super) fn finish_mask(&self, plane: Plane) -> Option<PixelMask> {
        let plane = if self.distortion.is_none() {
            plane
        } else {
            let image = plane.to_image()?;
            drop(plane);
            Plane::of_image(&self.distortion.undistort(&image, &self.stored, self.crop))
        };
        let finished = self.camera.intrinsics;
        plane.downscaled(finished.width, finished.height).mask()
    }

    /// The pixels of the finished image that the lens saw; `None` if it saw all.
    pub(super) fn valid_pixels(&self) -> Option<PixelMask> {
        let size = (self.camera.intrinsics.width, self.camera.intrinsics.height);
        let compute = || valid_region::valid_pixels(&self.distortion, &self.stored, size);
        self.valid.as_ref().map(|valid| valid.get_or_init(compute).clone())
    }

    /// The finished image from the stored and turned one.
    ///
    /// # Errors
    /// [`IngestErrorKind::Image`] if the pixels are not of the size that the header promised.
    pub(super) fn finish(&self, image: Image) -> Result<Image> {
        let (actual, expected) = ((image.width(), image.height()), (self.stored.width, self.stored.height));
        if actual != expected {
            return Err(IngestErrorKind::Image(format!(
                "the header says {expected:?} pixels and the data {actual:?}"
            )));
        }
        let image = if self.distortion.is_none() {
            image
        } else {
            self.distortion.undistort(&image, &self.stored, self.crop)
        };
        let finished = self.camera.intrinsics;
        Ok(if image.width() == finished.width {
            image
        } else {
            sampling::downscaled(image, finished.width, finished.height)
        })
    }
}
