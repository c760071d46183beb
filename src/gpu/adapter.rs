//! Which adapter to use, and what each one offers.

use std::{fmt, str::FromStr};

use serde::Serialize;

use super::{GpuError, KernelVariant};

/// Which adapter to open.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum AdapterChoice {
    /// The best there is: discrete before integrated before virtual before software.
    #[default]
    Auto,
    /// Mesa's software Vulkan.
    Lavapipe,
    /// The first whose name contains this, ignoring case.
    Named(String),
}

impl FromStr for AdapterChoice {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "" | "auto" => Self::Auto,
            "lavapipe" | "llvmpipe" => Self::Lavapipe,
            name => Self::Named(name.to_owned()),
        })
    }
}

impl fmt::Display for AdapterChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Lavapipe => f.write_str("lavapipe"),
            Self::Named(name) => f.write_str(name),
        }
    }
}

impl AdapterChoice {
    fn accepts(&self, info: &wgpu::AdapterInfo) -> bool {
        let name = info.name.to_lowercase();
        match self {
            Self::Auto => info.device_type != wgpu::DeviceType::Other,
            Self::Lavapipe => name.contains("llvmpipe"),
            Self::Named(wanted) => name.contains(&wanted.to_lowercase()),
        }
    }
}

/// One adapter with what matters to this program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    /// The adapter's name.
    pub name: String,
    /// Vulkan, Metal, DX12.
    pub backend: String,
    /// Discrete, integrated, virtual or CPU.
    pub kind: String,
    /// Driver and version.
    pub driver: String,
    /// Largest buffer in bytes.
    pub max_buffer_bytes: u64,
    /// Largest storage binding in bytes.
    pub max_binding_bytes: u64,
    /// Storage buffers a kernel may bind.
    pub max_storage_buffers: u32,
    /// Invocations a workgroup may have.
    pub max_workgroup_invocations: u32,
    /// Bytes of workgroup memory.
    pub max_workgroup_bytes: u32,
    /// Smallest and largest subgroup.
    pub subgroup_sizes: [u32; 2],
    /// Whether kernels may use subgroup operations.
    pub subgroups: bool,
    /// Whether passes can be timed on the device.
    pub timestamps: bool,
    /// Whether this program can run on it.
    pub usable: bool,
    /// How kernels divide their work on it.
    #[serde(skip)]
    pub variant: KernelVariant,
}

impl AdapterReport {
    /// Whether kernels run on the CPU.
    #[must_use]
    pub fn is_software(&self) -> bool {
        self.kind == "cpu"
    }

    /// Whether its buffers lie in main memory.
    #[must_use]
    pub fn shares_main_memory(&self) -> bool {
        self.is_software() || self.kind == "integratedgpu"
    }
}

/// Storage buffers that the widest kernel binds.
pub(super) const STORAGE_BUFFERS_NEEDED: u32 = 12;

pub(super) fn describe(adapter: &wgpu::Adapter) -> AdapterReport {
    let info = adapter.get_info();
    let limits = adapter.limits();
    let features = adapter.features();
    let is_software = info.device_type == wgpu::DeviceType::Cpu;
    AdapterReport {
        name: info.name.clone(),
        backend: info.backend.to_string(),
        kind: format!("{:?}", info.device_type).to_lowercase(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        max_buffer_bytes: limits.max_buffer_size,
        max_binding_bytes: limits.max_storage_buffer_binding_size,
        max_storage_buffers: limits.max_storage_buffers_per_shader_stage,
        max_workgroup_invocations: limits.max_compute_invocations_per_workgroup,
        max_workgroup_bytes: limits.max_compute_workgroup_storage_size,
        subgroup_sizes: [info.subgroup_min_size, info.subgroup_max_size],
        subgroups: features.contains(wgpu::Features::SUBGROUP),
        timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
        usable: limits.max_storage_buffers_per_shader_stage >= STORAGE_BUFFERS_NEEDED
            && limits.max_compute_invocations_per_workgroup >= 256,
        variant: if is_software { KernelVariant::Software } else { KernelVariant::Hardware },
    }
}

pub(super) fn adapters() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12,
        // Not by the kind of build: a validation layer that happens to be installed must not slow down tests.
        flags: wgpu::InstanceFlags::empty().with_env(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()))
}

fn rank(info: &wgpu::AdapterInfo) -> u8 {
    match info.device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Cpu => 3,
        wgpu::DeviceType::Other => 4,
    }
}

pub(super) fn choose(choice: &AdapterChoice) -> Result<wgpu::Adapter, GpuError> {
    let mut all = adapters();
    all.sort_by_key(|adapter| rank(&adapter.get_info()));
    let available: Vec<String> = all.iter().map(|adapter| adapter.get_info().name).collect();
    all.into_iter()
        .find(|adapter| choice.accepts(&adapter.get_info()) && describe(adapter).usable)
        .ok_or_else(|| GpuError::NoAdapter {
            wanted: choice.to_string(),
            available: if available.is_empty() { "none".to_owned() } else { available.join(", ") },
        })
}

/// Every adapter of the machine, best first.
#[must_use]
pub fn report() -> Vec<AdapterReport> {
    let mut all = adapters();
    all.sort_by_key(|adapter| rank(&adapter.get_info()));
    all.iter().map(describe).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_from_text() {
        assert_eq!("auto".parse(), Ok(AdapterChoice::Auto));
        assert_eq!("lavapipe".parse(), Ok(AdapterChoice::Lavapipe));
        assert_eq!("RTX 4090".parse(), Ok(AdapterChoice::Named("RTX 4090".to_owned())));
    }

    #[test]
    fn an_adapter_that_does_not_exist_is_refused_by_name() {
        let fault = choose(&AdapterChoice::Named("no such adapter".to_owned())).expect_err("refused");
        assert!(matches!(fault, GpuError::NoAdapter { wanted, .. } if wanted == "no such adapter"));
    }
}
