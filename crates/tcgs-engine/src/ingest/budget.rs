//! The memory that loading a dataset may take, and the folder of what does not fit.

use std::{
    env,
    ffi::OsString,
    path::{Path, PathBuf},
};

/// Memory and temporary folder for decoded photographs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadBudget {
    /// Bytes of memory for photographs that are kept or being decoded.
    pub memory_bytes: u64,
    /// Folder of the temporary file for the others; it should be on a disk, not in memory.
    pub spill_dir: PathBuf,
}

impl Default for LoadBudget {
    /// 4 GiB, and [`large_file_dir`].
    fn default() -> Self {
        Self { memory_bytes: 4 << 30, spill_dir: large_file_dir() }
    }
}

/// Where temporary files go that are kept on a disk for now.
const ON_DISK: &str = "/var/tmp";

/// The folder of large temporary files: `TMPDIR` if it is set, else the system's folder for temporary files. If that one is in memory,
/// as `/tmp` is on many systems, it is `/var/tmp`, provided that it is on a disk and can be written.
#[must_use]
pub fn large_file_dir() -> PathBuf {
    choose(env::var_os("TMPDIR"), env::temp_dir(), is_in_memory, is_writable)
}

fn choose(
    named: Option<OsString>,
    usual: PathBuf,
    is_in_memory: impl Fn(&Path) -> bool,
    is_writable: impl Fn(&Path) -> bool,
) -> PathBuf {
    let on_disk = Path::new(ON_DISK);
    if named.is_none() && is_in_memory(&usual) && !is_in_memory(on_disk) && is_writable(on_disk) {
        return on_disk.to_owned();
    }
    usual
}

#[cfg(target_os = "linux")]
fn is_in_memory(folder: &Path) -> bool {
    /// tmpfs and ramfs, as `statfs` has them.
    const IN_MEMORY: [u64; 2] = [0x0102_1994, 0x8584_58f6];
    // The field has another type on each architecture.
    rustix::fs::statfs(folder).is_ok_and(|found| IN_MEMORY.contains(&((found.f_type as u64) & 0xffff_ffff)))
}

#[cfg(not(target_os = "linux"))]
fn is_in_memory(_: &Path) -> bool {
    false
}

#[cfg(unix)]
fn is_writable(folder: &Path) -> bool {
    use rustix::fs::{Access, access};

    access(folder, Access::WRITE_OK | Access::EXEC_OK).is_ok()
}

#[cfg(not(unix))]
fn is_writable(_: &Path) -> bool {
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_files_are_kept_out_of_a_temporary_folder_in_memory() {
        let tmp = || PathBuf::from("/tmp");
        let is_tmp = |folder: &Path| folder == Path::new("/tmp");
        for (named, in_memory, is_writable, chosen) in [
            (None, &is_tmp as &dyn Fn(&Path) -> bool, true, ON_DISK),
            (Some("/tmp"), &is_tmp, true, "/tmp"),
            (None, &is_tmp, false, "/tmp"),
            (None, &|_: &Path| false, true, "/tmp"),
            (None, &|_: &Path| true, true, "/tmp"),
        ] {
            let found = choose(named.map(OsString::from), tmp(), in_memory, |_| is_writable);
            assert_eq!(found, Path::new(chosen), "{named:?}, writable: {is_writable}");
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_system_says_which_folders_are_in_memory() {
        let mounts = std::fs::read_to_string("/proc/self/mounts").expect("the mounts");
        for mount in mounts.lines() {
            let fields: Vec<&str> = mount.split(' ').collect();
            // Others may be mounted over it, or it may not be seen.
            if let [_, folder @ ("/dev/shm" | "/proc" | "/sys"), kind, ..] = fields[..] {
                assert_eq!(is_in_memory(Path::new(folder)), kind == "tmpfs", "{mount}");
            }
        }
    }
}
