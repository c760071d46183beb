//! What of an open device can be set, and what it is by default.

use std::time::Duration;

use super::{AdapterReport, KernelVariant, Subgroups};

/// How long a GPU may take over what it was given at most. The host waits for a second's worth of steps or for a view, and
/// drivers that watch their GPU reset it after 2 to 10 s.
const HARDWARE_MAX_WAIT: Duration = Duration::from_secs(60);

/// The same on a CPU, which does not hang but may be busy: a large view, the first run of all kernels, other programs.
const SOFTWARE_MAX_WAIT: Duration = Duration::from_secs(1800);

/// How a device is opened; whatever is `None` follows from the adapter.
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
}

impl DeviceSettings {
    /// The adapter as kernels are to see it.
    pub(super) fn apply(&self, mut adapter: AdapterReport) -> AdapterReport {
        adapter.variant = self.variant.unwrap_or(adapter.variant);
        let most = self.max_binding_bytes.unwrap_or(u64::MAX);
        adapter.max_binding_bytes = adapter.max_binding_bytes.min(most);
        adapter
    }

    pub(super) fn max_wait(&self, adapter: &AdapterReport) -> Duration {
        let usual = if adapter.is_software() { SOFTWARE_MAX_WAIT } else { HARDWARE_MAX_WAIT };
        self.max_wait.unwrap_or(usual)
    }
}
