//! Devices for the unit tests of this crate and of those that build on it.

use std::sync::Arc;

use super::{AdapterChoice, AdapterReport, Device, DeviceSettings, KernelVariant};

/// A separate device on the adapter of `TCGS_ADAPTER`, by default lavapipe.
pub fn lavapipe() -> Arc<Device> {
    lavapipe_with(&DeviceSettings::default())
}

/// As [`lavapipe`], with settings.
pub fn lavapipe_with(settings: &DeviceSettings) -> Arc<Device> {
    let choice = std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
        Ok(choice) => choice,
        Err(never) => match never {},
    });
    Device::with_settings(&choice, settings)
        .expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
}

/// A software adapter as lavapipe describes itself.
pub fn software_report() -> AdapterReport {
    AdapterReport {
        name: "llvmpipe".to_owned(),
        backend: "vulkan".to_owned(),
        kind: "cpu".to_owned(),
        driver: "Mesa".to_owned(),
        max_buffer_bytes: (2 << 30) - 1,
        max_binding_bytes: 128 << 20,
        max_storage_buffers: 1 << 20,
        max_workgroup_invocations: 1024,
        max_workgroup_bytes: 32 << 10,
        subgroup_sizes: [8, 8],
        subgroups: true,
        timestamps: true,
        usable: true,
        variant: KernelVariant::Software,
    }
}
