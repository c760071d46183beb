//! Subgroup sizes that kernels may rely on.
//!
//! wgpu cannot ask a driver for one subgroup size. Where the adapter states a range, a kernel's workgroup is as wide as the
//! smallest size, so that it lies in the first lanes of one subgroup, however wide that is. `gpu/open.rs` verifies this on the
//! device.

use super::AdapterReport;

/// Smallest subgroup that kernels have a variant for: eight lanes share what they read.
pub const MIN_LANES: u32 = 8;

/// Largest subgroup that kernels have a variant for: their ballots are read as two words.
const MAX_LANES: u32 = 64;

/// SIMD width of every GPU that Apple makes; Metal states no size, so wgpu reports 4 to 64 for all that it drives.
const APPLE_LANES: u32 = 32;

/// Subgroups as kernels use them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subgroups {
    /// Nothing: kernels share values through workgroup memory.
    Unused,
    /// Every subgroup has this many lanes.
    Exactly(u32),
    /// A workgroup of this many lanes lies in the first lanes of one subgroup, which may have more.
    AtLeast(u32),
}

impl Subgroups {
    /// Lanes that kernels may share values among.
    #[must_use]
    pub fn lanes(self) -> Option<u32> {
        match self {
            Self::Unused => None,
            Self::Exactly(lanes) | Self::AtLeast(lanes) => Some(lanes),
        }
    }

    /// What the adapter states.
    pub(super) fn stated_by(adapter: &AdapterReport) -> Self {
        let [smallest, largest] = adapter.subgroup_sizes;
        let is_known = |lanes: u32| (MIN_LANES..=MAX_LANES).contains(&lanes) && lanes.is_power_of_two();
        if !adapter.subgroups {
            Self::Unused
        } else if smallest == largest {
            if is_known(smallest) { Self::Exactly(smallest) } else { Self::Unused }
        } else if adapter.backend == "metal" && adapter.name.starts_with("Apple") {
            Self::AtLeast(APPLE_LANES)
        } else if is_known(smallest) {
            Self::AtLeast(smallest)
        } else {
            Self::Unused
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::software_report;

    fn adapter(backend: &str, name: &str, subgroup_sizes: [u32; 2]) -> AdapterReport {
        let (name, backend) = (name.to_owned(), backend.to_owned());
        AdapterReport { name, backend, subgroup_sizes, ..software_report() }
    }

    #[test]
    fn a_range_of_sizes_is_used_by_its_smallest() {
        for (backend, name, sizes, expected) in [
            ("vulkan", "llvmpipe", [8, 8], Subgroups::Exactly(8)),
            ("vulkan", "NVIDIA H100", [32, 32], Subgroups::Exactly(32)),
            ("vulkan", "AMD Radeon RX 7900", [32, 64], Subgroups::AtLeast(32)),
            ("dx12", "Intel Arc A770", [8, 32], Subgroups::AtLeast(8)),
            ("vulkan", "Adreno 740", [64, 128], Subgroups::AtLeast(64)),
            ("metal", "Apple M2", [4, 64], Subgroups::AtLeast(32)),
            ("metal", "AMD Radeon Pro 5500M", [4, 64], Subgroups::Unused),
            ("vulkan", "SwiftShader", [4, 4], Subgroups::Unused),
            ("dx12", "Microsoft Basic Render Driver", [4, 128], Subgroups::Unused),
        ] {
            assert_eq!(Subgroups::stated_by(&adapter(backend, name, sizes)), expected, "{name}");
        }
        let without = AdapterReport { subgroups: false, ..adapter("vulkan", "old", [32, 32]) };
        assert_eq!(Subgroups::stated_by(&without), Subgroups::Unused);
    }
}
