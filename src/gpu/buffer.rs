//! Typed device buffers whose bytes are counted while they live.

use std::{marker::PhantomData, sync::Arc};

use super::{Context, GpuError, ledger::Reservation};

/// A device buffer without its element type.
#[derive(Debug)]
pub struct RawBuffer {
    pub(super) inner: wgpu::Buffer,
    // Ends with the handle. The driver frees the memory once no recorded command uses it; destroying it there and then would
    // spoil those commands.
    _reservation: Reservation,
}

/// A device buffer of `len` elements; usable as storage, for indirect dispatch, and as source and target of copies.
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

impl Context {
    /// A new buffer of `len` zeroed elements.
    ///
    /// # Errors
    /// [`GpuError::BufferTooLarge`] if the adapter cannot bind it, [`GpuError::OverBudget`] if the context may not take
    /// that much more, [`GpuError::DeviceLost`].
    pub fn buffer<T: bytemuck::Pod>(&self, label: &str, len: usize) -> Result<Buffer<T>, GpuError> {
        self.check()?;
        let bytes = buffer_bytes::<T>(len);
        let limit = self.adapter().max_binding_bytes.min(self.adapter().max_buffer_bytes);
        if bytes > limit {
            return Err(GpuError::BufferTooLarge { label: label.to_owned(), bytes, limit });
        }
        let reservation = self.ledger.reserve(label, bytes)?;
        let inner = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST
                | wgpu::BufferUsages::INDIRECT
                | wgpu::BufferUsages::UNIFORM,
            mapped_at_creation: false,
        });
        let inner = Arc::new(RawBuffer { inner, _reservation: reservation });
        Ok(Buffer { inner, len, kind: PhantomData })
    }

    /// A new buffer that holds `values`.
    ///
    /// # Errors
    /// As [`Context::buffer`].
    pub fn upload<T: bytemuck::Pod>(&self, label: &str, values: &[T]) -> Result<Buffer<T>, GpuError> {
        let buffer = self.buffer(label, values.len())?;
        self.write(&buffer, values);
        Ok(buffer)
    }
}
