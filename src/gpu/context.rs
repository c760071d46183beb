//! An open device with its queue, its kernels and its memory of being lost.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use super::{
    AdapterChoice, AdapterReport, Buffer, GpuError, Kernel, KernelSource, Recorder, adapter, ledger::Ledger,
};

/// Largest workgroup-per-dispatch count that a dimension takes everywhere.
pub(super) const MAX_GROUPS_PER_DIMENSION: u32 = 65_535;

/// What happened to the device since it was opened.
#[derive(Debug, Default)]
pub(super) struct Faults {
    lost: Mutex<Option<String>>,
    rejected: Mutex<Option<String>>,
}

/// An open device. Cheap to share by `Arc`; safe to use from several threads.
#[derive(Debug)]
pub struct Context {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    report: AdapterReport,
    faults: Arc<Faults>,
    kernels: Mutex<HashMap<String, Arc<Kernel>>>,
    pub(super) ledger: Arc<Ledger>,
}

impl Context {
    /// Opens the adapter of choice with all the limits that it offers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn new(choice: &AdapterChoice) -> Result<Arc<Self>, GpuError> {
        let adapter = adapter::choose(choice)?;
        let report = adapter::describe(&adapter);
        let wanted = wgpu::Features::SUBGROUP | wgpu::Features::TIMESTAMP_QUERY;
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("tcgs"),
            required_features: adapter.features() & wanted,
            required_limits: adapter.limits(),
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|fault| GpuError::Open { adapter: report.name.clone(), fault: fault.to_string() })?;
        let faults = Arc::new(Faults::default());
        let on_lost = Arc::clone(&faults);
        device.set_device_lost_callback(move |reason, message| {
            *on_lost.lost.lock().unwrap_or_else(PoisonError::into_inner) =
                Some(format!("{reason:?}: {message}"));
        });
        let on_error = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
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
        Ok(Arc::new(Self {
            device,
            queue,
            report,
            faults,
            kernels: Mutex::new(HashMap::new()),
            ledger: Arc::new(Ledger::new()),
        }))
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

    /// The size of every subgroup, if subgroup operations may be used and the size is the same for all kernels.
    #[must_use]
    pub fn subgroup_size(&self) -> Option<u32> {
        let [smallest, largest] = self.report.subgroup_sizes;
        (self.report.subgroups && smallest == largest && (4..=64).contains(&smallest)).then_some(smallest)
    }

    /// Whether kernels run on the CPU: few lanes, and a price for each dispatch and barrier.
    #[must_use]
    pub fn is_software(&self) -> bool {
        self.report.is_software()
    }

    /// Bytes in live buffers of this context, those of transfers under way among them.
    #[must_use]
    pub fn allocated_bytes(&self) -> u64 {
        self.ledger.used()
    }

    /// The most that [`Context::allocated_bytes`] ever was.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.ledger.peak()
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
    /// [`GpuError::DeviceLost`] or [`GpuError::Rejected`] with the first fault since the device was opened.
    pub fn check(&self) -> Result<(), GpuError> {
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
        if let Some(kernel) = kernels.get(&key) {
            return Ok(Arc::clone(kernel));
        }
        let kernel = Arc::new(Kernel::compile(self, source, defs)?);
        kernels.insert(key, Arc::clone(&kernel));
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

    /// Waits until everything submitted so far is done.
    ///
    /// # Errors
    /// As [`Context::check`].
    pub fn wait(&self) -> Result<(), GpuError> {
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|fault| GpuError::DeviceLost(fault.to_string()))?;
        self.check()
    }

    /// Destroys the device, as a driver reset would; for tests of the recovery.
    pub fn destroy(&self) {
        self.device.destroy();
    }

    /// Reads a whole buffer back. Waits for the device.
    ///
    /// # Errors
    /// As [`Context::read_range`].
    pub fn read<T: bytemuck::Pod>(&self, buffer: &Buffer<T>) -> Result<Vec<T>, GpuError> {
        self.read_range(buffer, 0, buffer.len())
    }

    /// Reads `count` elements from `start`. Waits for the device.
    ///
    /// # Errors
    /// As [`Context::check`], and [`GpuError::OverBudget`] without room for the transfer.
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
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
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
