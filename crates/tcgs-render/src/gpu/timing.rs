//! Times of single dispatches, measured on the device.

use std::time::Duration;

use super::{Buffer, Device, GpuError};

/// Dispatches that one recording can time; later ones are not timed.
const MAX_TIMED_DISPATCHES: u32 = 1024;

/// How long one dispatch took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KernelTime {
    /// The kernel's name.
    pub name: &'static str,
    /// On the device, without waiting in the queue.
    pub time: Duration,
}

#[derive(Debug)]
pub(super) struct Timing {
    queries: wgpu::QuerySet,
    names: Vec<&'static str>,
}

impl Timing {
    pub(super) fn new(device: &Device) -> Self {
        let queries = device.inner.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("dispatch times"),
            ty: wgpu::QueryType::Timestamp,
            count: 2 * MAX_TIMED_DISPATCHES,
        });
        Self { queries, names: Vec::new() }
    }

    pub(super) fn next(&mut self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let first = 2 * u32::try_from(self.names.len()).ok().filter(|taken| *taken < MAX_TIMED_DISPATCHES)?;
        self.names.push(name);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        })
    }

    pub(super) fn resolve(
        &self,
        device: &Device,
        encoder: &mut wgpu::CommandEncoder,
    ) -> Result<Buffer<u64>, GpuError> {
        let ticks = 2 * self.names.len();
        let target = device.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some("resolved dispatch times"),
            size: (ticks.max(1) * 8) as u64,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let buffer = device.buffer("dispatch times", ticks)?;
        if ticks > 0 {
            encoder.resolve_query_set(&self.queries, 0..ticks as u32, &target, 0);
            encoder.copy_buffer_to_buffer(&target, 0, buffer.raw(), 0, (ticks * 8) as u64);
        }
        Ok(buffer)
    }

    pub(super) fn read(self, device: &Device, ticks: &Buffer<u64>) -> Result<Vec<KernelTime>, GpuError> {
        let period = f64::from(device.queue.get_timestamp_period()) * 1e-9;
        let ticks = device.read(ticks)?;
        let time = |pair: &[u64]| Duration::from_secs_f64(pair[1].saturating_sub(pair[0]) as f64 * period);
        Ok(self
            .names
            .iter()
            .zip(ticks.chunks_exact(2))
            .map(|(name, pair)| KernelTime { name, time: time(pair) })
            .collect())
    }
}
