//! Reads buffers back, through new staging buffers or a ring of kept ones: a new one of a view's size costs as much as its transfer.
//!
//! Invariants: a read gives what its submission copied and waits for that submission alone; a staging buffer whose read failed or was
//! dropped is freed, not kept.

use std::{ops::Range, sync::Arc};

use super::{Buffer, Device, GpuError, ledger::Reservation, mapping::Mapping};

/// A buffer that the host maps to read copies of others.
#[derive(Debug)]
pub(super) struct StagingBuffer {
    inner: wgpu::Buffer,
    _reservation: Reservation,
}

/// A read whose copy was submitted. Dropped unfinished, it frees its staging buffer.
#[derive(Debug)]
pub struct PendingRead {
    staging: StagingBuffer,
    submission: wgpu::SubmissionIndex,
    mapping: Arc<Mapping>,
    /// Without alignment.
    bytes: usize,
}

/// Staging buffers that are kept from one read to the next of the same size: one for each read that is under way at a time.
#[derive(Debug, Default)]
pub struct Staging {
    kept: Vec<StagingBuffer>,
}

impl StagingBuffer {
    /// # Errors
    /// [`GpuError::OverBudget`] without room for it.
    pub(super) fn new(device: &Device, bytes: u64) -> Result<Self, GpuError> {
        let reservation = device.ledger.reserve("read back", bytes)?;
        let inner = device.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Ok(Self { inner, _reservation: reservation })
    }

    /// The target of copies.
    pub(super) fn raw(&self) -> &wgpu::Buffer {
        &self.inner
    }
}

impl PendingRead {
    /// The read of the first `bytes` bytes of `staging` after `submission`, which copies into it.
    pub(super) fn after(submission: wgpu::SubmissionIndex, staging: StagingBuffer, bytes: usize) -> Self {
        let mapping = Arc::new(Mapping::default());
        let ended = Arc::clone(&mapping);
        staging.inner.slice(..).map_async(wgpu::MapMode::Read, move |_| ended.end());
        Self { staging, submission, mapping, bytes }
    }

    /// Waits without blocking until [`Staging::finish`] finds the copy or the fault. On a page, the browser drives the device;
    /// elsewhere, somebody has to wait for it meanwhile.
    pub async fn mapped(&self) {
        self.mapping.ended().await;
    }

    /// Waits for the submission, passes the elements to `take`, and returns its result and the staging buffer, which is not mapped.
    /// Later work may go on meanwhile.
    ///
    /// # Errors
    /// As [`Device::check`], and [`GpuError::Rejected`] if the copy was refused, such as one beyond a buffer's end.
    pub(super) fn finish<T: bytemuck::Pod, R>(
        self,
        device: &Device,
        take: impl FnOnce(&[T]) -> R,
    ) -> Result<(R, StagingBuffer), GpuError> {
        let Self { staging, submission, bytes, .. } = self;
        device.wait_for(submission)?;
        let unreadable = |error: String| GpuError::Rejected(format!("mapping for reading: {error}"));
        let view =
            staging.inner.slice(..).get_mapped_range().map_err(|error| unreadable(error.to_string()))?;
        let elements =
            bytemuck::try_cast_slice(&view[..bytes]).map_err(|error| unreadable(error.to_string()))?;
        let taken = take(elements);
        drop(view);
        staging.inner.unmap();
        Ok((taken, staging))
    }
}

impl Staging {
    /// Submits a copy of the elements of `range`, which is not empty, behind the work submitted so far. Does not wait.
    ///
    /// # Errors
    /// As [`Device::check`], and [`GpuError::OverBudget`] without room for the transfer.
    pub fn start<T: bytemuck::Pod>(
        &mut self,
        device: &Device,
        buffer: &Buffer<T>,
        range: Range<usize>,
    ) -> Result<PendingRead, GpuError> {
        device.check()?;
        let size = size_of::<T>();
        let bytes = range.len() * size;
        let aligned = (bytes as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        self.kept.retain(|staging| staging.inner.size() == aligned);
        let staging = match self.kept.pop() {
            Some(kept) => kept,
            None => StagingBuffer::new(device, aligned)?,
        };
        let mut encoder = device.inner.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer.raw(), (range.start * size) as u64, staging.raw(), 0, aligned);
        let submission = device.queue.submit([encoder.finish()]);
        Ok(PendingRead::after(submission, staging, bytes))
    }

    /// Waits for a read of this ring and passes its elements to `take`. Later work may go on meanwhile.
    ///
    /// # Errors
    /// As [`Device::check`], and [`GpuError::Rejected`] for a range beyond the buffer, such as a count that a faulty device has
    /// written.
    pub fn finish<T: bytemuck::Pod, R>(
        &mut self,
        device: &Device,
        read: PendingRead,
        take: impl FnOnce(&[T]) -> R,
    ) -> Result<R, GpuError> {
        let (taken, staging) = read.finish(device, take)?;
        self.kept.push(staging);
        Ok(taken)
    }

    /// Passes the elements of `range` to `take`. Waits for the device.
    ///
    /// # Errors
    /// As [`Staging::start`] and [`Staging::finish`].
    pub fn read<T: bytemuck::Pod, R>(
        &mut self,
        device: &Device,
        buffer: &Buffer<T>,
        range: Range<usize>,
        take: impl FnOnce(&[T]) -> R,
    ) -> Result<R, GpuError> {
        device.check()?;
        if range.is_empty() {
            return Ok(take(&[]));
        }
        let read = self.start(device, buffer, range)?;
        self.finish(device, read, take)
    }
}

