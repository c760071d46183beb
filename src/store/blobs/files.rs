//! File system helpers of the blob store.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use jiff::Timestamp;
use tokio::io::AsyncWriteExt as _;

use crate::domain::{Clock as _, SystemClock};

/// Sets the modification time to now. Ages of files are by the system clock, whichever clock the store has.
pub(super) fn touch(file: &File) -> io::Result<Timestamp> {
    let now = SystemClock.now();
    file.set_modified(now.into())?;
    Ok(now)
}

/// What was found; `None` if there is no such file.
pub(super) fn if_there<T>(found: io::Result<T>) -> io::Result<Option<T>> {
    match found {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        found => found.map(Some),
    }
}

/// Modification time of the file; `None` if there is no such file.
pub(super) fn age_of(path: &Path) -> io::Result<Option<Timestamp>> {
    let Some(metadata) = if_there(fs::metadata(path))? else { return Ok(None) };
    Timestamp::try_from(metadata.modified()?).map(Some).map_err(io::Error::other)
}

/// Opens a lock file. Each task opens it anew; closing the file releases the lock.
pub(super) fn open_lock(path: &Path) -> io::Result<File> {
    File::options().create(true).truncate(false).write(true).open(path)
}

/// Makes new names in a folder durable.
pub(super) fn sync_folder(path: &Path) -> io::Result<()> {
    // Other systems cannot open folders, and need not.
    if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
}

/// The paths in a folder; empty if there is no such folder.
pub(super) fn entries(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = if_there(fs::read_dir(folder))?;
    entries.into_iter().flatten().map(|entry| Ok(entry?.path())).collect()
}

pub(super) fn folders(folder: &Path) -> io::Result<Vec<PathBuf>> {
    Ok(entries(folder)?.into_iter().filter(|path| path.is_dir()).collect())
}

/// Writes a piece, and waits until the file system has taken it: `write_all` alone returns once the piece is in a buffer, and what then
/// fails is reported by the next call, after the piece was counted.
pub(super) async fn write_through(file: &mut tokio::fs::File, piece: &[u8]) -> io::Result<()> {
    file.write_all(piece).await?;
    file.flush().await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_the_errors_only_absence_is_an_answer() {
        let found = |kind: io::ErrorKind| if_there::<()>(Err(kind.into())).map_err(|error| error.kind());
        assert_eq!(found(io::ErrorKind::NotFound), Ok(None));
        assert_eq!(found(io::ErrorKind::PermissionDenied), Err(io::ErrorKind::PermissionDenied));
    }
}
