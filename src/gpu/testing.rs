//! Devices for this crate's unit tests.

use std::sync::Arc;

use super::{AdapterChoice, Device};

/// A separate device on the adapter of `TCGS_ADAPTER`, by default lavapipe.
pub(crate) fn lavapipe() -> Arc<Device> {
    let choice = std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
        Ok(choice) => choice,
        Err(never) => match never {},
    });
    Device::new(&choice).expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
}
