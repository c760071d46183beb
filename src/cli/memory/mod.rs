//! The flags that bound memory, the same for every command that trains, and what the machine has where they are absent.

mod control_groups;

use std::{fs, path::Path};

use tcgs::domain::{Bytes, MemoryLimits};

/// Main memory taken to be there where the system does not say.
const UNKNOWN: u64 = 4 << 30;

/// How much memory a run may take.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub(crate) struct MemoryFlags {
    /// Main memory that a run may take, such as 6GiB [default: three quarters of what is available at the start]; photographs
    /// beyond it go to a temporary file
    #[arg(long, value_name = "BYTES", env = "TCGS_HOST_MEMORY")]
    host_memory: Option<Bytes>,

    /// Memory on the adapter that a run may take [default: half of --host-memory for adapters that share main memory, 8 GiB
    /// for others]
    #[arg(long, value_name = "BYTES", env = "TCGS_GPU_MEMORY")]
    gpu_memory: Option<Bytes>,
}

impl MemoryFlags {
    /// Main memory as a flag bounds it, for a command without an adapter.
    pub(crate) fn host(host_memory: Option<Bytes>) -> u64 {
        Self { host_memory, gpu_memory: None }.limits(1).host
    }

    /// Main memory, if it is stated.
    pub(crate) fn stated_host(self) -> Option<Bytes> {
        self.host_memory
    }

    /// What each of `runs` runs at a time may take.
    pub(crate) fn limits(self, runs: u16) -> MemoryLimits {
        self.limits_of(runs, available)
    }

    fn limits_of(self, runs: u16, available: impl FnOnce() -> u64) -> MemoryLimits {
        let host = self.host_memory.map_or_else(|| share(available(), runs), |bytes| bytes.0);
        MemoryLimits { host, gpu: self.gpu_memory.map(|bytes| bytes.0) }
    }
}

/// What each of `runs` runs may take of `available` bytes: three quarters of them, in equal parts.
fn share(available: u64, runs: u16) -> u64 {
    (available / 4 * 3 / u64::from(runs.max(1))).max(1)
}

/// Bytes of main memory that nobody uses, within what control groups allow this process.
fn available() -> u64 {
    let read = |path: &Path| fs::read_to_string(path).ok();
    let machine = read(Path::new("/proc/meminfo")).and_then(|text| mem_available(&text));
    machine.into_iter().chain(control_groups::available(&read)).min().unwrap_or(UNKNOWN)
}

/// The line `MemAvailable:   24078412 kB`.
fn mem_available(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_available_is_read_from_what_the_system_writes() {
        let meminfo =
            "MemTotal:       24689764 kB\nMemFree: 100 kB\nMemAvailable:   24078412 kB\nBuffers: 1 kB\n";
        assert_eq!(mem_available(meminfo), Some(24_078_412 * 1024));
        for odd in ["", "MemAvailable:", "MemAvailable: many kB", "MemAvailable: 99999999999999999999 kB"] {
            assert_eq!(mem_available(odd), None, "{odd}");
        }
    }

    #[test]
    fn stated_limits_are_taken_as_they_are_and_runs_share_what_is_not_stated() {
        let stated = MemoryFlags { host_memory: Some(Bytes(1000)), gpu_memory: Some(Bytes(10)) };
        let limits = stated.limits_of(4, || panic!("what is stated is not asked for"));
        assert_eq!(limits, MemoryLimits { host: 1000, gpu: Some(10) });
        for (available, runs, host) in [(8000, 1, 6000), (8000, 4, 1500), (8000, 0, 6000), (0, 3, 1)] {
            let limits = MemoryFlags::default().limits_of(runs, || available);
            assert_eq!(limits, MemoryLimits { host, gpu: None }, "{available} bytes for {runs}");
        }
        let only_gpu = MemoryFlags { host_memory: None, gpu_memory: Some(Bytes(10)) };
        assert_eq!(only_gpu.limits_of(2, || 8000), MemoryLimits { host: 3000, gpu: Some(10) });
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_machine_says_what_is_available() {
        let total = mem_available(
            &fs::read_to_string("/proc/meminfo").expect("a machine").replace("MemTotal:", "MemAvailable:"),
        );
        let available = available();
        assert_ne!(available, UNKNOWN, "it was read");
        assert!((1 << 20..=total.expect("a total")).contains(&available), "{available}");
    }
}