impl Device {
    /// Reads a whole buffer back. Waits for the device.
    ///
    /// # Errors
    /// As [`Device::read_range`].
    pub fn read<T: bytemuck::Pod>(&self, buffer: &Buffer<T>) -> Result<Vec<T>, GpuError> {
        self.read_range(buffer, 0, buffer.len())
    }

    /// Reads `count` elements from `start`. Waits for the device.
    ///
    /// # Errors
    /// As [`Device::check`], and [`GpuError::OverBudget`] without room for the transfer.
    pub fn read_range<T: bytemuck::Pod>(
        &self,
        buffer: &Buffer<T>,
        start: usize,
        count: usize,
    ) -> Result<Vec<T>, GpuError> {
        Staging::default().read(self, buffer, start..start + count, <[T]>::to_vec)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::lavapipe;

    #[test]
    fn a_kept_buffer_gives_what_the_buffer_holds_now_and_follows_its_size() {
        let device = lavapipe();
        let mut staging = Staging::default();
        let mut read = |buffer: &Buffer<u32>, range: Range<usize>| {
            staging.read(&device, buffer, range, <[u32]>::to_vec).expect("reads")
        };
        let buffer = device.upload("numbers", &[1_u32, 2, 3, 4, 5]).expect("room");
        assert_eq!(read(&buffer, 0..5), [1, 2, 3, 4, 5]);
        device.write(&buffer, &[9_u32, 8]);
        assert_eq!(read(&buffer, 0..5), [9, 8, 3, 4, 5]);
        assert_eq!(read(&buffer, 1..3), [8, 3]);
        assert_eq!(read(&buffer, 2..2), [0_u32; 0]);
        let small = device.upload("others", &[7_u32, 6]).expect("room");
        assert_eq!(read(&small, 0..2), [7, 6]);
    }

    #[test]
    fn readings_under_way_keep_what_the_buffer_held_when_they_were_submitted() {
        let device = lavapipe();
        let buffer = device.upload("numbers", &[1_u32, 2, 3]).expect("room");
        let before = device.allocated_bytes();
        let mut staging = Staging::default();
        for _ in 0..2 {
            device.write(&buffer, &[1_u32, 2, 3]);
            let first = staging.start(&device, &buffer, 0..3).expect("submits");
            device.write(&buffer, &[4_u32, 5, 6]);
            let second = staging.start(&device, &buffer, 0..3).expect("submits");
            device.write(&buffer, &[7_u32, 8, 9]);
            let mut finish = |read| staging.finish(&device, read, <[u32]>::to_vec).expect("reads");
            assert_eq!((finish(first), finish(second)), (vec![1, 2, 3], vec![4, 5, 6]));
            assert_eq!(device.allocated_bytes(), before + 24, "two buffers, kept");
        }
        drop(staging.start(&device, &buffer, 0..3).expect("submits"));
        assert_eq!(staging.read(&device, &buffer, 0..3, <[u32]>::to_vec), Ok(vec![7, 8, 9]));
        assert_eq!(device.allocated_bytes(), before + 12, "one was dropped under way");
    }

    #[test]
    fn a_reading_under_way_on_a_lost_device_fails_with_the_loss() {
        let device = lavapipe();
        let buffer = device.upload("numbers", &[1_u32, 2, 3]).expect("room");
        let mut staging = Staging::default();
        let read = staging.start(&device, &buffer, 0..3).expect("submits");
        device.destroy();
        let found = staging.finish(&device, read, <[u32]>::to_vec);
        assert!(matches!(found, Err(GpuError::DeviceLost(_) | GpuError::Rejected(_))), "{found:?}");
    }

    #[test]
    fn a_reading_can_be_awaited_while_another_thread_waits_for_the_device() {
        let device = lavapipe();
        let buffer = device.upload("numbers", &[1_u32, 2, 3]).expect("room");
        let mut staging = Staging::default();
        let read = staging.start(&device, &buffer, 0..3).expect("submits");
        std::thread::scope(|scope| {
            scope.spawn(|| device.wait());
            pollster::block_on(read.mapped());
        });
        assert_eq!(staging.finish(&device, read, <[u32]>::to_vec), Ok(vec![1, 2, 3]));
    }

    #[test]
    fn a_range_beyond_the_buffer_is_an_error() {
        let device = lavapipe();
        let buffer = device.upload("numbers", &[1_u32, 2, 3]).expect("room");
        let read = Staging::default().read(&device, &buffer, 1..1000, <[u32]>::to_vec);
        assert!(matches!(read, Err(GpuError::Rejected(_))), "{read:?}");
    }

    #[test]
    fn the_bytes_of_a_kept_buffer_count_once_and_end_with_it() {
        let device = lavapipe();
        let buffer = device.upload("numbers", &[1.0_f32; 1000]).expect("room");
        let before = device.allocated_bytes();
        let mut staging = Staging::default();
        for _ in 0..3 {
            assert_eq!(staging.read(&device, &buffer, 0..1000, |values| values.len()), Ok(1000));
            assert_eq!(device.allocated_bytes(), before + 4000);
        }
        drop(staging);
        assert_eq!(device.allocated_bytes(), before);
    }
}
