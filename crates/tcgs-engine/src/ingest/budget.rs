//! The memory that loading a dataset may take.

use std::path::PathBuf;

/// Memory and temporary folder for decoded photographs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadBudget {
    /// Bytes of memory for photographs that are kept or being decoded.
    pub memory_bytes: u64,
    /// Folder of the temporary file for the others; it should be on a disk, not in memory.
    pub spill_dir: PathBuf,
}

impl Default for LoadBudget {
    /// 4 GiB, and the system's folder for temporary files.
    fn default() -> Self {
        Self { memory_bytes: 4 << 30, spill_dir: std::env::temp_dir() }
    }
}
