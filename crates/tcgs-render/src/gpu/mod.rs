//! The GPU device: adapter choice, buffers, kernels and recorded dispatches, and the primitives (prefix sum, radix sort) that
//! everything else on the device is built from.
//!
//! Invariants: the adapter is the one that was asked for, or there is an error; a lost device is reported as
//! [`GpuError::DeviceLost`] from then on, and one that did not answer as [`GpuError::Timeout`]; every wait has a time limit; every
//! buffer is counted in bytes, and none is made that would take them beyond [`Device::budget_bytes`].

mod adapter;
mod bind_groups;
mod buffer;
mod constants;
mod device;
mod driver_cache;
mod error;
mod kernel;
mod ledger;
mod mapping;
mod open;
#[cfg(target_arch = "wasm32")]
mod page;
mod plan;
mod profile;
mod readback;
mod recorder;
mod scan;
mod settings;
mod sort;
mod staging;
mod subgroups;
#[doc(hidden)]
pub mod testing;
mod timing;
pub mod twin;
mod variant;

pub use adapter::{AdapterChoice, AdapterReport, report};
pub use buffer::{Buffer, RawBuffer, buffer_bytes};
pub use constants::CONSTANT_BYTES;
pub use device::Device;
pub use driver_cache::driver_cache;
pub use error::GpuError;
pub use kernel::{
    Kernel, KernelSource, kernel_source,
    table::{Definitions, KERNELS, KernelEntry, find_kernel},
};
#[cfg(target_arch = "wasm32")]
pub use page::{OffscreenCanvas, PageCanvas};
pub use plan::Plan;
pub use plan::planned;
pub use profile::{Profile, RecordingProfile};
pub use readback::Readback;
pub use recorder::{Binding, Recorder};
pub use scan::{Scan, ScanSlots};
pub use settings::DeviceSettings;
pub use sort::{Pairs, RadixSort};
pub use staging::{PendingRead, Staging};
pub use subgroups::{MIN_LANES, Subgroups};
pub use timing::KernelTime;
pub use variant::{BLOCK, KernelVariant};
