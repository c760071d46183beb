//! Recording of dispatches and copies into one submission.

use std::{cell::RefCell, sync::Arc, time::Instant};

use super::{
    Buffer, Device, GpuError, Kernel, KernelSource, KernelVariant, RawBuffer,
    constants::RecordedConstants,
    ledger::Reservation,
    profile::RecordingTimes,
    timing::{KernelTime, Timing},
};

/// Largest workgroup count of one dimension that every adapter takes.
const MAX_GROUPS_PER_DIMENSION: u32 = 65_535;

/// Bytes of a write that travels with the constants; larger ones have a staging buffer of their own.
const MAX_SMALL_WRITE: u64 = 1 << 16;

/// A buffer as a kernel binds it; the n-th binding of a dispatch is `@group(0) @binding(n)`.
pub type Binding<'a> = &'a dyn AsRef<RawBuffer>;

/// Records commands; nothing runs until [`Recorder::submit`].
#[derive(Debug)]
pub struct Recorder<'a> {
    device: &'a Device,
    encoder: wgpu::CommandEncoder,
    /// Open while dispatches follow one another: one pass for all of them costs less than one for each.
    open: Option<wgpu::ComputePass<'static>>,
    timing: Option<Timing>,
    /// On a profiled device.
    times: Option<RecordingTimes>,
    /// Staging memory of recorded writes.
    staged: Vec<Reservation>,
    constants: RefCell<RecordedConstants>,
    /// The first fault of recording; submitting reports it.
    error: Option<GpuError>,
}

impl Device {
    fn unprofiled_recorder(&self) -> Recorder<'_> {
        Recorder {
            device: self,
            encoder: self.inner.create_command_encoder(&wgpu::CommandEncoderDescriptor::default()),
            open: None,
            timing: None,
            times: None,
            staged: Vec::new(),
            constants: RefCell::default(),
            error: None,
        }
    }

    /// Begins recording commands.
    #[must_use]
    pub fn recorder(&self, label: &str) -> Recorder<'_> {
        let times = self.profile.as_ref().map(|profile| profile.begin(label));
        let timing = times.as_ref().and_then(|_| self.timing());
        Recorder { timing, times, ..self.unprofiled_recorder() }
    }

    /// Begins recording commands whose dispatches are timed on the device; see [`Recorder::submit_timed`].
    #[must_use]
    pub fn timed_recorder(&self, label: &str) -> Recorder<'_> {
        Recorder { timing: self.timing(), ..self.recorder(label) }
    }

    fn timing(&self) -> Option<Timing> {
        self.adapter().timestamps.then(|| Timing::new(self))
    }
}

impl<'d> Recorder<'d> {
    /// Names the stage that what follows belongs to in [`Device::profile`].
    pub fn stage(&mut self, name: &'static str) {
        if let Some(times) = &mut self.times {
            times.stage(name);
        }
    }

    /// How kernels divide their work on the recorder's device.
    #[must_use]
    pub fn variant(&self) -> KernelVariant {
        self.device.variant()
    }

    /// The compiled kernel of a source on the recorder's device: [`Device::kernel`].
    ///
    /// # Errors
    /// As [`Device::kernel`].
    pub fn kernel(&self, source: KernelSource, defs: &[(&str, u32)]) -> Result<Arc<Kernel>, GpuError> {
        self.device.kernel(source, defs)
    }

