//! Tells a full disk from the other reasons for which a child process has failed, since the child's own words are no error code.

use std::{
    fs::File,
    io::{self, Write as _},
    path::Path,
};

use super::PosesError;
use crate::domain::is_no_space;

/// Bytes that there must be room for.
const BYTES: usize = 1 << 20;

/// The full disk below `folder` as the reason, if it is full; else `error`.
pub(super) fn full_disk_or(error: PosesError, folder: &Path) -> PosesError {
    match tempfile::tempfile_in(folder).and_then(|file| fill(&file)) {
        Err(full) if is_no_space(&full) => PosesError::Io { what: "the disk is full", error: full },
        _ => error,
    }
}

fn fill(mut file: &File) -> io::Result<()> {
    file.write_all(&vec![1; BYTES])?;
    // Some file systems find out only now.
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn a_file_that_takes_no_more_is_one_of_a_full_disk() {
        let full = File::options().write(true).open("/dev/full").expect("a device");
        assert!(is_no_space(&fill(&full).expect_err("no room")));
        assert!(fill(&tempfile::tempfile().expect("a file")).is_ok());
    }

    #[test]
    fn a_disk_with_room_is_not_the_reason() {
        let folder = tempfile::tempdir().expect("a folder");
        for folder in [folder.path(), &folder.path().join("missing")] {
            let error = full_disk_or(PosesError::VideoUnreadable("no frames".to_owned()), folder);
            assert!(matches!(error, PosesError::VideoUnreadable(_)), "{error}");
        }
    }
}
