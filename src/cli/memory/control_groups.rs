//! The memory that Linux control groups allow this process: containers, and services with `MemoryMax=`.
//!
//! A group's limit also holds for the groups in it, so all from the process's own up to the root count.

use std::path::{Path, PathBuf};

/// Where a version's groups are, and how it names what they state.
struct Version {
    root: &'static str,
    limit: &'static str,
    used: &'static str,
    /// In `memory.stat`: pages of files that are given back at once where memory runs short.
    reclaimable: &'static str,
}

const VERSION_2: Version = Version {
    root: "/sys/fs/cgroup",
    limit: "memory.max",
    used: "memory.current",
    reclaimable: "inactive_file",
};

const VERSION_1: Version = Version {
    root: "/sys/fs/cgroup/memory",
    limit: "memory.limit_in_bytes",
    used: "memory.usage_in_bytes",
    reclaimable: "total_inactive_file",
};

/// Bytes that the tightest group of this process has left; `None` without a group that has a limit. `read` reads a file.
pub(super) fn available(read: &impl Fn(&Path) -> Option<String>) -> Option<u64> {
    let own = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let path_of = |line: &str| {
        // `0::/a/b` in version 2, `9:memory:/a/b` and others in version 1.
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        match controllers {
            "" => Some((&VERSION_2, path.to_owned())),
            _ if controllers.split(',').any(|name| name == "memory") => Some((&VERSION_1, path.to_owned())),
            _ => None,
        }
    };
    let named = own.lines().filter_map(path_of);
    // A container may see its own group as the root, under whatever name the machine has for it.
    let roots = [(&VERSION_2, "/".to_owned()), (&VERSION_1, "/".to_owned())];
    named.chain(roots).filter_map(|(version, path)| version.tightest(&path, read)).min()
}

impl Version {
    /// Bytes that the group at `path` and those around it leave.
    fn tightest(&self, path: &str, read: &impl Fn(&Path) -> Option<String>) -> Option<u64> {
        let group: PathBuf = [self.root, path.trim_start_matches('/')].iter().collect();
        let around = group.ancestors().take_while(|folder| folder.starts_with(self.root));
        around.filter_map(|folder| self.left(folder, read)).min()
    }

    /// Bytes that one group leaves; `None` where it has no limit, which reads as `max`.
    fn left(&self, group: &Path, read: &impl Fn(&Path) -> Option<String>) -> Option<u64> {
        let number = |name: &str| read(&group.join(name))?.trim().parse::<u64>().ok();
        let (limit, used) = (number(self.limit)?, number(self.used)?);
        let stat = read(&group.join("memory.stat")).unwrap_or_default();
        let reclaimable =
            stat.lines().find_map(|line| line.strip_prefix(self.reclaimable)?.trim().parse().ok());
        Some(limit.saturating_sub(used.saturating_sub(reclaimable.unwrap_or(0))))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn left(files: &[(&str, &str)]) -> Option<u64> {
        let files: BTreeMap<PathBuf, String> =
            files.iter().map(|(path, text)| (PathBuf::from(path), (*text).to_owned())).collect();
        available(&|path: &Path| files.get(path).cloned())
    }

    #[test]
    fn pages_that_can_be_given_back_are_left() {
        let group = [("/sys/fs/cgroup/memory.max", "2000\n"), ("/sys/fs/cgroup/memory.current", "1900\n")];
        assert_eq!(left(&group), Some(100));
        let stat = ("/sys/fs/cgroup/memory.stat", "anon 300\ninactive_file 1500\nactive_file 100\n");
        assert_eq!(left(&[group[0], group[1], stat]), Some(1600));
        let more = ("/sys/fs/cgroup/memory.stat", "inactive_file 5000\n");
        assert_eq!(left(&[group[0], group[1], more]), Some(2000));
    }

    #[test]
    fn the_tightest_group_around_the_process_counts() {
        let files = [
            ("/proc/self/cgroup", "0::/system.slice/tcgs.service\n"),
            ("/sys/fs/cgroup/system.slice/tcgs.service/memory.max", "max\n"),
            ("/sys/fs/cgroup/system.slice/tcgs.service/memory.current", "50\n"),
            ("/sys/fs/cgroup/system.slice/memory.max", "1000\n"),
            ("/sys/fs/cgroup/system.slice/memory.current", "400\n"),
        ];
        assert_eq!(left(&files), Some(600));
        let own = ("/sys/fs/cgroup/system.slice/tcgs.service/memory.max", "70\n");
        assert_eq!(left(&[files[0], own, files[2], files[3], files[4]]), Some(20));
    }

    #[test]
    fn groups_of_version_1_are_read_too() {
        let files = [
            ("/proc/self/cgroup", "12:cpu,cpuacct:/a\n9:memory:/docker/abc\n1:name=systemd:/b\n"),
            ("/sys/fs/cgroup/memory/docker/abc/memory.limit_in_bytes", "3000\n"),
            ("/sys/fs/cgroup/memory/docker/abc/memory.usage_in_bytes", "2500\n"),
            ("/sys/fs/cgroup/memory/docker/abc/memory.stat", "inactive_file 1\ntotal_inactive_file 700\n"),
        ];
        assert_eq!(left(&files), Some(1200));
        // As a container of version 1 sees it.
        let inside = [
            files[0],
            ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "3000\n"),
            ("/sys/fs/cgroup/memory/memory.usage_in_bytes", "2500\n"),
        ];
        assert_eq!(left(&inside), Some(500));
    }

    #[test]
    fn without_limits_or_groups_nothing_is_said() {
        assert_eq!(left(&[]), None);
        let unlimited = [("/sys/fs/cgroup/memory.max", "max\n"), ("/sys/fs/cgroup/memory.current", "100\n")];
        assert_eq!(left(&unlimited), None);
        let full = [("/sys/fs/cgroup/memory.max", "1000\n"), ("/sys/fs/cgroup/memory.current", "4000\n")];
        assert_eq!(left(&full), Some(0));
        assert_eq!(left(&[("/proc/self/cgroup", "no group\n0::../../outside\n")]), None);
    }
}
