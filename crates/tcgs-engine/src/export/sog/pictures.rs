//! The pictures of a `.sog` and the archive that holds them.

use std::io::{Cursor, Write as _};

use image::{ExtendedColorType, codecs::webp::WebPEncoder};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{SogError, palette::Palette};

/// Entries of the palette in a row of its picture, as the format has it.
const ENTRIES_A_ROW: usize = 64;

/// Four bytes a pixel.
pub(super) struct Picture {
    width: usize,
    pixels: Vec<[u8; 4]>,
}

impl Picture {
    fn new(width: usize, height: usize) -> Self {
        Self { width, pixels: vec![[0, 0, 0, 255]; width * height] }
    }

    pub(super) fn set(&mut self, pixel: usize, [red, green, blue]: [u8; 3], alpha: u8) {
        self.pixels[pixel] = [red, green, blue, alpha];
    }

    fn webp(&self) -> Result<Vec<u8>, SogError> {
        let side = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
        let (width, height) = (side(self.width), side(self.pixels.len() / self.width));
        let mut bytes = Vec::new();
        WebPEncoder::new_lossless(&mut bytes).encode(
            self.pixels.as_flattened(),
            width,
            height,
            ExtendedColorType::Rgba8,
        )?;
        Ok(bytes)
    }
}

/// One pixel per Gaussian in each.
pub(super) struct Pictures {
    pub(super) low: Picture,
    pub(super) high: Picture,
    pub(super) scales: Picture,
    pub(super) rotations: Picture,
    pub(super) colors: Picture,
    pub(super) labels: Picture,
}

impl Pictures {
    pub(super) fn new(count: usize) -> Self {
        let width = count.isqrt().max(1).next_multiple_of(4);
        let picture = || Picture::new(width, count.div_ceil(width));
        Self {
            low: picture(),
            high: picture(),
            scales: picture(),
            rotations: picture(),
            colors: picture(),
            labels: picture(),
        }
    }

    /// The archive, whose files are stored as they are: WebP packs already.
    pub(super) fn archive(&self, meta: &str, palette: Option<&Palette>) -> Result<Vec<u8>, SogError> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        let mut add = |name: &str, bytes: &[u8]| {
            zip.start_file(name, options)?;
            zip.write_all(bytes)?;
            Ok::<(), SogError>(())
        };
        add("meta.json", meta.as_bytes())?;
        add("means_l.webp", &self.low.webp()?)?;
        add("means_u.webp", &self.high.webp()?)?;
        add("scales.webp", &self.scales.webp()?)?;
        add("quats.webp", &self.rotations.webp()?)?;
        add("sh0.webp", &self.colors.webp()?)?;
        if let Some(palette) = palette {
            add("shN_centroids.webp", &centroids(palette).webp()?)?;
            add("shN_labels.webp", &self.labels.webp()?)?;
        }
        Ok(zip.finish()?.into_inner())
    }
}

/// The palette's entries, one pixel per coefficient.
fn centroids(palette: &Palette) -> Picture {
    let width = ENTRIES_A_ROW * palette.coefficients;
    let mut picture = Picture::new(width, palette.len().div_ceil(ENTRIES_A_ROW));
    for label in 0..palette.len() {
        let first = label / ENTRIES_A_ROW * width + label % ENTRIES_A_ROW * palette.coefficients;
        for (place, rgb) in palette.entry(label).enumerate() {
            picture.set(first + place, rgb, 255);
        }
    }
    picture
}
