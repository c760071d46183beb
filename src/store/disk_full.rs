//! Recognizes a full disk among the causes of an error, whichever library reported it.

use std::error::Error;

use sqlx::{error::DatabaseError as _, postgres::PgDatabaseError, sqlite::SqliteError};

use crate::domain::{causes, is_no_space};

/// `SQLITE_FULL`.
const FULL: u32 = 13;
/// `SQLITE_IOERR_SHMSIZE`: the index of the write-ahead log, a file beside the database, cannot grow.
const IOERR_SHMSIZE: u32 = 10 | (19 << 8);

/// `disk_full` of PostgreSQL, on its machine.
const DISK_FULL: &str = "53100";

/// Returns true if the error or one of its causes says that the disk, or its user's quota on it, is full.
#[must_use]
pub fn is_disk_full(error: &(dyn Error + 'static)) -> bool {
    let is_full = |code: u32| code & 0xff == FULL || code == IOERR_SHMSIZE;
    is_no_space(error)
        || causes(error).filter_map(|cause| cause.downcast_ref::<sqlx::Error>()).any(|error| {
            result_code(error).is_some_and(is_full) || sql_state(error).as_deref() == Some(DISK_FULL)
        })
}

/// SQLite's extended result code.
pub(super) fn result_code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.try_downcast_ref::<SqliteError>()?.code()?.parse().ok()
}

/// PostgreSQL's state (`SQLSTATE`).
pub(super) fn sql_state(error: &sqlx::Error) -> Option<String> {
    Some(error.as_database_error()?.try_downcast_ref::<PgDatabaseError>()?.code().to_owned())
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use crate::store::BlobError;

    #[test]
    fn a_full_disk_is_recognized_through_the_layers() {
        for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
            let full = || io::Error::from(kind);
            assert!(BlobError::Io(full()).is_disk_full());
            let wrapped = object_store::Error::Generic { store: "local", source: Box::new(full()) };
            assert!(BlobError::Store(wrapped).is_disk_full());
            assert!(is_disk_full(&io::Error::other(BlobError::Io(full()))));
        }
        // https://www.sqlite.org/rescode.html#ioerr_shmsize
        assert_eq!(IOERR_SHMSIZE, 4874);
        assert!(!BlobError::TooLarge { limit: 1 }.is_disk_full());
        assert!(!is_disk_full(&io::Error::from(io::ErrorKind::PermissionDenied)));
    }
}
