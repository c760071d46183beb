//! Typed device buffers whose bytes are counted while they live.

use std::{marker::PhantomData, sync::Arc};

use super::{Device, GpuError, ledger::Reservation};

/// A device buffer without its element type.
#[derive(Debug)]
pub struct RawBuffer {
    pub(super) inner: wgpu::Buffer,
    // Ends with the handle. The driver frees the memory once no recorded command uses it; destroying it there and then would
    // spoil those commands.
    _reservation: Reservation,
}

/// A device buffer of `len` elements; usable as storage and as source and target of copies.
#[derive(Debug, Clone)]
pub struct Buffer<T> {
    inner: Arc<RawBuffer>,
    len: usize,
    kind: PhantomData<T>,
}

impl<T: bytemuck::Pod> Buffer<T> {
    /// Number of elements.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no element (the device buffer then holds one that is never used).
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The same buffer, of which only the first `len` elements count; all of them if there are fewer.
    #[must_use]
    pub fn first(&self, len: usize) -> Self {
        Self { inner: Arc::clone(&self.inner), len: len.min(self.len), kind: PhantomData }
    }

    /// The same buffer with `len` elements, whatever they hold, if it has room for them.
    fn with_len(&self, len: usize) -> Option<Self> {
        let has_room = buffer_bytes::<T>(len) <= self.raw().size();
        has_room.then(|| Self { inner: Arc::clone(&self.inner), len, kind: PhantomData })
    }

    pub(super) fn raw(&self) -> &wgpu::Buffer {
        &self.inner.inner
    }
}

impl<T> AsRef<RawBuffer> for Buffer<T> {
    fn as_ref(&self) -> &RawBuffer {
        &self.inner
    }
}

/// Bytes on the device of a buffer of `len` elements.
#[must_use]
pub fn buffer_bytes<T>(len: usize) -> u64 {
    (len.max(1) as u64).saturating_mul(size_of::<T>() as u64).div_ceil(16).saturating_mul(16)
}

/// A buffer before it is made: estimates and limits read the sizes that the buffers then have.
#[derive(Debug, Clone, Copy)]
pub struct BufferPlan<T> {
    label: &'static str,
    len: usize,
    kind: PhantomData<T>,
}

impl<T: bytemuck::Pod> BufferPlan<T> {
    /// `len` elements for what `label` names.
    #[must_use]
    pub fn new(label: &'static str, len: usize) -> Self {
        Self { label, len, kind: PhantomData }
    }

    /// Bytes on the device.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        buffer_bytes::<T>(self.len)
    }

    /// Makes the buffer.
    ///
    /// # Errors
    /// As [`Device::buffer`].
    pub fn make(&self, device: &Device) -> Result<Buffer<T>, GpuError> {
        device.buffer(self.label, self.len)
    }
}

impl Device {
    /// A new buffer of `len` zeroed elements.
    ///
    /// # Errors
    /// [`GpuError::BufferTooLarge`] if the adapter cannot bind it, [`GpuError::OverBudget`] if the device may not take
    /// that much more, [`GpuError::DeviceLost`].
    pub fn buffer<T: bytemuck::Pod>(&self, label: &str, len: usize) -> Result<Buffer<T>, GpuError> {
        self.check()?;
        let bytes = buffer_bytes::<T>(len);
        let limit = self.adapter().max_binding_bytes.min(self.adapter().max_buffer_bytes);
        if bytes > limit {
            return Err(GpuError::BufferTooLarge { label: label.to_owned(), bytes, limit });
        }
        let reservation = self.ledger.reserve(label, bytes)?;
        let inner = self.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST
                | wgpu::BufferUsages::UNIFORM,
            mapped_at_creation: false,
        });
        let inner = Arc::new(RawBuffer { inner, _reservation: reservation });
        Ok(Buffer { inner, len, kind: PhantomData })
    }

    /// Gives `buffer` a length: it stays the same where it has room, whatever it holds, and is a new one, zeroed, where it has not.
    ///
    /// # Errors
    /// As [`Device::buffer`]; `buffer` is unchanged.
    pub fn resize<T: bytemuck::Pod>(
        &self,
        buffer: &mut Buffer<T>,
        label: &str,
        len: usize,
    ) -> Result<(), GpuError> {
        *buffer = match buffer.with_len(len) {
            Some(kept) => kept,
            None => self.buffer(label, len)?,
        };
        Ok(())
    }

    /// A new buffer that holds `values`.
    ///
    /// # Errors
    /// As [`Device::buffer`].
    pub fn upload<T: bytemuck::Pod>(&self, label: &str, values: &[T]) -> Result<Buffer<T>, GpuError> {
        let buffer = self.buffer(label, values.len())?;
        self.write(&buffer, values);
        Ok(buffer)
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::testing::lavapipe;

    #[test]
    fn a_buffer_is_for_kernels_and_copies_only() {
        // For a buffer that dispatches may read their counts from, wgpu makes bind groups of its own.
        let buffer = lavapipe().buffer::<u32>("one", 1).expect("room");
        assert!(!buffer.raw().usage().contains(wgpu::BufferUsages::INDIRECT));
    }

    #[test]
    fn a_buffer_that_has_room_is_kept_and_another_is_made_beyond() {
        let device = lavapipe();
        let mut buffer = device.upload("kept", &[1_u32, 2, 3, 4, 5, 6, 7, 8]).expect("room");
        let (made, bytes) = (device.buffers_made(), device.allocated_bytes());
        for len in [3, 8, 0, 1] {
            device.resize(&mut buffer, "kept", len).expect("has room");
            assert_eq!(buffer.len(), len);
        }
        assert_eq!((device.buffers_made(), device.allocated_bytes()), (made, bytes));
        device.resize(&mut buffer, "kept", 9).expect("room");
        assert_eq!(device.buffers_made(), made + 1);
        assert_eq!(device.read(&buffer).expect("read"), [0; 9]);
    }
}
