//! Recognises a full disk among the causes of an error, whichever library reported it.

use std::{error::Error, io};

/// `SQLITE_FULL`.
const FULL: u32 = 13;
/// `SQLITE_IOERR_SHMSIZE`: the index of the write-ahead log, a file beside the database, cannot grow.
const IOERR_SHMSIZE: u32 = 10 | (19 << 8);

/// Returns true if the error or one of its sources says that the disk, or its user's quota on it, is full.
#[must_use]
pub fn is_disk_full(error: &(dyn Error + 'static)) -> bool {
    let mut source = Some(error);
    while let Some(error) = source {
        if is_full_itself(error) {
            return true;
        }
        source = error.source();
    }
    false
}

fn is_full_itself(error: &(dyn Error + 'static)) -> bool {
    if let Some(error) = error.downcast_ref::<io::Error>() {
        return matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            // What an `io::Error` wraps is not among its sources.
            || error.get_ref().is_some_and(|inner| is_disk_full(inner));
    }
    let code = error.downcast_ref::<sqlx::Error>().and_then(result_code);
    code.is_some_and(|code| code & 0xff == FULL || code == IOERR_SHMSIZE)
}

/// SQLite's extended result code.
pub(super) fn result_code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.code()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::BlobError;

    #[test]
    fn a_full_disk_is_recognised_through_the_layers() {
        for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
            let full = || io::Error::from(kind);
            assert!(is_disk_full(&full()));
            assert!(is_disk_full(&io::Error::other(full())));
            assert!(BlobError::Io(full()).is_disk_full());
            let wrapped = object_store::Error::Generic { store: "local", source: Box::new(full()) };
            assert!(BlobError::Store(wrapped).is_disk_full());
            assert!(is_disk_full(&io::Error::other(BlobError::Io(full()))));
        }
        assert!(!BlobError::TooLarge { limit: 1 }.is_disk_full());
        assert!(!is_disk_full(&io::Error::from(io::ErrorKind::PermissionDenied)));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_systems_error_codes_are_recognised() {
        for errno in [rustix::io::Errno::NOSPC, rustix::io::Errno::DQUOT] {
            assert!(is_disk_full(&io::Error::from(errno)), "{errno}");
        }
    }
}
