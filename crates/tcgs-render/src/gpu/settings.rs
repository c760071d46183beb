//! Settings of a device, and their defaults.

use std::time::Duration;

use super::{AdapterReport, KernelVariant, Subgroups};

/// Longest wait for a GPU. The host waits for about a second of training steps or for a view, and drivers with a watchdog reset
/// the GPU after 2 to 10 s.
const HARDWARE_MAX_WAIT: Duration = Duration::from_secs(60);

/// Longest wait for a software adapter, which does not hang but may be slow: a large view, the first run of all kernels, other
/// programs.
const SOFTWARE_MAX_WAIT: Duration = Duration::from_secs(1800);

/// Settings of a device; `None` is the adapter's default. By default there is no profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DeviceSettings {
    /// How kernels divide their work.
    pub variant: Option<KernelVariant>,
    /// What kernels rely on of subgroups.
    pub subgroups: Option<Subgroups>,
    /// How long the device may take before it counts as hung.
    pub max_wait: Option<Duration>,
    /// Largest buffer in bytes, if less than the adapter's.
    pub max_binding_bytes: Option<u64>,
    /// Whether times are kept in [`Device::profile`](super::Device::profile).
    pub profile: bool,
}

impl DeviceSettings {
    /// The adapter as kernels see it.
    pub(super) fn apply(&self, mut adapter: AdapterReport) -> AdapterReport {
        adapter.variant = self.variant.unwrap_or(adapter.variant);
        let max = self.max_binding_bytes.unwrap_or(u64::MAX);
        adapter.max_binding_bytes = adapter.max_binding_bytes.min(max);
        adapter
    }

    pub(super) fn max_wait(&self, adapter: &AdapterReport) -> Duration {
        let usual = if adapter.is_software() { SOFTWARE_MAX_WAIT } else { HARDWARE_MAX_WAIT };
        self.max_wait.unwrap_or(usual)
    }
}
