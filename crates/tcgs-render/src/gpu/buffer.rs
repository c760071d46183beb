//! Typed device buffers whose bytes are counted while they live.

use std::{marker::PhantomData, num::NonZeroU64, sync::Arc};

use super::{
    Device, GpuError,
    bind_groups::{BoundPart, Identity},
    constants::ConstantPart,
    ledger::Reservation,
};

/// A device buffer without its element type, or a part of one.
#[derive(Debug)]
pub struct RawBuffer {
    pub(super) inner: wgpu::Buffer,
    /// Where the part begins, and its bytes; none for the whole buffer.
    part: Option<(u64, NonZeroU64)>,
    identity: Arc<Identity>,
    // Ends with the handle. The driver frees the memory once no recorded command uses it; destroying it explicitly would break
    // those commands.
    _reservation: Option<Reservation>,
}

impl RawBuffer {
    pub(super) fn new(
        device: &Device,
        label: &str,
        size: u64,
        usage: wgpu::BufferUsages,
    ) -> Result<Self, GpuError> {
        let reservation = device.ledger.reserve(label, size)?;
        let descriptor =
            wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        Ok(Self {
            inner: device.inner.create_buffer(&descriptor),
            part: None,
            identity: Arc::new(Identity::new(&device.bind_groups)),
            _reservation: Some(reservation),
        })
    }

    /// As a kernel binds it.
    pub(super) fn bound(&self) -> BoundPart<'_> {
        let (start, size) = self.part.map_or((0, 0), |(start, size)| (start, size.get()));
        let resource = match self.part {
            None => self.inner.as_entire_binding(),
            Some((offset, size)) => wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer: &self.inner,
                offset,
                size: Some(size),
            }),
        };
        BoundPart { key: (self.identity.id, start, size), resource, identity: &self.identity }
    }
}

impl From<ConstantPart> for RawBuffer {
    fn from(constant: ConstantPart) -> Self {
        let ConstantPart { buffer, start, size, identity } = constant;
        let part = NonZeroU64::new(size).map(|size| (start, size));
        Self { inner: buffer, part, identity, _reservation: None }
    }
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
    pub(super) fn with_len(&self, len: usize) -> Option<Self> {
        let has_room = buffer_bytes::<T>(len) <= self.raw().size();
        has_room.then(|| Self { inner: Arc::clone(&self.inner), len, kind: PhantomData })
    }

    /// `len` elements in a buffer that something else keeps.
    pub(super) fn from_raw(inner: RawBuffer, len: usize) -> Self {
        Self { inner: Arc::new(inner), len, kind: PhantomData }
    }

    /// The whole buffer, for copies; constants are not copied.
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

impl Device {
    /// A new buffer of `len` zeroed elements.
    ///
    /// # Errors
    /// [`GpuError::BufferTooLarge`] if the adapter cannot bind it, [`GpuError::OverBudget`] beyond the device's budget, [`GpuError::DeviceLost`].
    pub fn buffer<T: bytemuck::Pod>(&self, label: &str, len: usize) -> Result<Buffer<T>, GpuError> {
        self.check()?;
        let bytes = buffer_bytes::<T>(len);
        let limit = self.adapter().max_binding_bytes.min(self.adapter().max_buffer_bytes);
        if bytes > limit {
            return Err(GpuError::BufferTooLarge { label: label.to_owned(), bytes, limit });
        }
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST
            | wgpu::BufferUsages::UNIFORM;
        let inner = Arc::new(RawBuffer::new(self, label, bytes, usage)?);
        Ok(Buffer { inner, len, kind: PhantomData })
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

    /// Overwrites a buffer from its start; takes effect before the next submission.
    pub fn write<T: bytemuck::Pod>(&self, buffer: &Buffer<T>, values: &[T]) {
        self.write_at(buffer, 0, values);
    }

    /// Overwrites a buffer from element `start`; takes effect before the next submission.
    pub fn write_at<T: bytemuck::Pod>(&self, buffer: &Buffer<T>, start: usize, values: &[T]) {
        if !values.is_empty() {
            self.queue.write_buffer(
                buffer.raw(),
                (start * size_of::<T>()) as u64,
                bytemuck::cast_slice(values),
            );
        }
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
}
