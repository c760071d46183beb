//! What a job needs, as it is known before the job starts.

use serde::{Deserialize, Serialize};

/// A range of values; both ends belong to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ValueRange<T> {
    /// The least.
    pub low: T,
    /// The most.
    pub high: T,
}

/// The memory of a job at its largest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MemoryNeeds {
    /// Bytes on the adapter.
    pub gpu_bytes: u64,
    /// Bytes of main memory, the adapter's not counted.
    pub host_bytes: u64,
    /// How large the model may become.
    pub max_size: u64,
    /// What that counts: "anchors" or "Gaussians".
    pub unit: String,
}

/// What a job needs besides time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobNeeds {
    /// Training steps, those of all branches of a rate-distortion curve together.
    pub steps: u64,
    /// Its memory; none where the adapter is unknown, or has too little.
    pub memory: Option<MemoryNeeds>,
    /// Bytes of the file.
    pub file_bytes: ValueRange<u64>,
    /// Why a figure is missing, and what a figure does not cover.
    pub notes: Vec<String>,
}
