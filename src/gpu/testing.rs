//! Devices for this crate's unit tests.

use std::sync::Arc;

use super::{AdapterChoice, Device, DeviceSettings};

/// A separate device on the adapter of `TCGS_ADAPTER`, by default lavapipe.
pub(crate) fn lavapipe() -> Arc<Device> {
    lavapipe_with(&DeviceSettings::default())
}

/// As [`lavapipe`], with settings.
pub(crate) fn lavapipe_with(settings: &DeviceSettings) -> Arc<Device> {
    let choice = std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
        Ok(choice) => choice,
        Err(never) => match never {},
    });
    Device::with_settings(&choice, settings)
        .expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
}
