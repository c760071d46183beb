//! An open device with its queue, its kernels and its memory of being lost.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, OnceLock, PoisonError, RwLock},
    thread,
    time::Duration,
};

use naga_oil::compose::Composer;

use super::{
    AdapterChoice, AdapterReport, Buffer, DeviceSettings, GpuError, Kernel, KernelSource, KernelVariant,
    Recorder, Subgroups, adapter, kernel, ledger::Ledger,
};

/// Largest workgroup-per-dispatch count that a dimension takes everywhere.
pub(super) const MAX_GROUPS_PER_DIMENSION: u32 = 65_535;

/// What happened to the device since it was opened.
#[derive(Debug, Default)]
pub(super) struct Faults {
    lost: Mutex<Option<String>>,
    rejected: Mutex<Option<String>>,
    /// How long it was waited for in vain.
    hung: OnceLock<Duration>,
}

/// The kernels made so far, by name and definitions, and what makes the next one.
#[derive(Debug)]
struct Kernels {
    composer: Composer,
    made: HashMap<String, Arc<Kernel>>,
}

/// An open device. Cheap to share by `Arc`; safe to use from several threads.
#[derive(Debug)]
pub struct Device {
    pub(super) inner: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    report: AdapterReport,
    subgroups: Subgroups,
    max_wait: RwLock<Duration>,
    faults: Arc<Faults>,
    kernels: Mutex<Kernels>,
    pub(super) ledger: Arc<Ledger>,
}

