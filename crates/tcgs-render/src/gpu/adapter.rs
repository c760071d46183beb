//! Choice of the adapter, and what each one offers.

use std::{fmt, str::FromStr};

use serde::Serialize;

use super::{GpuError, KernelVariant};

/// Which adapter to open.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum AdapterChoice {
    /// The best available: discrete before integrated before virtual before software.
    #[default]
    Auto,
    /// Mesa's software Vulkan.
    Lavapipe,
    /// The best whose name contains this, ignoring case.
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
    /// Whether it is this adapter, which is usable.
    #[must_use]
    pub fn accepts_report(&self, adapter: &AdapterReport) -> bool {
        adapter.usable
            && match self {
                Self::Auto => true,
                _ => self.accepts(&adapter.name, wgpu::DeviceType::Other),
            }
    }

    fn accepts(&self, name: &str, kind: wgpu::DeviceType) -> bool {
        let name = name.to_lowercase();
        match self {
            Self::Auto => kind != wgpu::DeviceType::Other,
            Self::Lavapipe => name.contains("llvmpipe"),
            Self::Named(wanted) => name.contains(&wanted.to_lowercase()),
        }
    }
}

/// An adapter with the limits and features that this program uses.
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
    /// The adapter that a choice opens.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`].
    pub fn of(choice: &AdapterChoice) -> Result<Self, GpuError> {
        Ok(describe(&choose(choice)?))
    }

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

/// Storage buffers that a kernel may bind: WebGPU's default limit, which every device offers, browsers included.
pub(super) const STORAGE_BUFFERS_NEEDED: u32 = 8;

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
        // Not the default of debug builds: an installed validation layer would slow down tests.
        flags: wgpu::InstanceFlags::empty().with_env(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()))
}

/// What choosing an adapter looks at.
struct ListedAdapter<T> {
    name: String,
    kind: wgpu::DeviceType,
    usable: bool,
    adapter: T,
}

/// Position of a kind of adapter, best first.
fn rank(kind: wgpu::DeviceType) -> u8 {
    match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Cpu => 3,
        wgpu::DeviceType::Other => 4,
    }
}

/// The best usable adapter that the choice accepts; among equals the first.
fn best<T>(choice: &AdapterChoice, mut candidates: Vec<ListedAdapter<T>>) -> Option<T> {
    candidates.sort_by_key(|candidate| rank(candidate.kind));
    let found = candidates.into_iter().find(|one| one.usable && choice.accepts(&one.name, one.kind));
    found.map(|candidate| candidate.adapter)
}

pub(super) fn choose(choice: &AdapterChoice) -> Result<wgpu::Adapter, GpuError> {
    let candidates: Vec<ListedAdapter<wgpu::Adapter>> = adapters()
        .into_iter()
        .map(|adapter| {
            let info = adapter.get_info();
            let usable = describe(&adapter).usable;
            ListedAdapter { name: info.name, kind: info.device_type, usable, adapter }
        })
        .collect();
    let available: Vec<String> = candidates.iter().map(|candidate| candidate.name.clone()).collect();
    best(choice, candidates).ok_or_else(|| match available.is_empty() {
        true => GpuError::NoAdapter,
        false => GpuError::NoMatchingAdapter { wanted: choice.to_string(), available: available.join(", ") },
    })
}

/// Every adapter of the machine, best first.
#[must_use]
pub fn report() -> Vec<AdapterReport> {
    let mut all = adapters();
    all.sort_by_key(|adapter| rank(adapter.get_info().device_type));
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
        let error = choose(&AdapterChoice::Named("no such adapter".to_owned())).expect_err("refused");
        assert!(matches!(error, GpuError::NoMatchingAdapter { wanted, .. } if wanted == "no such adapter"));
    }

    #[test]
    fn the_best_usable_adapter_is_chosen_whatever_order_drivers_list_them_in() {
        use wgpu::DeviceType::{Cpu, DiscreteGpu, IntegratedGpu, Other, VirtualGpu};
        let machine = [
            ("a display", Other, true),
            ("llvmpipe (LLVM 19)", Cpu, true),
            ("Virtio", VirtualGpu, true),
            ("UHD 630", IntegratedGpu, true),
            ("RTX 4090", DiscreteGpu, true),
            ("RTX 4080", DiscreteGpu, true),
            ("GeForce 6800", DiscreteGpu, false),
        ];
        let chosen = |choice: &str, without: &[&str], turned: usize| {
            let mut machine = machine;
            machine.rotate_left(turned);
            let candidates = machine.into_iter().filter(|(name, ..)| !without.contains(name)).map(
                |(name, kind, usable)| ListedAdapter { name: name.to_owned(), kind, usable, adapter: name },
            );
            best(&choice.parse().expect("any text"), candidates.collect())
        };
        let discrete = ["RTX 4090", "RTX 4080"];
        for turned in 0..machine.len() {
            let none = chosen("auto", &[], turned).expect("an adapter");
            assert!(discrete.contains(&none), "{none}");
            assert_eq!(chosen("auto", &discrete, turned), Some("UHD 630"));
            let gpus = [&discrete[..], &["UHD 630"]].concat();
            assert_eq!(chosen("auto", &gpus, turned), Some("Virtio"));
            let hardware = [&gpus[..], &["Virtio"]].concat();
            assert_eq!(chosen("auto", &hardware, turned), Some("llvmpipe (LLVM 19)"));
            let all = [&hardware[..], &["llvmpipe (LLVM 19)"]].concat();
            assert_eq!(chosen("auto", &all, turned), None, "what is neither is chosen by name alone");
            assert_eq!(chosen("a display", &[], turned), Some("a display"));
            assert_eq!(chosen("lavapipe", &[], turned), Some("llvmpipe (LLVM 19)"));
            assert_eq!(chosen("rtx 4080", &[], turned), Some("RTX 4080"));
            assert_eq!(chosen("geforce", &[], turned), None, "this program cannot run on it");
        }
        assert_eq!(chosen("auto", &[], 0), Some("RTX 4090"), "the first of its kind");
        assert_eq!(chosen("auto", &[], 5), Some("RTX 4080"), "the first of its kind");
        assert_eq!(chosen("rtx", &[], 0), Some("RTX 4090"));
    }
}
