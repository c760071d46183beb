//! Reads buffers back, through a new staging buffer or one that is kept: a new one of a view's size costs as much as its transfer.

use std::ops::Range;

use super::{Buffer, Device, GpuError, ledger::Reservation};

/// A staging buffer that is kept from one reading to the next of the same size.
#[derive(Debug, Default)]
pub struct Staging {
    kept: Option<(wgpu::Buffer, Reservation)>,
}

impl Staging {
    /// Passes the elements of `range` to `take`. Waits for the device.
    ///
    /// # Errors
    /// As [`Device::check`], [`GpuError::OverBudget`] without room for the transfer, and [`GpuError::Rejected`] for a range beyond the
    /// buffer, such as a count that a faulty device has written.
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
        let size = size_of::<T>();
        let bytes = ((range.len() * size) as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        // A reading that fails leaves its buffer behind, which may be mapped or about to be.
        let fits = |kept: &(wgpu::Buffer, Reservation)| kept.0.size() == bytes;
        let (staging, reservation) = match self.kept.take().filter(fits) {
            Some(kept) => kept,
            None => new_staging(device, bytes)?,
        };
        let mut encoder = device.inner.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer.raw(), (range.start * size) as u64, &staging, 0, bytes);
        device.queue.submit([encoder.finish()]);
        staging.slice(..).map_async(wgpu::MapMode::Read, |_| ());
        device.wait()?;
        let unreadable = |fault: String| GpuError::Rejected(format!("mapping for reading: {fault}"));
        let view = staging.slice(..).get_mapped_range().map_err(|fault| unreadable(fault.to_string()))?;
        let elements = bytemuck::try_cast_slice(&view[..range.len() * size])
            .map_err(|fault| unreadable(fault.to_string()))?;
        let taken = take(elements);
        drop(view);
        staging.unmap();
        self.kept = Some((staging, reservation));
        Ok(taken)
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

fn new_staging(device: &Device, bytes: u64) -> Result<(wgpu::Buffer, Reservation), GpuError> {
    let reservation = device.ledger.reserve("read back", bytes)?;
    let staging = device.inner.create_buffer(&wgpu::BufferDescriptor {
        label: Some("read back"),
        size: bytes,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    Ok((staging, reservation))
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