impl Device {
    /// Opens the adapter of choice with all the limits that it offers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn new(choice: &AdapterChoice) -> Result<Arc<Self>, GpuError> {
        Self::with_settings(choice, &DeviceSettings::default())
    }

    /// As [`Device::new`], with what `settings` says in place of what suits the adapter.
    ///
    /// # Errors
    /// As [`Device::new`]; faults of the device where its subgroups have to be tried out.
    pub fn with_settings(choice: &AdapterChoice, settings: &DeviceSettings) -> Result<Arc<Self>, GpuError> {
        let adapter = adapter::choose(choice)?;
        let report = settings.apply(adapter::describe(&adapter));
        let wanted = wgpu::Features::SUBGROUP | wgpu::Features::TIMESTAMP_QUERY;
        let (inner, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("tcgs"),
            required_features: adapter.features() & wanted,
            required_limits: adapter.limits(),
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|fault| GpuError::Open { adapter: report.name.clone(), fault: fault.to_string() })?;
        let faults = Arc::new(Faults::default());
        let on_lost = Arc::clone(&faults);
        inner.set_device_lost_callback(move |reason, message| {
            *on_lost.lost.lock().unwrap_or_else(PoisonError::into_inner) =
                Some(format!("{reason:?}: {message}"));
        });
        let on_error = Arc::clone(&faults);
        inner.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            tracing::error!(%error, "device error");
            let mut first = on_error.rejected.lock().unwrap_or_else(PoisonError::into_inner);
            first.get_or_insert_with(|| error.to_string());
        }));
        tracing::info!(
            adapter = report.name,
            driver = report.driver,
            backend = report.backend,
            "device opened"
        );
        let mut device = Self {
            inner,
            queue,
            subgroups: Subgroups::Unused,
            max_wait: RwLock::new(settings.max_wait(&report)),
            report,
            faults,
            kernels: Mutex::new(Kernels { composer: kernel::composer()?, made: HashMap::new() }),
            ledger: Arc::new(Ledger::new()),
        };
        let wanted = settings.subgroups.unwrap_or_else(|| Subgroups::of(&device.report));
        device.subgroups = wanted.tried(&device)?;
        tracing::debug!(variant = ?device.report.variant, subgroups = ?device.subgroups, "kernels chosen");
        Ok(Arc::new(device))
    }

    /// The adapter and what it offers.
    #[must_use]
    pub fn adapter(&self) -> &AdapterReport {
        &self.report
    }

    /// Adapter, driver and backend in one line, as stated in metrics.
    #[must_use]
    pub fn adapter_line(&self) -> String {
        format!("{} ({}, {})", self.report.name, self.report.driver, self.report.backend)
    }

    /// What kernels may rely on of subgroups.
    #[must_use]
    pub fn subgroups(&self) -> Subgroups {
        self.subgroups
    }

    /// How kernels divide their work.
    #[must_use]
    pub fn variant(&self) -> KernelVariant {
        self.report.variant
    }

    /// Bytes in live buffers of this device, those of transfers under way among them.
    #[must_use]
    pub fn allocated_bytes(&self) -> u64 {
        self.ledger.used()
    }

    /// The most that [`Device::allocated_bytes`] ever was.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.ledger.peak()
    }

    /// Buffers made so far, those of transfers among them.
    #[must_use]
    pub fn buffers_made(&self) -> u64 {
        self.ledger.made()
    }

    /// Bytes that live buffers may take together; without a bound until one is set.
    #[must_use]
    pub fn budget_bytes(&self) -> u64 {
        self.ledger.budget()
    }

    /// Refuses buffers from now on that would take the sum of all beyond `bytes`.
    pub fn set_budget_bytes(&self, bytes: u64) {
        self.ledger.set_budget(bytes);
    }

    /// Whether the device still works.
    ///
    /// # Errors
    /// [`GpuError::Timeout`], [`GpuError::DeviceLost`] or [`GpuError::Rejected`] with the first fault since the device was opened.
    pub fn check(&self) -> Result<(), GpuError> {
        if let Some(waited) = self.faults.hung.get() {
            return Err(GpuError::Timeout { waited: *waited });
        }
        if let Some(reason) = &*self.faults.lost.lock().unwrap_or_else(PoisonError::into_inner) {
            return Err(GpuError::DeviceLost(reason.clone()));
        }
        match &*self.faults.rejected.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(fault) => Err(GpuError::Rejected(fault.clone())),
            None => Ok(()),
        }
    }

    /// The compiled kernel of `source` with the given shader definitions; compiled once per distinct definitions.
    ///
    /// # Errors
    /// [`GpuError::Kernel`] if it does not compose or validate.
    pub fn kernel(&self, source: KernelSource, defs: &[(&str, u32)]) -> Result<Arc<Kernel>, GpuError> {
        let mut key = source.name.to_owned();
        for (name, value) in defs {
            key.push_str(&format!(";{name}={value}"));
        }
        let mut kernels = self.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kernel) = kernels.made.get(&key) {
            return Ok(Arc::clone(kernel));
        }
        let kernel = Arc::new(Kernel::compile(self, &mut kernels.composer, source, defs)?);
        kernels.made.insert(key, Arc::clone(&kernel));
        Ok(kernel)
    }

    /// Begins recording commands.
    #[must_use]
    pub fn recorder(&self, label: &str) -> Recorder<'_> {
        Recorder::new(self, label)
    }

    /// Begins recording commands whose dispatches are timed on the device; see [`Recorder::submit_timed`].
    #[must_use]
    pub fn timed_recorder(&self, label: &str) -> Recorder<'_> {
        Recorder::timed(self, label)
    }

    /// Waits until everything submitted so far is done, but no longer than the device may take. One that takes longer counts as
    /// hung from then on.
    ///
    /// # Errors
    /// As [`Device::check`].
    pub fn wait(&self) -> Result<(), GpuError> {
        self.check()?;
        let waited = *self.max_wait.read().unwrap_or_else(PoisonError::into_inner);
        let answer = match waited {
            Duration::ZERO => Err(wgpu::PollError::Timeout),
            _ => self.inner.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(waited) }),
        };
        match answer {
            Ok(_) => {}
            Err(wgpu::PollError::Timeout) => {
                tracing::error!(?waited, "the device does not answer");
                // Whoever waited before and in vain has set it.
                let _ = self.faults.hung.set(waited);
            }
            Err(fault) => return Err(GpuError::DeviceLost(fault.to_string())),
        }
        self.check()
    }

    /// From now on the device may take so long before it counts as hung; without any time it hangs at the next wait.
    pub fn set_max_wait(&self, limit: Duration) {
        *self.max_wait.write().unwrap_or_else(PoisonError::into_inner) = limit;
    }

    /// Destroys the device, as a driver reset would; for tests of the recovery.
    pub fn destroy(&self) {
        self.inner.destroy();
    }

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
        self.check()?;
        if count == 0 {
            return Ok(Vec::new());
        }
        let size = size_of::<T>() as u64;
        let bytes = (count as u64 * size).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        let _reservation = self.ledger.reserve("read back", bytes)?;
        let staging = self.inner.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.inner.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer.raw(), start as u64 * size, &staging, 0, bytes);
        self.queue.submit([encoder.finish()]);
        staging.slice(..).map_async(wgpu::MapMode::Read, |_| ());
        self.wait()?;
        let view = staging
            .slice(..)
            .get_mapped_range()
            .map_err(|fault| GpuError::Rejected(format!("mapping for reading: {fault}")))?;
        Ok(bytemuck::pod_collect_to_vec(&view[..count * size_of::<T>()]))
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

impl Drop for Device {
    /// wgpu waits without a limit for a queue that it drops. For one that hangs, a thread of its own does.
    fn drop(&mut self) {
        if self.faults.hung.get().is_some() {
            let hung = (self.queue.clone(), self.inner.clone());
            thread::spawn(move || drop(hung));
        }
    }
}
