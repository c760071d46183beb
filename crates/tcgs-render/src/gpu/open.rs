//! Opening a device: the adapter of choice, with settings, and the subgroups verified on it.

use std::sync::Arc;

use super::{
    AdapterChoice, Device, DeviceSettings, GpuError, Profile, Subgroups, adapter, kernel_source, twin,
};

/// Workgroups that verify subgroups.
const PROBES: u32 = 64;

impl Device {
    /// Opens the adapter of choice with all the limits that it offers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] or [`GpuError::Open`].
    pub fn new(choice: &AdapterChoice) -> Result<Arc<Self>, GpuError> {
        Self::with_settings(choice, &DeviceSettings::default())
    }

    /// As [`Device::new`], with `settings` in place of the adapter's defaults.
    ///
    /// # Errors
    /// As [`Device::new`]; faults of the device while its subgroups are verified.
    pub fn with_settings(choice: &AdapterChoice, settings: &DeviceSettings) -> Result<Arc<Self>, GpuError> {
        let adapter = adapter::choose(choice)?;
        let report = settings.apply(adapter::describe(&adapter));
        let max_wait = settings.max_wait(&report);
        let mut device = pollster::block_on(Self::open(&adapter, report, max_wait))?;
        let stated = settings.subgroups.unwrap_or_else(|| Subgroups::stated_by(device.adapter()));
        device.subgroups = verified(stated, &device)?;
        device.profile = settings.profile.then(Profile::default);
        tracing::debug!(variant = ?device.variant(), subgroups = ?device.subgroups, "kernels chosen");
        Ok(Arc::new(device))
    }
}

/// `stated` if workgroups behave as it says, else [`Subgroups::Unused`]. Equal sizes need no trial.
fn verified(stated: Subgroups, device: &Device) -> Result<Subgroups, GpuError> {
    let Subgroups::AtLeast(lanes) = stated else { return Ok(stated) };
    let kernel = device.kernel(kernel_source!("subgroup_probe"), &[("LANES", lanes)])?;
    let found = device.buffer::<[u32; 4]>("subgroup probe", (PROBES * lanes) as usize)?;
    let mut recorder = device.recorder("subgroup probe");
    recorder.dispatch(&kernel, &[&found], PROBES);
    recorder.submit()?;
    if device.read(&found)? == twin::subgroup_probe(lanes, PROBES) {
        return Ok(stated);
    }
    tracing::warn!(lanes, "subgroups differ from what the adapter states; using kernels without subgroups");
    Ok(Subgroups::Unused)
}
