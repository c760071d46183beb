//! How kernels divide their work: for the few wide cores of a CPU or for the many lanes of a GPU.
//!
//! The variants of a kernel compute the same results, integer kernels the same bits.

/// How kernels divide their work among invocations. It follows the adapter unless
/// [`DeviceSettings::variant`](super::DeviceSettings::variant) says otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum KernelVariant {
    /// Few lanes, costly dispatches and barriers: long runs for each invocation, few dispatches.
    Software,
    /// Many lanes: short runs for each of many invocations.
    Hardware,
}

/// Consecutive elements that the hardware's kernels give to a workgroup, as in `shaders/shared/blocks.wgsl`: 256 lanes of eight.
pub const BLOCK: usize = 2048;

impl KernelVariant {
    /// Shader definitions of every kernel on a device of this variant.
    pub(super) fn defs(self) -> &'static [(&'static str, u32)] {
        self.choose(&[("SOFTWARE", 1)], &[])
    }

    /// The value of this variant.
    pub fn choose<T>(self, software: T, hardware: T) -> T {
        match self {
            Self::Software => software,
            Self::Hardware => hardware,
        }
    }
}
