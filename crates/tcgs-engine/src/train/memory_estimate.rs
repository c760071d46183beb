//! The memory that a training run takes, part by part.

use std::fmt;

use thiserror::Error;

use crate::domain::{Bytes, MemoryBudget, Problem, ProblemType};

/// One part of what a run takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// What for.
    pub name: &'static str,
    /// How much.
    pub bytes: u64,
}

/// Where packed photographs are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PhotographPlace {
    /// On the device.
    Device,
    /// In main memory.
    Host,
    /// Nowhere: each is prepared for every step that needs it.
    Nowhere,
}

/// What a run takes at its largest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Estimate {
    /// How large the model may become.
    pub size: usize,
    /// What that counts: "anchors".
    pub unit: &'static str,
    /// Where the training photographs are kept.
    pub photographs: PhotographPlace,
    /// On the device.
    pub gpu: Vec<Part>,
    /// In main memory, the device's not counted.
    pub host: Vec<Part>,
}

impl Estimate {
    /// Logs it, for operators: the command line shows this module's lines only if asked to.
    pub(super) fn log(&self) {
        tracing::info!("memory: {self}");
    }

    /// Bytes of buffers on the device.
    #[must_use]
    pub fn gpu_bytes(&self) -> u64 {
        sum(&self.gpu)
    }

    /// Bytes of main memory.
    #[must_use]
    pub fn host_bytes(&self) -> u64 {
        sum(&self.host)
    }

    /// Whether that is within `budget`.
    #[must_use]
    pub fn fits(&self, budget: &MemoryBudget) -> bool {
        self.gpu_bytes() <= budget.gpu && self.host_bytes() <= budget.host
    }
}

fn sum(parts: &[Part]) -> u64 {
    parts.iter().fold(0, |sum, part| sum.saturating_add(part.bytes))
}

fn list(parts: &[Part]) -> String {
    let parts: Vec<String> =
        parts.iter().map(|part| format!("{} {}", part.name, Bytes(part.bytes))).collect();
    parts.join(", ")
}

impl fmt::Display for Estimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} {} take {} on the device ({}) and {} of main memory ({})",
            self.size,
            self.unit,
            Bytes(self.gpu_bytes()),
            list(&self.gpu),
            Bytes(self.host_bytes()),
            list(&self.host)
        )
    }
}

/// More memory is needed than there may be, however small the model.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "training needs at least {} on the device, of {}, and {} of main memory, of {}: {needed}. Allow more with \
     --gpu-memory or --host-memory, or make the images smaller or the point cloud sparser",
    Bytes(needed.gpu_bytes()), Bytes(budget.gpu), Bytes(needed.host_bytes()), Bytes(budget.host)
)]
pub struct OverBudget {
    /// What the smallest run takes: one that holds what the points begin with.
    pub needed: Box<Estimate>,
    /// What it may take.
    pub budget: MemoryBudget,
}

/// A photograph is too large for the buffers that the adapter can bind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "the photograph with the most pixels, {} x {}, needs a buffer of {}, and the adapter binds at most {}: downscale photographs by a \
     max_width of {max_width} or less (--max-width), or use another adapter",
    size[0], size[1], Bytes(*needed), Bytes(*limit)
)]
pub struct PhotographTooLarge {
    /// Its width and height.
    pub size: [u32; 2],
    /// Bytes of the largest buffer that it needs.
    pub needed: u64,
    /// Bytes of the largest buffer that the adapter binds.
    pub limit: u64,
    /// The largest width at which it fits.
    pub max_width: u32,
}

/// Why a machine has no room for a run, however small its model.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RunTooLarge {
    /// Its memory does not suffice.
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
    /// Its adapter cannot bind a photograph's buffers.
    #[error(transparent)]
    Photograph(#[from] PhotographTooLarge),
}

impl From<RunTooLarge> for Problem {
    fn from(error: RunTooLarge) -> Self {
        let kind = match error {
            RunTooLarge::OverBudget(_) => ProblemType::MemoryBudget,
            RunTooLarge::Photograph(_) => ProblemType::SceneTooLarge,
        };
        Problem::new(kind, error.to_string())
    }
}
