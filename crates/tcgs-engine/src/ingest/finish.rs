//! Finishes a photograph with what masks and transparency hide of it.

use super::{
    error::{IngestError, IngestErrorKind},
    limits::Limits,
    mask_pixels::Plane,
    mask_reader::FrameMasks,
    surveyed_frame::SurveyedFrame,
    tree::Tree,
};
use crate::domain::{Image, PixelMask};

impl SurveyedFrame {
    /// The finished photograph from the stored and turned one, and which of its pixels count, if not all.
    ///
    /// # Errors
    /// [`IngestErrorKind::Image`] for an image or a mask that cannot be decoded.
    pub(super) fn finish_with_masks(
        &self,
        tree: &Tree,
        image: Image,
        limits: &Limits,
    ) -> Result<(Image, Option<PixelMask>), IngestError> {
        let file = &self.frame.file;
        let at_file = |error: IngestErrorKind| error.at(file);
        let FrameMasks { files, mode } = &self.masks;
        let mut plane = if mode.ignores_alpha { Plane::opaque(&image) } else { None };
        for mask in files {
            let bytes = tree.read(&mask.file)?;
            let read = Plane::decode(&bytes, mask.turn, mask.hidden, limits)
                .map_err(|error| error.at(&mask.file))?;
            drop(bytes);
            let read = if mode.cuts_out { read } else { read.hard() };
            let (width, height) = self.stored_size();
            let read = read.resized(width, height);
            plane = Some(match plane {
                Some(plane) => plane.least(&read),
                None => read,
            });
        }
        match plane {
            None => Ok((self.finish(image).map_err(at_file)?, None)),
            Some(plane) if mode.cuts_out => {
                Ok((self.finish(cut_out(&image, &plane).unwrap_or(image)).map_err(at_file)?, None))
            }
            Some(plane) => {
                let image = self.finish(image).map_err(at_file)?;
                // Its colors are those of opaque pixels alone.
                let image = if mode.ignores_alpha { without_alpha(image) } else { image };
                Ok((image, self.finish_mask(plane)))
            }
        }
    }
}

/// An image with a mask as its transparency, beside its own; `None` if the sizes differ.
fn cut_out(image: &Image, mask: &Plane) -> Option<Image> {
    if (image.width(), image.height()) != (mask.width, mask.height) {
        return None;
    }
    let channels = usize::from(image.channels());
    let pixels = image.samples().chunks_exact(channels).zip(&mask.samples);
    let samples = pixels.flat_map(|(pixel, mask)| {
        let own = pixel.get(3).map_or(255, |alpha| u16::from(*alpha));
        [pixel[0], pixel[1], pixel[2], (own * u16::from(*mask) / 255) as u8]
    });
    Image::new(image.width(), image.height(), 4, samples.collect()).ok()
}

/// The colors of an image.
fn without_alpha(image: Image) -> Image {
    if image.channels() == 3 {
        return image;
    }
    let colors = image.samples().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]);
    Image::new(image.width(), image.height(), 3, colors.collect()).unwrap_or(image)
}
