//! Restricts a data folder to its owner, because it holds webhook secrets and all users' data.

use std::path::Path;

#[cfg(unix)]
pub(super) use unix::{close, close_all, create};

#[cfg(unix)]
mod unix {
    use std::{
        fs, io,
        os::unix::fs::{DirBuilderExt as _, PermissionsExt as _},
    };

    use rustix::{fs::Mode, process::umask};

    use super::Path;

    /// Permissions of a file's group and of all others.
    const OTHERS: u32 = 0o077;

    /// Creates the folder if it is missing, and sets the umask so that files of this process and its children are private.
    pub(in super::super) fn create(folder: &Path) -> io::Result<()> {
        umask(Mode::from_raw_mode(OTHERS));
        fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)
    }

    /// Removes the permissions of others on the folder and these files in it.
    pub(in super::super) fn close(folder: &Path, files: &[String]) {
        for path in std::iter::once(folder.to_owned()).chain(files.iter().map(|name| folder.join(name))) {
            if let Some(mode) = close_one(&path) {
                tracing::warn!(
                    path = %path.display(),
                    "others had access ({mode:04o}); it is its owner's alone now ({:04o})",
                    mode & !OTHERS
                );
            }
        }
    }

    /// Removes the permissions of others on everything below the folder.
    pub(in super::super) fn close_all(folder: &Path) {
        let closed = close_below(folder);
        if closed > 0 {
            tracing::warn!(
                path = %folder.display(),
                "others had access to {closed} files and folders in it; they are their owner's alone now"
            );
        }
    }

    fn close_below(folder: &Path) -> usize {
        let entries = match fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(error) => {
                tracing::warn!(path = %folder.display(), error = &error as &dyn std::error::Error, "cannot be read: {error}");
                return 0;
            }
        };
        let mut closed = 0;
        for entry in entries.flatten() {
            let path = entry.path();
            closed += usize::from(close_one(&path).is_some());
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                closed += close_below(&path);
            }
        }
        closed
    }

    /// Removes the permissions of others; returns the old permissions if they were too wide.
    fn close_one(path: &Path) -> Option<u32> {
        // Links have no permissions of their own, and their targets are outside of this folder.
        let metadata = fs::symlink_metadata(path).ok().filter(|metadata| !metadata.is_symlink())?;
        let mode = metadata.permissions().mode() & 0o7777;
        if mode & OTHERS == 0 {
            return None;
        }
        match fs::set_permissions(path, fs::Permissions::from_mode(mode & !OTHERS)) {
            Ok(()) => Some(mode),
            // Another process may have removed it meanwhile.
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => {
                tracing::warn!(
                    path = %path.display(),
                    error = &error as &dyn std::error::Error,
                    "others have access ({mode:04o}), which cannot be changed: {error}"
                );
                None
            }
        }
    }
}

#[cfg(not(unix))]
pub(super) fn create(folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)
}

#[cfg(not(unix))]
pub(super) fn close(_folder: &Path, _files: &[String]) {}

#[cfg(not(unix))]
pub(super) fn close_all(_folder: &Path) {}
