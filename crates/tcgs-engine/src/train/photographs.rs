//! The training photographs as the loss reads them: over the background in 8 bits, a word a pixel, with a weight in the fourth byte
//! (255 counts, 0 is ignored).
//!
//! Each is composited once where there is memory to keep it: on the device, or else in main memory. Otherwise, and until it is kept,
//! threads prepare the next ones while the device is busy. What always holds: the words do not depend on where they are kept, and a
//! photograph that is read from storage is not kept, since its set was too large for main memory.

use std::{
    collections::VecDeque,
    sync::{Arc, mpsc},
};

use super::{PhotographPlace, Result, TrainError};
use crate::{
    domain::{Background, Frame, Photograph, PhotographError, PixelMask},
    gpu::{Buffer, Device, Recorder},
};

/// Photographs that threads prepare ahead of the step that needs them.
pub(super) const AHEAD: usize = 4;

/// A photograph that is kept.
#[derive(Debug, Clone)]
enum Kept {
    Device(Buffer<u32>),
    Host(Arc<Vec<u32>>),
}

/// A photograph that a thread prepares.
type Preparation = mpsc::Receiver<Result<Vec<u32>, PhotographError>>;

/// The photographs of a run.
pub(super) struct Photographs {
    device: Arc<Device>,
    images: Vec<(Photograph, Option<PixelMask>)>,
    background: Background,
    place: PhotographPlace,
    kept: Vec<Option<Kept>>,
    prepared: VecDeque<(usize, Preparation)>,
    /// Holds the photograph of a step unless the device keeps it.
    current: Option<Buffer<u32>>,
}

/// An RGB image as the kernels read it: one word a pixel, red lowest, and a weight that counts.
#[must_use]
pub(super) fn pack(rgb: &[u8]) -> Vec<u32> {
    rgb.chunks_exact(3).map(|p| u32::from_le_bytes([p[0], p[1], p[2], 255])).collect()
}

fn packed(
    (photograph, mask): &(Photograph, Option<PixelMask>),
    background: Background,
) -> Result<Vec<u32>, PhotographError> {
    let mut words = pack(photograph.load()?.over(background.rgb8()).samples());
    if let Some(mask) = mask {
        // Of what is ignored not even the color is kept.
        words.iter_mut().zip(mask.iter()).filter(|(_, counts)| !counts).for_each(|(word, _)| *word = 0);
    }
    Ok(words)
}

impl Photographs {
    pub(super) fn new(
        device: &Arc<Device>,
        frames: &[Frame],
        background: Background,
        place: PhotographPlace,
    ) -> Self {
        Self {
            device: Arc::clone(device),
            images: frames.iter().map(|frame| (frame.image.clone(), frame.mask.clone())).collect(),
            background,
            place,
            kept: vec![None; frames.len()],
            prepared: VecDeque::new(),
            current: None,
        }
    }

    /// Records what brings the photograph `index` to the device, and returns its buffer there, which the next call may overwrite.
    ///
    /// # Errors
    /// A photograph that cannot be read back; as [`Device::buffer`].
    pub(super) fn bring(&mut self, recorder: &mut Recorder<'_>, index: usize) -> Result<Buffer<u32>> {
        let words = match &self.kept[index] {
            Some(Kept::Device(buffer)) => return Ok(buffer.clone()),
            Some(Kept::Host(words)) => Arc::clone(words),
            None => Arc::new(self.take(index)?),
        };
        if self.kept[index].is_none() && self.keeps(index) {
            if self.place == PhotographPlace::Device {
                let buffer = self.device.upload("photograph", &words)?;
                self.kept[index] = Some(Kept::Device(buffer.clone()));
                return Ok(buffer);
            }
            self.kept[index] = Some(Kept::Host(Arc::clone(&words)));
        }
        let current = match self.current.take().filter(|current| current.len() >= words.len()) {
            Some(current) => current,
            None => self.device.buffer("photograph", words.len())?,
        };
        recorder.write(&current, &words);
        Ok(self.current.insert(current).first(words.len()))
    }

    /// Lets threads prepare the photographs that are needed `next`, soonest first, unless they are kept.
    pub(super) fn prepare(&mut self, next: impl Iterator<Item = usize>) {
        for index in next.take(AHEAD) {
            let is_prepared = self.prepared.iter().any(|(prepared, _)| *prepared == index);
            if is_prepared || self.kept[index].is_some() || self.prepared.len() >= AHEAD {
                continue;
            }
            let (image, background) = (self.images[index].clone(), self.background);
            let (sender, receiver) = mpsc::channel();
            rayon::spawn(move || {
                // Nobody waits for it once the run has ended.
                let _ = sender.send(packed(&image, background));
            });
            self.prepared.push_back((index, receiver));
        }
    }

    fn keeps(&self, index: usize) -> bool {
        self.place != PhotographPlace::Nowhere && self.images[index].0.bytes_in_memory() > 0
    }

    /// The words of a photograph, which a thread may have prepared.
    fn take(&mut self, index: usize) -> Result<Vec<u32>> {
        let prepared = self.prepared.iter().position(|(prepared, _)| *prepared == index);
        let words = match prepared.and_then(|place| self.prepared.remove(place)) {
            // A thread that is gone has prepared nothing.
            Some((_, preparation)) => preparation.recv().ok(),
            None => None,
        };
        // Steps that are repeated need others than those that were prepared last.
        if self.prepared.len() >= AHEAD {
            self.prepared.pop_front();
        }
        words.unwrap_or_else(|| packed(&self.images[index], self.background)).map_err(TrainError::from)
    }
}
