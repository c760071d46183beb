//! Buffers on their way back from the device while it goes on with what is submitted after them.
//!
//! What always holds: [`Readback::wait`] gives what the buffers held after the submission that it belongs to, and waits for that one
//! alone.

use super::{Binding, Device, GpuError, Recorder, ledger::Reservation};

/// The copies of some buffers after a submission.
#[derive(Debug)]
pub struct Readback {
    staging: wgpu::Buffer,
    submission: wgpu::SubmissionIndex,
    /// Words of each buffer.
    words: Vec<usize>,
    _reservation: Reservation,
}

impl Recorder<'_> {
    /// Submits what was recorded, with copies of these buffers as they are after it; does not wait, unless the device is profiled.
    ///
    /// # Errors
    /// As [`Recorder::submit`], and [`GpuError::OverBudget`] without room for the copies.
    pub fn submit_reading(mut self, buffers: &[Binding<'_>]) -> Result<Readback, GpuError> {
        let device = self.device();
        let sources: Vec<&wgpu::Buffer> = buffers.iter().map(|buffer| &(*buffer).as_ref().inner).collect();
        let size = sources.iter().map(|source| source.size()).sum::<u64>().max(wgpu::COPY_BUFFER_ALIGNMENT);
        let reservation = device.ledger.reserve("read back", size)?;
        let staging = device.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut start = 0;
        for source in &sources {
            self.outside().copy_buffer_to_buffer(source, 0, &staging, start, source.size());
            start += source.size();
        }
        let words = sources.iter().map(|source| source.size() as usize / 4).collect();
        let submission = self.submit_indexed()?;
        staging.slice(..).map_async(wgpu::MapMode::Read, |_| ());
        Ok(Readback { staging, submission, words, _reservation: reservation })
    }
}

impl Readback {
    /// The words of each buffer, rounded up to whole numbers of four. Waits for the submission.
    ///
    /// # Errors
    /// As [`Device::check`].
    pub fn wait(self, device: &Device) -> Result<Vec<Vec<u32>>, GpuError> {
        device.wait_for(self.submission)?;
        let unreadable = |fault: String| GpuError::Rejected(format!("mapping for reading: {fault}"));
        let view =
            self.staging.slice(..).get_mapped_range().map_err(|fault| unreadable(fault.to_string()))?;
        let all: &[u32] = bytemuck::try_cast_slice(&view).map_err(|fault| unreadable(fault.to_string()))?;
        let mut rest = all;
        Ok(self
            .words
            .iter()
            .map(|words| {
                let (buffer, others) = rest.split_at(*words);
                rest = others;
                buffer.to_vec()
            })
            .collect())
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
