//! One open device per test process, and the adapter that it and child processes use.

use std::{
    process::Command,
    sync::{Arc, OnceLock},
};

use tcgs_render::gpu::{AdapterChoice, Device, DeviceSettings, KernelVariant};

/// The adapter of `TCGS_ADAPTER`, by default lavapipe.
pub fn choice() -> AdapterChoice {
    std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
        Ok(choice) => choice,
        Err(never) => match never {},
    })
}

/// The device of [`choice`].
pub fn gpu() -> Arc<Device> {
    static DEVICE: OnceLock<Arc<Device>> = OnceLock::new();
    Arc::clone(DEVICE.get_or_init(|| {
        Device::new(&choice()).expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
    }))
}

/// A separate device on the same adapter.
pub fn gpu_with(settings: DeviceSettings) -> Arc<Device> {
    Device::with_settings(&choice(), &settings).expect("an adapter")
}

/// The devices of both variants of kernels.
pub fn variants() -> [Arc<Device>; 2] {
    static DEVICES: OnceLock<[Arc<Device>; 2]> = OnceLock::new();
    let make = |variant| gpu_with(DeviceSettings { variant: Some(variant), ..DeviceSettings::default() });
    DEVICES.get_or_init(|| [KernelVariant::Software, KernelVariant::Hardware].map(make)).clone()
}

/// Whether this process has a software adapter whose subgroups are twice as wide as usual. If not, the test of that name is run in
/// another process that has. The driver reads the width once a process.
pub fn has_wide_subgroups(test: &str) -> bool {
    const WIDTH: &str = "LP_NATIVE_VECTOR_WIDTH";
    if std::env::var_os(WIDTH).is_some() {
        assert_eq!(gpu().adapter().subgroup_sizes, [16, 16]);
        return true;
    }
    if !gpu().adapter().name.contains("llvmpipe") {
        println!("only lavapipe's subgroups can be made wider");
        return false;
    }
    let program = std::env::current_exe().expect("this program");
    let status = Command::new(program).args([test, "--exact"]).env(WIDTH, "512").status().expect("started");
    assert!(status.success(), "{test} with wide subgroups");
    false
}
