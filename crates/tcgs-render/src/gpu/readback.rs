//! Buffers on their way back from the device while it goes on with what is submitted after them.
//!
//! What always holds: [`Readback::wait`] gives what the buffers held after the submission that it belongs to, and waits for that one
//! alone.

use super::{
    Binding, Device, GpuError, Recorder,
    staging::{PendingRead, StagingBuffer},
};

/// The copies of some buffers after a submission.
#[derive(Debug)]
pub struct Readback {
    read: PendingRead,
    /// Words of each buffer.
    words: Vec<usize>,
}

impl Recorder<'_> {
    /// Submits what was recorded, with copies of these buffers as they are after it; does not wait, unless the device is profiled.
    ///
    /// # Errors
    /// As [`Recorder::submit`], and [`GpuError::OverBudget`] without room for the copies.
    pub fn submit_reading(mut self, buffers: &[Binding<'_>]) -> Result<Readback, GpuError> {
        let sources: Vec<&wgpu::Buffer> = buffers.iter().map(|buffer| &(*buffer).as_ref().inner).collect();
        let bytes = sources.iter().map(|source| source.size()).sum::<u64>();
        let staging = StagingBuffer::new(self.device(), bytes.max(wgpu::COPY_BUFFER_ALIGNMENT))?;
        let mut start = 0;
        for source in &sources {
            self.outside().copy_buffer_to_buffer(source, 0, staging.raw(), start, source.size());
            start += source.size();
        }
        let words = sources.iter().map(|source| source.size() as usize / 4).collect();
        let read = PendingRead::after(self.submit_indexed()?, staging, bytes as usize);
        Ok(Readback { read, words })
    }
}

impl Readback {
    /// The words of each buffer, rounded up to whole numbers of four. Waits for the submission.
    ///
    /// # Errors
    /// As [`Device::check`].
    pub fn wait(self, device: &Device) -> Result<Vec<Vec<u32>>, GpuError> {
        let Self { read, words } = self;
        let split = |mut rest: &[u32]| {
            let next = |words: &usize| {
                let (buffer, others) = rest.split_at(*words);
                rest = others;
                buffer.to_vec()
            };
            words.iter().map(next).collect()
        };
        read.finish(device, split).map(|(buffers, _)| buffers)
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::testing::lavapipe;

    #[test]
    fn copies_are_of_the_submission_that_they_belong_to() {
        let device = lavapipe();
        let (one, two) = (device.buffer::<u32>("one", 4), device.upload("two", &[7_u32; 8]));
        let (one, two) = (one.expect("room"), two.expect("room"));
        let mut readings = Vec::new();
        for value in 1..=5_u32 {
            let mut recorder = device.recorder("write");
            recorder.write(&one, &[value; 4]);
            readings.push(recorder.submit_reading(&[&one, &two]).expect("submitted"));
        }
        for (value, reading) in (1..=5).zip(readings) {
            assert_eq!(reading.wait(&device).expect("read"), [vec![value; 4], vec![7; 8]]);
        }
        assert_eq!(device.recorder("nothing").submit_reading(&[]).expect("sent").wait(&device), Ok(vec![]));
    }
}