    /// Runs `kernel` over `groups` workgroups. Counts beyond the limit of one dimension are spread over two: kernels
    /// compute their linear workgroup index as `group.x + group.y * 65535` and check it against their bound.
    pub fn dispatch(&mut self, kernel: &Kernel, bindings: &[Binding<'_>], groups: u32) {
        if groups == 0 {
            return;
        }
        if let Some(times) = &mut self.times {
            times.dispatch();
        }
        let (x, y) = dispatch_size(groups);
        let group = self.bind(kernel, bindings);
        let pass = self.pass(kernel);
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(x, y, 1);
    }

    /// Copies whole elements from one buffer to another.
    pub fn copy<T: bytemuck::Pod>(
        &mut self,
        from: &Buffer<T>,
        from_index: usize,
        to: &Buffer<T>,
        to_index: usize,
        count: usize,
    ) {
        let size = size_of::<T>() as u64;
        if count > 0 {
            self.outside().copy_buffer_to_buffer(
                from.raw(),
                from_index as u64 * size,
                to.raw(),
                to_index as u64 * size,
                count as u64 * size,
            );
        }
    }

    /// Overwrites a buffer from its start, in order with the recorded commands; [`Device::write`] takes effect before them.
    pub fn write<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, values: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        if bytes.is_empty() {
            return;
        }
        if bytes.len() as u64 <= MAX_SMALL_WRITE {
            self.write_small(buffer, bytes);
            return;
        }
        let size = (bytes.len() as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        match self.device.ledger.reserve("recorded write", size) {
            Ok(reservation) => self.staged.push(reservation),
            Err(error) => {
                self.error.get_or_insert(error);
                return;
            }
        }
        let staging = self.device.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some("recorded write"),
            size,
            // Without MAP_WRITE, wgpu would map a staging buffer of its own and copy it into this one.
            usage: wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::MAP_WRITE,
            mapped_at_creation: true,
        });
        match staging.slice(..).get_mapped_range_mut() {
            Ok(mut view) => view.slice(..bytes.len()).copy_from_slice(bytes),
            // A lost device cannot map; submitting reports it.
            Err(_) => return,
        }
        staging.unmap();
        self.outside().copy_buffer_to_buffer(&staging, 0, buffer.raw(), 0, staging.size());
    }

    /// A write that travels with the constants.
    fn write_small<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, bytes: &[u8]) {
        let size = (bytes.len() as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        match self.constants.get_mut().add(&self.device.constants, bytes) {
            Ok(Some(part)) => {
                self.outside().copy_buffer_to_buffer(&part.buffer, part.start, buffer.raw(), 0, size);
            }
            Ok(None) => {}
            Err(error) => {
                self.error.get_or_insert(error);
            }
        }
    }

    /// Constants for dispatches of this recording, and of no other.
    ///
    /// # Errors
    /// As [`Device::buffer`].
    pub fn uniform<T: bytemuck::Pod>(&self, values: &[T]) -> Result<Buffer<T>, GpuError> {
        match self.constants.borrow_mut().add(&self.device.constants, bytemuck::cast_slice(values))? {
            Some(part) => Ok(Buffer::from_raw(part.into(), values.len())),
            None => self.device.upload("constants of one dispatch", values),
        }
    }

    /// Zeroes a whole buffer.
    pub fn clear<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>) {
        self.outside().clear_buffer(buffer.raw(), 0, None);
    }

    /// Sends what was recorded so far to the device and goes on, so that no submission takes so long that a driver resets the device.
    /// Does nothing while dispatches are timed.
    ///
    /// # Errors
    /// As [`Recorder::submit`].
    pub fn flush(&mut self) -> Result<(), GpuError> {
        if self.timing.is_some() {
            return Ok(());
        }
        let next = Recorder { times: self.times.take(), ..self.device.unprofiled_recorder() };
        std::mem::replace(self, next).send().map(drop)
    }

    /// Sends what was recorded to the device. A profiled device also waits for it.
    ///
    /// # Errors
    /// As [`Device::check`], and [`GpuError::OverBudget`] if there was no room for a recorded write.
    pub fn submit(self) -> Result<(), GpuError> {
        self.submit_indexed().map(drop)
    }

    /// As [`Recorder::submit`]; the index can be waited for.
    pub(super) fn submit_indexed(self) -> Result<wgpu::SubmissionIndex, GpuError> {
        if self.times.is_some() { self.send_timed().map(|(index, _)| index) } else { self.send() }
    }

    pub(super) fn device(&self) -> &'d Device {
        self.device
    }

    /// Sends what was recorded, waits for it, and returns how long each dispatch took, in order: none if the adapter has no
    /// timestamps or the recorder does not time.
    ///
    /// # Errors
    /// As [`Recorder::submit`].
    pub fn submit_timed(self) -> Result<Vec<KernelTime>, GpuError> {
        self.send_timed().map(|(_, kernels)| kernels)
    }

    fn send_timed(mut self) -> Result<(wgpu::SubmissionIndex, Vec<KernelTime>), GpuError> {
        let device = self.device;
        let mut times = self.times.take();
        if let Some(times) = &mut times {
            times.end();
        }
        let started = Instant::now();
        let timing = self.timing.take();
        let ticks = timing.as_ref().map(|timing| timing.resolve(device, self.outside())).transpose()?;
        let index = self.send()?;
        let sent = Instant::now();
        let kernels = match timing.zip(ticks) {
            Some((timing, ticks)) => timing.read(device, &ticks)?,
            None => device.wait().map(|()| Vec::new())?,
        };
        if let Some((profile, times)) = device.profile.as_ref().zip(times) {
            profile.add(
                times,
                sent - started,
                sent.elapsed(),
                kernels.iter().map(|kernel| (kernel.name, kernel.time)),
            );
        }
        Ok((index, kernels))
    }

    fn send(mut self) -> Result<wgpu::SubmissionIndex, GpuError> {
        self.open = None;
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        self.device.check()?;
        let device = self.device;
        let Self { constants, encoder, .. } = self;
        let index = device.constants.submit(&device.queue, &constants.into_inner(), encoder.finish());
        device.check().map(|()| index)
    }

    /// The encoder with no pass open.
    pub(super) fn outside(&mut self) -> &mut wgpu::CommandEncoder {
        self.open = None;
        &mut self.encoder
    }

    /// The open pass; where dispatches are timed, a new one for each.
    fn pass(&mut self, kernel: &Kernel) -> &mut wgpu::ComputePass<'static> {
        if self.timing.is_some() {
            self.open = None;
        }
        let Self { encoder, open, timing, .. } = self;
        open.get_or_insert_with(|| {
            let label = timing.as_ref().map_or("dispatches", |_| kernel.name);
            let timestamp_writes = timing.as_mut().and_then(|timing| timing.next(kernel.name));
            encoder
                .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(label), timestamp_writes })
                .forget_lifetime()
        })
    }

    fn bind(&self, kernel: &Kernel, bindings: &[Binding<'_>]) -> wgpu::BindGroup {
        let parts: Vec<_> = bindings.iter().map(|buffer| (*buffer).as_ref().bound()).collect();
        self.device.bind_groups.get(&self.device.inner, kernel, &parts)
    }
}

