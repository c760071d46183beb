//! Small values that kernels of one recording read: they lie one behind the other in buffers that the device keeps, and one upload a
//! submission brings them all.
//!
//! What always holds: the queue runs uploads and submissions in order, and [`Constants::submit`] lets no other recording's upload
//! between the two. So every recording finds its own values, though all of them use the same buffers.

use std::sync::{Arc, Mutex, PoisonError};

use super::{
    GpuError,
    bind_groups::{BindGroups, Identity},
    ledger::{Ledger, Reservation},
};

/// Bytes of a buffer of constants.
const CHUNK_BYTES: u64 = 1 << 18;

/// Bytes of the constants of the largest recordings, which a device keeps.
pub const CONSTANT_BYTES: u64 = 4 * CHUNK_BYTES;

/// A buffer of constants.
#[derive(Debug)]
struct Chunk {
    buffer: wgpu::Buffer,
    identity: Arc<Identity>,
    _reservation: Reservation,
}

/// The buffers of a device.
#[derive(Debug)]
pub(super) struct Constants {
    device: wgpu::Device,
    ledger: Arc<Ledger>,
    bind_groups: Arc<BindGroups>,
    /// Every constant starts at a multiple of it.
    alignment: u64,
    chunks: Mutex<Vec<Arc<Chunk>>>,
    /// Held from the upload of a recording's constants to its submission.
    submission: Mutex<()>,
}

/// The constants of one recording.
#[derive(Debug, Default)]
pub(super) struct RecordedConstants {
    /// The bytes of each buffer so far.
    chunks: Vec<(Arc<Chunk>, Vec<u8>)>,
}

/// Where a constant is once its recording runs.
#[derive(Debug)]
pub(super) struct ConstantPart {
    pub(super) buffer: wgpu::Buffer,
    pub(super) start: u64,
    /// Not 0.
    pub(super) size: u64,
    pub(super) identity: Arc<Identity>,
}

impl Constants {
    pub(super) fn new(device: &wgpu::Device, ledger: &Arc<Ledger>, bind_groups: &Arc<BindGroups>) -> Self {
        let limits = device.limits();
        let alignment =
            limits.min_uniform_buffer_offset_alignment.max(limits.min_storage_buffer_offset_alignment);
        Self {
            device: device.clone(),
            ledger: Arc::clone(ledger),
            bind_groups: Arc::clone(bind_groups),
            alignment: alignment.into(),
            chunks: Mutex::default(),
            submission: Mutex::default(),
        }
    }

    fn chunk(&self, index: usize) -> Result<Arc<Chunk>, GpuError> {
        let mut chunks = self.chunks.lock().unwrap_or_else(PoisonError::into_inner);
        while chunks.len() <= index {
            let reservation = self.ledger.reserve("constants", CHUNK_BYTES)?;
            let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("constants"),
                size: CHUNK_BYTES,
                usage: wgpu::BufferUsages::UNIFORM
                    | wgpu::BufferUsages::STORAGE
                    | wgpu::BufferUsages::COPY_SRC
                    | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            let identity = Arc::new(Identity::new(&self.bind_groups));
            chunks.push(Arc::new(Chunk { buffer, identity, _reservation: reservation }));
        }
        Ok(Arc::clone(&chunks[index]))
    }

    /// Uploads `recorded` and submits what uses it.
    pub(super) fn submit(
        &self,
        queue: &wgpu::Queue,
        recorded: &RecordedConstants,
        commands: wgpu::CommandBuffer,
    ) -> wgpu::SubmissionIndex {
        let _order = self.submission.lock().unwrap_or_else(PoisonError::into_inner);
        for (chunk, bytes) in &recorded.chunks {
            queue.write_buffer(&chunk.buffer, 0, bytes);
        }
        queue.submit([commands])
    }
}

impl RecordedConstants {
    /// Adds `bytes` and returns the part of a buffer that holds them once the recording runs; none where they are too large.
    pub(super) fn add(
        &mut self,
        constants: &Constants,
        bytes: &[u8],
    ) -> Result<Option<ConstantPart>, GpuError> {
        // As buffers of their own, whole numbers of 16 bytes.
        let size = (bytes.len() as u64).max(1).next_multiple_of(16);
        if size > CHUNK_BYTES {
            return Ok(None);
        }
        let starts_at = |taken: &[u8]| (taken.len() as u64).next_multiple_of(constants.alignment);
        let has_room = self.chunks.last().is_some_and(|(_, taken)| starts_at(taken) + size <= CHUNK_BYTES);
        if !has_room {
            self.chunks.push((constants.chunk(self.chunks.len())?, Vec::new()));
        }
        Ok(self.chunks.last_mut().map(|(chunk, taken)| {
            let start = starts_at(taken);
            taken.resize(start as usize, 0);
            taken.extend_from_slice(bytes);
            taken.resize((start + size) as usize, 0);
            let (buffer, identity) = (chunk.buffer.clone(), Arc::clone(&chunk.identity));
            ConstantPart { buffer, start, size, identity }
        }))
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::testing::lavapipe;

    #[test]
    fn constants_take_no_memory_beyond_the_first_recordings() {
        let device = lavapipe();
        let record = |count: usize| {
            let recorder = device.recorder("constants");
            let made: Vec<_> =
                (0..count).map(|i| recorder.uniform(&[[i as u32; 64]]).expect("room")).collect();
            recorder.submit().expect("submitted");
            made.len()
        };
        record(10);
        let (made, bytes) = (device.buffers_made(), device.allocated_bytes());
        record(500);
        assert_eq!((device.buffers_made(), device.allocated_bytes()), (made, bytes));
        assert_eq!(record(5000), 5000, "more than one buffer of them");
        assert_eq!(device.buffers_made() - made, 4);
    }
}
