//! Views as 8-bit colors: rounded on the device, and read back with the counters of their pass in one transfer, through buffers that
//! are kept.

use std::sync::Arc;

use super::Result;
use crate::gpu::{Binding, Buffer, Device, Kernel, PendingRead, Recorder, Staging, kernel_source};

/// Rounds images.
#[derive(Debug)]
pub struct PackedImage {
    kernel: Arc<Kernel>,
    /// A word a pixel, then the counters.
    words: Buffer<u32>,
    counters: usize,
    staging: Staging,
}

impl PackedImage {
    /// Prepares the kernel; the buffer comes with the first image.
    pub fn new(device: &Device) -> Result<Self> {
        Ok(Self {
            kernel: device.kernel(kernel_source!("pack_image"), &[])?,
            words: device.buffer("packed image", 0)?,
            counters: 0,
            staging: Staging::default(),
        })
    }

    /// Records the rounding of an image, and a copy of the counters of the pass that makes it.
    pub fn record(
        &mut self,
        device: &Device,
        recorder: &mut Recorder<'_>,
        image: &Buffer<[f32; 4]>,
        counters: &Buffer<u32>,
    ) -> Result<()> {
        let pixels = image.len();
        self.counters = counters.len();
        if self.words.len() != pixels + self.counters {
            self.words = device.buffer("packed image", pixels + self.counters)?;
        }
        let count = u32::try_from(pixels).unwrap_or(u32::MAX);
        let pixels_to_pack = recorder.uniform(&[count])?;
        let buffers: [Binding<'_>; 3] = [&pixels_to_pack, image, &self.words];
        recorder.dispatch(&self.kernel, &buffers, count.div_ceil(64));
        recorder.copy(counters, 0, &self.words, pixels, self.counters);
        Ok(())
    }

    /// Submits the reading of the last submitted image and its counters. Does not wait.
    pub fn start_read(&mut self, device: &Device) -> Result<PendingImage> {
        let pixels = self.words.len().saturating_sub(self.counters);
        let read = self.staging.start(device, &self.words, 0..self.words.len())?;
        Ok(PendingImage { read, pixels })
    }

    /// The last submitted image, a word a pixel, then the counters.
    #[cfg(target_arch = "wasm32")]
    pub(super) fn words(&self) -> &Buffer<u32> {
        &self.words
    }

    /// The image, row by row as red, green and blue, and the counters. Waits for the device.
    pub fn finish_read(&mut self, device: &Device, image: PendingImage) -> Result<(Vec<u8>, Vec<u32>)> {
        let unpack = |words: &[u32]| {
            let (pixels, counters) = words.split_at(image.pixels);
            let mut samples = vec![0; 3 * pixels.len()];
            for (sample, word) in samples.as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
                let [red, green, blue, _] = word.to_le_bytes();
                *sample = [red, green, blue];
            }
            (samples, counters.to_vec())
        };
        Ok(self.staging.finish(device, image.read, unpack)?)
    }
}

/// An image on its way from the device.
#[derive(Debug)]
pub struct PendingImage {
    pub(super) read: PendingRead,
    pixels: usize,
}
