//! Errors of the device.

use std::time::Duration;

use thiserror::Error;

use crate::domain::{Bytes, Problem, ProblemType};

/// An error of the device or of opening one.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum GpuError {
    /// No adapter matches.
    #[error("no adapter matches '{wanted}'; there are: {available}. Choose one of these with --adapter")]
    NoMatchingAdapter {
        /// The choice.
        wanted: String,
        /// Names of the adapters.
        available: String,
    },
    /// The machine has no adapter.
    #[error(
        "this machine has no adapter: install a Vulkan driver (Debian: mesa-vulkan-drivers); `tcgs doctor` shows what there is"
    )]
    NoAdapter,
    /// The adapter refused to open.
    #[error("the adapter '{adapter}' could not be opened: {error}")]
    Open {
        /// Its name.
        adapter: String,
        /// The driver's message.
        error: String,
    },
    /// The device was lost; everything on it is gone.
    #[error("the device was lost: {0}")]
    DeviceLost(String),
    /// The device did not finish in time and is not used any more.
    #[error(
        "the device did not answer within {} s; its driver may hang: choose another adapter with --adapter, or smaller images or \
         a smaller preset if it is just slow",
        waited.as_secs_f64()
    )]
    Timeout {
        /// How long the host waited.
        waited: Duration,
    },
    /// The driver rejected a command: an error of this program or of the driver.
    #[error("the device rejected a command: {0}")]
    Rejected(String),
    /// A kernel does not compose or validate.
    #[error("kernel '{kernel}': {error}")]
    Kernel {
        /// File name without extension.
        kernel: String,
        /// The composer's or validator's message.
        error: String,
    },
    /// A buffer is larger than the adapter can bind.
    #[error("buffer '{label}' needs {bytes} bytes; this adapter binds at most {limit}")]
    BufferTooLarge {
        /// What the buffer is for.
        label: String,
        /// Its size.
        bytes: u64,
        /// The adapter's limit.
        limit: u64,
    },
    /// A buffer would exceed the memory budget of the device.
    #[error("buffer '{label}' needs {bytes}; {used} of the budget of {budget} on the device are in use")]
    OverBudget {
        /// What the buffer is for.
        label: String,
        /// Its size.
        bytes: Bytes,
        /// Bytes of live buffers.
        used: Bytes,
        /// Their limit.
        budget: Bytes,
    },
}

impl From<GpuError> for Problem {
    fn from(error: GpuError) -> Self {
        let kind = match &error {
            GpuError::NoAdapter | GpuError::NoMatchingAdapter { .. } | GpuError::Open { .. } => {
                ProblemType::NoAdapter
            }
            GpuError::DeviceLost(_) => ProblemType::DeviceLost,
            GpuError::Timeout { .. } => ProblemType::DeviceTimeout,
            GpuError::Rejected(_) | GpuError::Kernel { .. } => ProblemType::DeviceFault,
            GpuError::BufferTooLarge { .. } => ProblemType::SceneTooLarge,
            GpuError::OverBudget { .. } => ProblemType::GpuMemory,
        };
        let hint = match &error {
            GpuError::OverBudget { .. } => {
                "; allow more with --gpu-memory (--view-memory for the service's views), or make the images smaller or the preset a \
                 smaller one"
            }
            _ => "",
        };
        Problem::new(kind, format!("{error}{hint}"))
    }
}
