//! Reading inputs whole and writing outputs so that a file of the wanted name is always a whole one.

use std::{fs, io::Write, path::Path};

use super::Failure;

/// The bytes of an input file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    fs::read(path).map_err(|fault| Failure::unreadable(path, &fault))
}

/// Writes `bytes` beside `path` first and moves them there when they are all on the disk.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let unwritable = |fault: std::io::Error| Failure::unwritable(path, &fault);
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder).map_err(unwritable)?;
    let mut builder = tempfile::Builder::new();
    // Temporary files are private, outputs are not: these bits still pass through the process's umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder).map_err(unwritable)?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(unwritable)?;
    file.persist(path).map_err(|fault| unwritable(fault.error))?;
    Ok(())
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