fn dispatch_size(groups: u32) -> (u32, u32) {
    if groups <= MAX_GROUPS_PER_DIMENSION {
        (groups, 1)
    } else {
        (MAX_GROUPS_PER_DIMENSION, groups.div_ceil(MAX_GROUPS_PER_DIMENSION))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::lavapipe;

    #[test]
    fn a_recorded_write_is_staged_once() {
        const LEN: usize = 1 << 18;
        let device = lavapipe();
        let buffer = device.buffer::<u32>("target", LEN).expect("room");
        let allocated = || device.inner.generate_allocator_report().expect("a report").total_allocated_bytes;
        let before = allocated();
        let values: Vec<u32> = (0..LEN as u32).collect();
        let mut recorder = device.recorder("write");
        recorder.write(&buffer, &values);
        let staged = allocated() - before;
        assert!((4 * LEN as u64..6 * LEN as u64).contains(&staged), "{staged} bytes for {}", 4 * LEN);
        recorder.submit().expect("submitted");
        assert!(device.read(&buffer).expect("read") == values);
    }

    #[test]
    fn group_counts_are_spread_over_two_dimensions() {
        for groups in [1, 65_535, 65_536, 200_000, 10_000_000] {
            let (x, y) = dispatch_size(groups);
            assert!(x <= 65_535 && y <= 65_535);
            assert!(u64::from(x) * u64::from(y) >= u64::from(groups));
        }
    }
}
