//! An open device: its queue, its compiled kernels, and the first fault since it was opened.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, OnceLock, PoisonError, RwLock},
    thread,
    time::Duration,
};

use naga_oil::compose::Composer;

use super::{
    AdapterReport, GpuError, Kernel, KernelSource, KernelVariant, Profile, Subgroups,
    bind_groups::BindGroups, constants::Constants, kernel, ledger::Ledger,
};

/// The first fault of each kind since the device was opened.
#[derive(Debug, Default)]
struct Faults {
    lost: Mutex<Option<String>>,
    rejected: Mutex<Option<String>>,
    /// How long the host waited without an answer.
    hung: OnceLock<Duration>,
}

/// The kernels compiled so far, by name and definitions.
#[derive(Debug)]
struct Kernels {
    composer: Composer,
    compiled: HashMap<String, Arc<Kernel>>,
}

/// An open device. Cheap to share by `Arc`; safe to use from several threads.
#[derive(Debug)]
pub struct Device {
    pub(super) inner: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    report: AdapterReport,
    pub(super) subgroups: Subgroups,
    max_wait: RwLock<Duration>,
    faults: Arc<Faults>,
    kernels: Mutex<Kernels>,
    pub(super) ledger: Arc<Ledger>,
    pub(super) bind_groups: Arc<BindGroups>,
    pub(super) constants: Constants,
    pub(super) profile: Option<Profile>,
}

impl Device {
    /// Opens `adapter`, which kernels see as `report`, with all the limits that it offers and without subgroups.
    ///
    /// # Errors
    /// [`GpuError::Open`].
    pub(super) async fn open(
        adapter: &wgpu::Adapter,
        report: AdapterReport,
        max_wait: Duration,
    ) -> Result<Self, GpuError> {
        let wanted = wgpu::Features::SUBGROUP | wgpu::Features::TIMESTAMP_QUERY;
        let request = adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("tcgs"),
            required_features: adapter.features() & wanted,
            required_limits: adapter.limits(),
            ..wgpu::DeviceDescriptor::default()
        });
        let refused = |error: wgpu::RequestDeviceError| GpuError::Open {
            adapter: report.name.clone(),
            error: error.to_string(),
        };
        let (inner, queue) = request.await.map_err(refused)?;
        let (ledger, bind_groups) = (Arc::new(Ledger::new()), Arc::default());
        let constants = Constants::new(&inner, &ledger, &bind_groups);
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
        Ok(Self {
            inner,
            queue,
            subgroups: Subgroups::Unused,
            max_wait: RwLock::new(max_wait),
            report,
            faults,
            kernels: Mutex::new(Kernels { composer: kernel::composer()?, compiled: HashMap::new() }),
            constants,
            ledger,
            bind_groups,
            profile: None,
        })
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

    /// Subgroups as kernels use them.
    #[must_use]
    pub fn subgroups(&self) -> Subgroups {
        self.subgroups
    }

    /// How kernels divide their work.
    #[must_use]
    pub fn variant(&self) -> KernelVariant {
        self.report.variant
    }

    /// Bytes in live buffers, transfers in flight included.
    #[must_use]
    pub fn allocated_bytes(&self) -> u64 {
        self.ledger.used()
    }

    /// Peak of [`Device::allocated_bytes`].
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.ledger.peak()
    }

    /// Buffers made so far, transfers included.
    #[must_use]
    pub fn buffers_made(&self) -> u64 {
        self.ledger.made()
    }

    /// Limit on [`Device::allocated_bytes`]; `u64::MAX` until one is set.
    #[must_use]
    pub fn budget_bytes(&self) -> u64 {
        self.ledger.budget()
    }

    /// From now on, refuses buffers that would take [`Device::allocated_bytes`] beyond `bytes`.
    pub fn set_budget_bytes(&self, bytes: u64) {
        self.ledger.set_budget(bytes);
    }

    /// Where time goes, if the device was opened with a profile.
    #[must_use]
    pub fn profile(&self) -> Option<&Profile> {
        self.profile.as_ref()
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
            Some(error) => Err(GpuError::Rejected(error.clone())),
            None => Ok(()),
        }
    }

    /// The compiled kernel of `source` with the given shader definitions; compiled once per distinct definitions.
    ///
    /// # Errors
    /// [`GpuError::Kernel`] if it does not compose or validate.
    pub fn kernel(&self, source: KernelSource, defs: &[(&str, u32)]) -> Result<Arc<Kernel>, GpuError> {
        debug_assert!(
            kernel::table::knows(source.name, defs),
            "{} has no such definitions: {defs:?}",
            source.name
        );
        let mut key = source.name.to_owned();
        for (name, value) in defs {
            key.push_str(&format!(";{name}={value}"));
        }
        let mut kernels = self.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kernel) = kernels.compiled.get(&key) {
            return Ok(Arc::clone(kernel));
        }
        let defs = [defs, self.variant().defs()].concat();
        let id = self.bind_groups.next_id();
        let kernel =
            Arc::new(Kernel::compile(&self.inner, &mut kernels.composer, source, &defs, self.variant(), id)?);
        kernels.compiled.insert(key, Arc::clone(&kernel));
        Ok(kernel)
    }

    /// Waits until everything submitted so far is done, at most the time of [`Device::set_max_wait`]. A device that takes longer
    /// counts as hung from then on.
    ///
    /// # Errors
    /// As [`Device::check`].
    pub fn wait(&self) -> Result<(), GpuError> {
        self.wait_until(None)
    }

    /// As [`Device::wait`], for a submission and those before it.
    pub(super) fn wait_for(&self, submission: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        self.wait_until(Some(submission))
    }

    fn wait_until(&self, submission: Option<wgpu::SubmissionIndex>) -> Result<(), GpuError> {
        self.check()?;
        let waited = *self.max_wait.read().unwrap_or_else(PoisonError::into_inner);
        let answer = match waited {
            Duration::ZERO => Err(wgpu::PollError::Timeout),
            _ => {
                self.inner.poll(wgpu::PollType::Wait { submission_index: submission, timeout: Some(waited) })
            }
        };
        match answer {
            Ok(_) => {}
            Err(wgpu::PollError::Timeout) => {
                tracing::error!(?waited, "the device does not answer");
                // An earlier wait that timed out has already set it.
                let _ = self.faults.hung.set(waited);
            }
            // A lost device may have taken a submission without running it; it stays lost.
            Err(error) => {
                let mut lost = self.faults.lost.lock().unwrap_or_else(PoisonError::into_inner);
                lost.get_or_insert_with(|| error.to_string());
            }
        }
        self.check()
    }

    /// Sets how long a wait may take before the device counts as hung; with zero, it does at the next wait.
    pub fn set_max_wait(&self, limit: Duration) {
        *self.max_wait.write().unwrap_or_else(PoisonError::into_inner) = limit;
    }

    /// Destroys the device as a driver reset would, to test recovery.
    pub fn destroy(&self) {
        self.inner.destroy();
    }
}

impl Drop for Device {
    /// wgpu waits without a limit when it drops a queue. A hung one is dropped in its own thread.
    fn drop(&mut self) {
        if self.faults.hung.get().is_some() {
            let hung = (self.queue.clone(), self.inner.clone());
            thread::spawn(move || drop(hung));
        }
    }
}
