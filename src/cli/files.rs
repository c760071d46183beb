//! Reads input files and writes output files atomically.

use std::{
    fs,
    io::{self, Write},
    path::Path,
};

use tempfile::NamedTempFile;

use super::CliError;

/// The bytes of an input file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, CliError> {
    fs::read(path).map_err(|fault| CliError::unreadable(path, &fault))
}

/// Writes `bytes` to a temporary file next to `path`, syncs it and renames it.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), CliError> {
    let unwritable = |fault: io::Error| CliError::unwritable(path, &fault);
    let mut file = beside(path).map_err(unwritable)?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(unwritable)?;
    file.persist(path).map_err(|fault| unwritable(fault.error))?;
    Ok(())
}

/// Checks that `path` can be written, for commands that run for hours before they write.
pub(crate) fn check_writable(path: &Path) -> Result<(), CliError> {
    if path.is_dir() {
        return Err(CliError::unwritable(path, &io::ErrorKind::IsADirectory.into()));
    }
    beside(path).map(drop).map_err(|fault| CliError::unwritable(path, &fault))
}

/// A temporary file in the folder of `path`, which is created if it is missing.
fn beside(path: &Path) -> io::Result<NamedTempFile> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder)?;
    let mut builder = tempfile::Builder::new();
    // Temporary files are private, outputs are not: these bits still pass through the process's umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_replace_what_was_there_and_leave_nothing_beside() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("new/out.bin");
        write(&path, b"first").expect("writes");
        write(&path, b"second").expect("writes");
        assert_eq!(fs::read(&path).expect("a file"), b"second");
        assert_eq!(fs::read_dir(path.parent().expect("a parent")).expect("a folder").count(), 1);
    }

    #[test]
    fn trying_a_path_leaves_nothing_and_tells_what_is_in_the_way() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("out.bin");
        check_writable(&path).expect("writable");
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0);
        write(&path, b"mine").expect("writes");
        check_writable(&path).expect("an output may be replaced");
        assert_eq!(fs::read(&path).expect("a file"), b"mine");
        for blocked in [folder.path(), &path.join("out.bin")] {
            assert_eq!(check_writable(blocked).expect_err("in the way").exit_status(), 4);
        }
    }

    #[test]
    fn faults_name_the_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let missing = folder.path().join("missing");
        let fault = read(&missing).expect_err("there is no such file");
        assert_eq!(fault.exit_status(), 3);
        assert!(fault.to_string().contains("missing"));
        let fault = write(folder.path(), b"x").expect_err("a folder is in the way");
        assert_eq!(fault.exit_status(), 4);
    }
}
